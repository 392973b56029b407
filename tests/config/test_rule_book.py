"""One rule book: the command line and `bcrl.api` make or reject the same courses."""

import itertools
from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from bcrl import api
from bcrl.config import plan as compose
from bcrl.config import tags
from bcrl.config.algorithms import fqi
from bcrl.config.hydra_compose import catalog, composed, read_option
from bcrl.errors import ConfigError
from bcrl.learning.curriculum import CURRICULA
from bcrl.learning.lspi import LSPI
from bcrl.learning.transfer import (
    TRANSFERS,
    Boost,
    PolicyReuse,
    ResidualPolicy,
    Shape,
    StageResult,
    begin,
    warm_start,
)
from bcrl.q.functions import ZERO, Sum
from bcrl.q.regressors.ours import REGRESSORS
from tests.toys import OpenCorridor


def options(group: str) -> dict[str, dict]:
    """The options of a group, by name, as their files say."""
    return {name: read_option(group, name) for name in catalog()[group]}


#: The choices besides env and algorithm; an option added to conf/ is covered, too.
CHOICES = [options(group) for group in ("curriculum", "boosting", "transfer")]
#: What an algorithm's own section may say of learners and regressors.
OWN = {
    "dqn": [{"learners": kind} for kind in ("auto", "dqn", "lspi", ["lspi", "dqn"])],
    "fqi": [{"regressor": r} for r in options("algorithm/regressor").values()]
    + [{"new_data": "task", "epsilon": 1.0}, {"dataset": "shared"}],
}


@cache
def settled(env: str, algorithm: str) -> dict:
    """A composed config of the pair, resolved."""
    named = ("env.id=CartPole-v1",) if env == tags.OPEN else ()
    return tags.plain_config(composed((f"env={env}", f"algorithm={algorithm}", *named)))


def outcome(make, *arguments, **options):
    """The stages, or the key and the reason of the rejection."""
    try:
        return make(*arguments, **options)
    except ConfigError as error:
        return error.key.removeprefix("algorithm."), error.allowed


def by_command(config: dict):
    """What the command line makes of a composed config."""
    return compose.plan(config, "env").stages


def by_api(config: dict):
    """The same, as a script would write it."""
    tasks, _ = compose._tasks(config["env"])
    transfers = []
    for group, classes in (("boosting", {"on": Boost}), ("transfer", TRANSFERS)):
        values = dict(config[group])
        if cls := classes.get(values.pop("name")):
            transfers.append(cls(**values))
    section, curriculum = config["algorithm"], config["curriculum"]["name"]
    n, learners, auto = len(tasks), [], "dqn"
    if section["name"] == "dqn" and transfers:
        first = tasks[CURRICULA[curriculum](n)[0]]
        auto = "dqn" if getattr(first, "linear_quadratic", None) is None else "lspi"
    for slot in range(n):
        own = section | {"hidden": tuple(section.get("hidden", ()))}
        own = {k: v[slot] if isinstance(v, list) else v for k, v in own.items()}
        kind, hidden = own.pop("learners", None), own.pop("hidden")
        if own.pop("name") == "fqi":
            values = dict(own.pop("regressor"))
            regressor = REGRESSORS[values.pop("name")](**values)
            if own["evaluate_every"] is None:
                budget = own["iterations"], own["episodes"]
                own["evaluate_every"] = fqi.interval(tasks[slot], *budget)
            own["new_data"] = own["new_data"] == "stage"
            own["shared_data"] = own.pop("dataset") == "shared"
            own["fixed_trees"] = own.pop("fit_randomness") == "fixed"
            learners.append(api.FQI(regressor=regressor, **own))
        elif kind == "lspi" or (kind == "auto" and slot == 0 and auto == "lspi"):
            budget = {k: own[k] for k in ("steps", "evaluation_episodes")}
            learners.append(LSPI(**budget, **own["lspi"]))
        else:
            del own["lspi"]
            learners.append(api.DQN(hidden=hidden, **own))
    return api.stages(tasks, learners, *transfers, curriculum=curriculum)


@pytest.mark.parametrize("algorithm", options("algorithm"))
@pytest.mark.parametrize("env", options("env"))
def test_all_combinations_of_groups_give_the_same_course_or_rejection(
    env, algorithm, monkeypatch
):
    config, seen = settled(env, algorithm), set()
    made = compose._tasks(config["env"])  # once: the groups don't change them
    monkeypatch.setattr(compose, "_tasks", lambda section: made)
    n = len(made[0])
    for own, *chosen in itertools.product(
        OWN[algorithm], *(each.values() for each in CHOICES)
    ):
        if isinstance(own.get("learners"), list):
            own = {"learners": ["lspi"] + ["dqn"] * (n - 1)}
        groups = zip(("curriculum", "boosting", "transfer"), chosen, strict=True)
        asked = config | dict(groups) | {"algorithm": config["algorithm"] | own}
        found = outcome(by_command, asked)
        assert found == outcome(by_api, asked), (own, chosen)
        seen.add(type(found[-1]))
    assert len(seen) == 2  # both happened: courses and rejections


@pytest.mark.parametrize("order", [[0, 0, 2], [2, 2, 2], [2, 0, 2], [2, 1, 0]])
def test_an_order_of_ones_own_is_the_same_in_both(order, monkeypatch):
    monkeypatch.setitem(CURRICULA, "mine", lambda n: order)
    for algorithm, transfer in itertools.product(("fqi", "dqn"), ("none", "shaping")):
        chosen = {"curriculum": {"name": "mine"}, "transfer": CHOICES[2][transfer]}
        config = settled("car_on_hill", algorithm) | chosen
        made = compose.plan(config, "car_on_hill")
        assert made.stages == by_api(config)
        assert ("C-" in made.variant) == (len(set(order)) > 1)


@pytest.mark.parametrize(
    "order",
    [
        *([0, 1, 1], [0, 1, 3], [0, 1, -1], [], [0, 2], [0, 1, 2, 2]),
        *([False, True, 2], [0, 1, 2.0], "012", 2, None, {0, 1, 2}, np.arange(3.0)),
    ],
)
def test_a_curriculum_that_is_none_is_rejected_in_both(order, monkeypatch):
    """Out of range, too short or long, never at the target, no list of integers."""
    monkeypatch.setitem(CURRICULA, "mine", lambda n: order)
    config = settled("car_on_hill", "fqi") | {"curriculum": {"name": "mine"}}
    rejected = [outcome(make, config) for make in (by_command, by_api)]
    assert rejected[0][0] == "curriculum" and rejected[0] == rejected[1]


def test_a_curriculum_has_no_moods():
    moods = iter([[0, 1], [1, 1]])
    with pytest.raises(ConfigError, match="curriculum"):
        api.stages(TASKS[1:], FITTED, curriculum=lambda n: next(moods))


# --- what a script can say and a config can't ---

FITTED = api.FQI(iterations=2, episodes=3, regressor=api.Forest(trees=2))
TASKS = [OpenCorridor(prize=p) for p in (3.0, 2.0, 1.0)]


def test_plain_dqn_is_one_stage_with_one_replay():
    learners = [api.DQN(steps=steps) for steps in (100, 200, 300)]
    (only,) = api.stages(TASKS[-1:] * 3, learners)
    assert only.learner == api.DQN(steps=600) and only.before == 0
    (same,) = api.stages(TASKS, learners, curriculum="off")
    assert same == replace(only, task=3)
    assert len(api.stages(TASKS, learners)) == 3
    assert len(api.stages(TASKS[-1:] * 3, learners, Boost())) == 3


def test_data_are_kept_within_a_task_only():
    keeping = replace(FITTED, new_data=False)
    first, again, other = api.stages([TASKS[0], *TASKS[:2]], keeping)
    assert [s.learner.new_data for s in (first, again, other)] == [True, False, True]
    learners = [keeping, keeping, replace(keeping, episodes=7)]
    with pytest.raises(ConfigError, match="new_data"):
        api.stages(TASKS[-1:] * 3, learners)
    assert api.stages([TASKS[0], *TASKS[-1:] * 2], [FITTED, *[learners[2]] * 2])


B, SHAPE, RPL, PPR = Boost(), Shape(), ResidualPolicy(), PolicyReuse()
DEEP, LINEAR = api.DQN(), [api.LinearSystem("lq", horizon=100), api.LinearSystem()]
REUSED = [replace(LINEAR[0], horizon=100)] * 2
SHARED, OTHER = replace(FITTED, shared_data=True, epsilon=0.5), api.Forest(trees=3)
#: Tasks, learners, transfers, and the key that is rejected; numbers out of bounds stand
#: in bad_input.txt.
REJECTED = [
    (LINEAR[1:] * 2, DEEP, (PPR,), "transfer"),  # nothing to reuse
    (LINEAR[1:] * 2, DEEP, (RPL,), "transfer"),  # nothing to add to
    (LINEAR, DEEP, (B, RPL), "transfer"),  # two meanings of an action
    (TASKS, DEEP, (RPL,), "transfer"),  # no vectors
    (TASKS[:1], FITTED, (B,), "boosting"),
    (LINEAR, DEEP, (SHAPE, PPR), "transfers"),
    (TASKS, FITTED, (warm_start, B), "transfers"),
    (TASKS, FITTED, ("boost",), "transfers"),
    (TASKS, replace(FITTED, regressor=api.Tabular()), (), "regressor"),
    (TASKS, FITTED, (Boost(maxima="two"),), "boosting"),
    (TASKS, [FITTED, DEEP, DEEP], (), "learners"),
    (TASKS, api.DQN, (), "learners"),
    (TASKS, SHARED, (), "dataset"),
    (TASKS, replace(FITTED, episodes=True), (), "episodes"),
    (TASKS, replace(DEEP, hidden=()), (), "hidden"),
    (TASKS[:2], [DEEP, replace(DEEP, hidden=(8,))], (), "hidden"),
    (TASKS[:2], [FITTED, replace(FITTED, regressor=OTHER)], (), "regressor"),
    (LINEAR, LSPI(), (B,), "learners"),  # not linear-quadratic
    (LINEAR, [LSPI(), DEEP], (), "learners"),  # leaves no network
    (REUSED, LSPI(), (B,), "learners"),  # twice
    (LINEAR[::-1], [DEEP, LSPI()], (SHAPE,), "learners"),  # last
    (LINEAR, [LSPI(steps=2100), DEEP], (B,), "steps"),
    (LINEAR, [LSPI(noise_std=0.0), DEEP], (B,), "lspi.noise_std"),
]


@pytest.mark.parametrize(("tasks", "learners", "transfers", "key"), REJECTED)
def test_a_script_is_rejected_what_makes_no_sense(tasks, learners, transfers, key):
    with pytest.raises(ConfigError) as rejection:
        api.stages(tasks, learners, *transfers)
    assert rejection.value.key == key


def test_numbers_of_numpy_are_numbers_and_the_order_of_transfers_is_free():
    given = replace(FITTED, episodes=np.int64(3), epsilon=np.float64(0.5))
    assert len(api.stages(TASKS, given)) == 3
    one, other = (api.stages(TASKS, FITTED, *t) for t in ((SHAPE, B), (B, SHAPE)))
    assert one == other and one[0].transfers == (B, SHAPE)


# --- a user's transfers ---


@dataclass(frozen=True)
class Own:
    """A transfer that does `what`."""

    what: str

    def __call__(self, start, previous):
        return {
            "nothing": lambda: start,
            "no start": lambda: previous.q,
            "base": lambda: replace(start, base=Sum((previous.q, previous.q))),
            "steering": lambda: replace(start, prior=previous.q, behavior=PPR),
            "network": lambda: replace(start, initial=Sum((previous.residual,))),
            "weights": lambda: replace(start, initial=previous.residual.online),
            "reading": lambda: replace(start, base=previous.q, boost=Boost("residual")),
        }[self.what]()


@pytest.mark.parametrize(
    ("what", "learner", "others", "key"),
    [
        ("nothing", DEEP, (B,), "transfer"),
        ("no start", FITTED, (), "transfer"),
        ("base", FITTED, (B,), "boosting"),  # whose base it replaces
        ("base", FITTED, (), None),
        ("steering", FITTED, (), "transfer"),
        ("steering", DEEP, (), None),
        ("network", DEEP, (), "transfer"),
        ("network", FITTED, (), None),
        ("weights", DEEP, (), None),  # can't be told before there are networks
        ("reading", FITTED, (), "transfer"),
        ("reading", DEEP, (), None),
    ],
)
def test_a_transfer_of_ones_own_has_an_effect_on_its_learner(
    what, learner, others, key
):
    made = outcome(api.stages, TASKS, learner, *others, Own(what))
    assert made[0] == key if key else len(made) == 3


def test_a_transfer_of_ones_own_that_acts_needs_no_random_steps():
    for what in ("base", "steering", "weights"):
        stages = api.stages(TASKS, DEEP, Own(what))
        assert [s.learner.random_steps for s in stages] == [500, 0, 0]


def test_what_is_no_start_is_rejected_during_a_run_as_well():
    def late(start, previous):
        return previous.q.weights  # only a learned Q has some

    assert len(api.stages(TASKS, DEEP, late)) == 3
    with pytest.raises(ConfigError, match="transfer"):
        begin([late], StageResult(SimpleNamespace(weights=()), ZERO))
