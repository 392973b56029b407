"""Fitted Q-iteration, plain and boosted, against exact value iteration."""

from dataclasses import replace

import numpy as np
import pytest

from bcrl.evaluation.oracle.maze import optimal_q
from bcrl.learning import stage
from bcrl.learning.fqi import FQI
from bcrl.learning.rollout import transition_tables
from bcrl.learning.stage import SeedBatch, Stage
from bcrl.learning.transfer import Boost, Shape, begin, warm_start
from bcrl.q.functions import ZERO, Sum, Table, Zero, add
from bcrl.q.regressors.ours import ForestRegressor, Tabular
from tests.toys import Corridor, OpenCorridor


def stages(tasks, transfers=(warm_start,), iterations=120, keep_data=False, **options):
    made, options = [], {"regressor": Tabular()} | options
    for i, env in enumerate(tasks):
        learner = FQI(iterations, 60, new_data=not (i and keep_data), **options)
        made.append(Stage(i + 1, i + 1, env, learner, transfers, i * iterations))
    return made


def learn(tasks, *transfers, seeds=(0, 1), **options):
    batch = SeedBatch(seeds, Corridor().states())
    return list(stage.learn(stages(tasks, transfers, **options), batch))


@pytest.mark.parametrize(
    "transfers", [(Boost(),), (warm_start,), (Shape(),), (Boost(), Shape())]
)
def test_with_an_exact_regressor_it_is_value_iteration(transfers):
    tasks = [Corridor(prize=-1.0), Corridor(prize=3.0)]
    snapshots = learn(tasks, *transfers)
    first, last = snapshots[119], snapshots[-1]
    assert first.last_of_stage and snapshots[120].stage.number == 2
    q_star = optimal_q(*transition_tables(tasks[-1]), tasks[-1].gamma)
    for s, q in enumerate(last.probed_q):
        assert np.allclose(q[:5], q_star[:5], atol=1e-5)  # cell 5 ends the episode
        if transfers == (Boost(),):  # learns the difference between the tasks
            residual = q - first.probed_q[s]
            assert np.allclose(last.probed_residual[s][:5], residual[:5], atol=1e-9)


@pytest.mark.parametrize("transfers", [(Boost(),), (Boost(), Shape())])
def test_tabulated_and_general_evaluation_agree_with_the_same_forests(transfers):
    options = {"regressor": ForestRegressor(trees=5), "iterations": 4}
    fast = learn([Corridor(), Corridor(prize=2.0)], *transfers, **options)
    plain = learn([OpenCorridor(), OpenCorridor(prize=2.0)], *transfers, **options)
    states = Corridor().states()
    for a, b in zip(fast, plain, strict=True):
        for s, values in enumerate(b.result.q([states, states], 2)):
            # The table has all cells, the general way has those in the data.
            assert np.allclose(a.probed_q[s][:5], values[:5], atol=1e-12)


def test_an_action_never_tried_keeps_its_approximator():
    tasks, probe = [Corridor(), Corridor(prize=5.0)], Corridor().states()
    batch = SeedBatch((0,), probe)
    first, second = stages(tasks, iterations=3, keep_data=True)
    *_, before = stage.learn([first], batch)
    (data,) = before.result.data
    (_, left), right = data.by_action
    data = [replace(data, by_action=[(np.empty(0, np.intp), left), right])]
    start = begin([warm_start], replace(before.result, data=data))
    *_, after = second.learner.learn(second, start, batch)
    assert np.array_equal(after.probed_q[0][:, 0], before.probed_q[0][:, 0])
    assert not np.array_equal(after.probed_q[0][:, 1], before.probed_q[0][:, 1])


def test_a_kept_dataset_is_not_collected_again():
    options = {"iterations": 2, "keep_data": True, "seeds": (0,)}
    snapshots = learn([Corridor()] * 2, warm_start, **options)
    assert snapshots[0].result.data is snapshots[-1].result.data
    assert [x.count for x in snapshots] == [1, 2, 3, 4]


class Recorder(Tabular):
    """Notes the first draw of every fit, by iteration."""

    def __init__(self):
        object.__setattr__(self, "draws", [])

    def fit(self, problems, keep, threads):
        self.draws.append([p.rng.integers(2**63) for p in problems])
        return super().fit(problems, keep, threads)


@pytest.mark.parametrize("fixed", [False, True])
def test_every_fit_has_randomness_of_its_own_unless_released(fixed):
    recorder, tasks = Recorder(), [Corridor()] * 2
    learn(tasks, Boost(), regressor=recorder, iterations=3, fixed_trees=fixed)
    draws = np.array(recorder.draws).reshape(6, 2, 2)  # iterations, seeds, actions
    assert len(np.unique(draws)) == (2 if fixed else 6 * 2 * 2)
    assert all(len(np.unique(draws[:, s])) == (1 if fixed else 12) for s in (0, 1))


def test_the_released_option_shares_one_dataset_per_task():
    def counts(seeds, *transfers, **options):
        (last,) = learn([Corridor()], *transfers, seeds=seeds, iterations=1, **options)
        return [x.multiplicity for x in last.result.data]

    own = counts((0, 1), warm_start)
    shared = counts((0, 1), warm_start, shared_data=True)
    later = counts((5,), Boost(), shared_data=True)
    assert not np.array_equal(own[0], own[1])
    assert shared[0] is shared[1]
    assert np.array_equal(shared[0], later[0])


def test_sums_flatten_and_drop_zeros():
    a, b = Table([np.ones((6, 2))], Corridor()), Table([np.ones((6, 2))], None)
    assert add(ZERO, a) is a and isinstance(add(ZERO, ZERO), Zero)
    assert add(add(a, b), a) == Sum((a, b, a))
    states = [np.array([[1.0], [2.0]])]
    assert Sum((a, a))(states, 2)[0].tolist() == [[2.0, 2.0], [2.0, 2.0]]
