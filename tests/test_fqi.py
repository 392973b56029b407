"""Fitted Q-iteration, plain and boosted, against exact value iteration."""

from dataclasses import replace

import numpy as np
import pytest

from bcrl.bellman import residual_target
from bcrl.learners.fqi import FQI, Stage
from bcrl.oracle.maze import optimal_q
from bcrl.q import ZERO, Sum, Table, Zero, add
from bcrl.q.regressors import ForestRegressor, Tabular
from bcrl.rollout import transition_tables
from bcrl.transfer import boost, warm_start
from tests.toys import Corridor, OpenCorridor


def stages(tasks, iterations=120, new_data=(True, True), episodes=60):
    return [
        Stage(i + 1, i + 1, env, iterations, episodes, 1.0, new_data[i])
        for i, env in enumerate(tasks)
    ]


def learn(tasks, transfer, regressor=None, seeds=(0, 1), **options):
    learner = FQI(seeds, regressor or Tabular(), transfer)
    every = Corridor().states()
    return list(learner.run(stages(tasks, **options), every)), learner


def test_the_target_is_equation_5_by_hand():
    y = residual_target(
        reward=np.array([1.0, -2.0]),
        absorbing=np.array([False, True]),
        next_q=np.array([[3.0, 4.0], [9.0, 9.0]]),
        base=np.array([0.5, 0.25]),
        gamma=0.5,
    )
    assert y.tolist() == [1.0 + 0.5 * 4.0 - 0.5, -2.0 - 0.25]


@pytest.mark.parametrize("transfer", [boost, warm_start])
def test_with_an_exact_regressor_it_is_value_iteration(transfer):
    tasks = [Corridor(prize=-1.0), Corridor(prize=3.0)]
    snapshots, _ = learn(tasks, transfer)
    q_star = optimal_q(*transition_tables(tasks[-1]), tasks[-1].gamma)
    for q in snapshots[-1].probed_q:
        assert np.allclose(q[:5], q_star[:5], atol=1e-5)  # cell 5 ends the episode


def test_boosting_learns_the_difference_between_two_tasks():
    tasks = [Corridor(prize=1.0), Corridor(prize=3.0)]
    snapshots, _ = learn(tasks, boost)
    first = next(x for x in snapshots if x.last_of_stage)
    last = snapshots[-1]
    for s in range(2):
        residual = last.probed_q[s] - first.probed_q[s]
        assert np.allclose(last.probed_residual[s][:5], residual[:5], atol=1e-9)
    assert snapshots[120].stage.number == 2


def test_a_boosted_stage_starts_at_the_previous_q_and_a_zero_residual():
    previous = Table([np.ones((6, 2))], Corridor().index)
    assert boost(previous).base is previous and boost(previous).initial is ZERO
    assert (
        warm_start(previous).base is ZERO and warm_start(previous).initial is previous
    )


def test_tabulated_and_general_evaluation_agree_with_the_same_forests():
    trees = ForestRegressor(trees=5)
    fast, _ = learn([Corridor(), Corridor(prize=2.0)], boost, trees, iterations=4)
    plain, _ = learn(
        [OpenCorridor(), OpenCorridor(prize=2.0)], boost, trees, iterations=4
    )
    states = Corridor().states()
    for a, b in zip(fast, plain, strict=True):
        for s in range(2):
            seen = a.probed_q[s]
            asked = b.q([states, states], 2)[s]
            # The table asks for all cells, the general way for those in the data.
            assert np.allclose(seen[:5], asked[:5], atol=1e-12)


def test_an_action_never_tried_keeps_its_approximator():
    learner = FQI((0,), Tabular(), warm_start)
    first, second = stages([Corridor(), Corridor(prize=5.0)], iterations=3)
    before = list(learner.run([first], Corridor().states()))[-1]
    sets = learner._datasets[0]
    left, right = sets.by_action
    starved = replace(left, rows=np.empty(0, np.intp))
    learner._datasets = [replace(sets, by_action=(starved, right))]
    *_, after = learner._learn(second, before.q, 3)
    assert np.array_equal(after.probed_q[0][:, 0], before.probed_q[0][:, 0])
    assert not np.array_equal(after.probed_q[0][:, 1], before.probed_q[0][:, 1])


def test_a_kept_dataset_is_not_collected_again():
    learner = FQI((0,), Tabular(), warm_start)
    seen = []
    for snapshot in learner.run(
        stages([Corridor()] * 2, 2, (True, False)), Corridor().states()
    ):
        seen.append((snapshot.iteration, learner._datasets))
    assert seen[0][1] is seen[-1][1]
    assert [i for i, _ in seen] == [1, 2, 3, 4]


class Recorder(Tabular):
    """Notes the first draw of every fit, by iteration."""

    def __init__(self):
        object.__setattr__(self, "draws", [])

    def fit(self, problems, keep, threads):
        self.draws.append([p.rng.integers(2**63) for p in problems])
        return super().fit(problems, keep, threads)


def drawn(**options) -> np.ndarray:
    """First draws of the fits, shape (iterations of both stages, seeds, actions)."""
    recorder = Recorder()
    learner = FQI((0, 1), recorder, boost, **options)
    list(learner.run(stages([Corridor()] * 2, iterations=3), Corridor().states()))
    return np.array(recorder.draws).reshape(6, 2, 2)


def test_every_fit_has_randomness_of_its_own():
    assert len(np.unique(drawn())) == 6 * 2 * 2


def test_the_released_option_fixes_a_seeds_randomness_in_all_its_fits():
    fixed = drawn(fixed_trees=True)
    assert [len(np.unique(fixed[:, s])) for s in (0, 1)] == [1, 1]
    assert len(np.unique(fixed)) == 2


def test_the_released_option_shares_one_dataset_a_task():
    own = FQI((0, 1), Tabular(), warm_start)
    shared = FQI((0, 1), Tabular(), warm_start, shared_data=True)
    later = FQI((5,), Tabular(), boost, shared_data=True)
    (stage,) = stages([Corridor()], iterations=1, new_data=(True,))
    for learner in (own, shared, later):
        list(learner.run([stage], Corridor().states()))
    counts = [learner._datasets for learner in (own, shared, later)]
    assert not np.array_equal(counts[0][0].multiplicity, counts[0][1].multiplicity)
    assert counts[1][0] is counts[1][1]
    assert np.array_equal(counts[1][0].multiplicity, counts[2][0].multiplicity)


def test_sums_flatten_and_drop_zeros():
    a, b = Table([np.ones((6, 2))], Corridor().index), Table([np.ones((6, 2))], None)
    assert add(ZERO, a) is a and isinstance(add(ZERO, ZERO), Zero)
    assert add(add(a, b), a) == Sum((a, b, a))
    states = [np.array([[1.0], [2.0]])]
    assert Sum((a, a))(states, 2)[0].tolist() == [[2.0, 2.0], [2.0, 2.0]]
