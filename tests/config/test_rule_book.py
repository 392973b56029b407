"""One rule book: the command line and `bcrl.api` make or reject the same courses."""

import itertools
from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from bcrl import api
from bcrl.config import jobs
from bcrl.config import plan as compose
from bcrl.config.hydra_compose import CONF, CONFIG_NAME, composed
from bcrl.errors import ConfigError
from bcrl.learning.curriculum import CURRICULA
from bcrl.learning.lspi import LSPI
from bcrl.learning.transfer import (
    TRANSFERS,
    Boost,
    PolicyReuse,
    ResidualPolicy,
    Shape,
    StageInit,
    StageResult,
    begin,
    warm_start,
)
from bcrl.q.functions import ZERO, Sum
from bcrl.q.regressors.ours import REGRESSORS
from tests.conftest import plans
from tests.toys import OpenCorridor


def options(group: str) -> dict[str, dict]:
    """The options of a group, by name, as their files say."""
    paths = sorted((CONF / group).glob("*.yaml"))
    return {path.stem: yaml.safe_load(path.read_text()) for path in paths}


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
    named = ("env.id=CartPole-v1",) if env == jobs.OPEN else ()
    return jobs._plain(
        composed(CONFIG_NAME, (f"env={env}", f"algorithm={algorithm}", *named), ())
    )


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
    section = config["algorithm"]
    learners = {"fqi": fqi, "dqn": dqn}[section["name"]](
        section, config["curriculum"]["name"], tasks, transfers
    )
    return api.stages(
        tasks, learners, *transfers, curriculum=config["curriculum"]["name"]
    )


def per_slot(value, n):
    return value if isinstance(value, list) else [value] * n


def fqi(section, curriculum, tasks, transfers):
    values, n = dict(section["regressor"]), len(tasks)
    regressor = REGRESSORS[values.pop("name")](**values)
    budgets = (section[key] for key in ("iterations", "episodes", "epsilon"))
    return [
        api.FQI(
            iterations,
            episodes,
            regressor,
            float(epsilon),
            section["new_data"] == "stage",
            section["dataset"] == "shared",
            section["fit_randomness"] == "fixed",
        )
        for iterations, episodes, epsilon in zip(
            *(per_slot(b, n) for b in budgets), strict=True
        )
    ]


def dqn(section, curriculum, tasks, transfers):
    values, n = {k: per_slot(v, len(tasks)) for k, v in section.items()}, len(tasks)
    made = []
    for slot, task in enumerate(CURRICULA[curriculum](n)):
        kind, own = values["learners"][slot], section["lspi"]
        if kind == "auto":
            quadratic = getattr(tasks[task], "linear_quadratic", None) is not None
            kind = "lspi" if quadratic and transfers and slot == 0 else "dqn"
        if kind == "lspi":
            steps, tested = (values[k][slot] for k in ("steps", "evaluation_episodes"))
            made.append(LSPI(steps=steps, evaluation_episodes=tested, **own))
        else:
            left_out = ("name", "learners", "lspi", "hidden")
            each = {k: v[slot] for k, v in values.items() if k not in left_out}
            made.append(api.DQN(**each, hidden=tuple(section["hidden"])))
    return made


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


@pytest.mark.parametrize("algorithm", ["fqi", "dqn"])
def test_an_order_of_ones_own_is_the_same_in_both(algorithm, monkeypatch):
    orders = ([0, 0, 2], [2, 2, 2], [2, 0, 2], [2, 1, 0], [0, 1])
    for order, transfer in itertools.product(orders, ("none", "shaping")):
        monkeypatch.setitem(CURRICULA, "mine", lambda n, order=order: order)
        chosen = {"curriculum": {"name": "mine"}, "transfer": CHOICES[2][transfer]}
        config = settled("car_on_hill", algorithm) | chosen
        assert outcome(by_command, config) == outcome(by_api, config)
        if len(order) == 3:
            made = compose.plan(config, "car_on_hill")
            named = "C-" in made.variant or "SC" in made.variant
            assert named == (len(set(order)) > 1)


@pytest.mark.parametrize(
    "order",
    [
        *([0, 1, 1], [0, 1, 3], [0, 1, -1], [], [0, 2], [0, 1, 2, 2]),
        *([False, True, 2], [0, 1, 2.0], [0, 1, "2"], "012", 2, None, {0, 1, 2}),
        *(np.arange(3.0), (i for i in range(3)), lambda n: [0, 1, n], lambda: [0]),
    ],
    ids=lambda order: str(order)[:20],
)
def test_a_curriculum_that_is_none_is_rejected_in_both(order, monkeypatch):
    """Out of range, too short or long, never at the target, no list of integers."""

    def mine(n):
        return order(n) if callable(order) else order

    monkeypatch.setitem(CURRICULA, "mine", mine)
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


def test_the_order_of_transfers_makes_no_difference():
    one, other = (api.stages(TASKS, FITTED, *t) for t in ((SHAPE, B), (B, SHAPE)))
    assert one == other and one[0].transfers == (B, SHAPE)


B, SHAPE, RPL, PPR = Boost(), Shape(), ResidualPolicy(), PolicyReuse()
LEARNED = StageResult(ZERO, ZERO)
DEEP, LINEAR = api.DQN(), [api.LinearSystem("lq", horizon=100), api.LinearSystem()]
REUSED = [replace(LINEAR[0], horizon=100)] * 2
REJECTED = {
    "nothing to reuse": (LINEAR[1:] * 2, DEEP, (PPR,), "transfer"),
    "nothing to add to": (LINEAR[1:] * 2, DEEP, (RPL,), "transfer"),
    "two meanings of an action": (LINEAR, DEEP, (B, RPL), "transfer"),
    "no vectors": (TASKS, DEEP, (RPL,), "transfer"),
    "one stage": (TASKS[:1], DEEP, (SHAPE,), "transfer"),
    "one boosted stage": (TASKS[:1], FITTED, (B,), "boosting"),
    "boosted twice": (TASKS, FITTED, (B, B), "transfers"),
    "two at once": (LINEAR, DEEP, (SHAPE, PPR), "transfers"),
    "a warm start besides": (TASKS, FITTED, (warm_start, B), "transfers"),
    "no transfer": (TASKS, FITTED, ("boost",), "transfers"),
    "no table": (TASKS, replace(FITTED, regressor=api.Tabular()), (), "regressor"),
    "fit of released DQN": (TASKS, FITTED, (Boost(maxima="two"),), "boosting"),
    "two families": (TASKS, [FITTED, DEEP, DEEP], (), "learners"),
    "a class": (TASKS, api.DQN, (), "learners"),
    "data for all seeds": (
        TASKS,
        replace(FITTED, shared_data=True, epsilon=0.5),
        (),
        "dataset",
    ),
    "no iterations": (TASKS, replace(FITTED, iterations=0), (), "iterations"),
    "half an episode": (TASKS, replace(FITTED, episodes=0.5), (), "episodes"),
    "a boolean": (TASKS, replace(FITTED, episodes=True), (), "episodes"),
    "epsilon": (TASKS, replace(DEEP, epsilon=1.5), (), "epsilon"),
    "no rate": (TASKS, replace(DEEP, learning_rate=0.0), (), "learning_rate"),
    "no layer": (TASKS, replace(DEEP, hidden=()), (), "hidden"),
    "small replay": (TASKS, replace(DEEP, replay_size=16), (), "replay_size"),
    "never learns": (TASKS, replace(DEEP, learning_starts=10_000), (), "replay_size"),
    "another network": (
        TASKS[:2],
        [DEEP, replace(DEEP, hidden=(8,))],
        (),
        "hidden",
    ),
    "another regressor": (
        TASKS[:2],
        [FITTED, replace(FITTED, regressor=api.Forest(trees=3))],
        (),
        "regressor",
    ),
    "LSPI not linear": (LINEAR, LSPI(), (B,), "learners"),
    "LSPI without a network": (LINEAR, [LSPI(), DEEP], (), "learners"),
    "LSPI twice": (REUSED, LSPI(), (B,), "learners"),
    "LSPI last": (LINEAR[::-1], [DEEP, LSPI()], (SHAPE,), "learners"),
    "LSPI's steps": (LINEAR, [LSPI(steps=2100), DEEP], (B,), "steps"),
    "LSPI's features": (LINEAR, [LSPI(features="cubic"), DEEP], (B,), "lspi.features"),
    "LSPI's noise": (LINEAR, [LSPI(noise_std=0.0), DEEP], (B,), "lspi.noise_std"),
}


@pytest.mark.parametrize("case", REJECTED)
def test_a_script_is_rejected_what_makes_no_sense(case):
    tasks, learners, transfers, key = REJECTED[case]
    with pytest.raises(ConfigError) as rejection:
        api.stages(tasks, learners, *transfers)
    assert rejection.value.key == key


def test_numbers_of_numpy_are_numbers():
    given = replace(FITTED, episodes=np.int64(3), epsilon=np.float64(0.5))
    assert len(api.stages(TASKS, given)) == 3


def test_one_of_several_lspi_stages_would_forget_the_others():
    """Written out in a config it is rejected; left to `auto` only the first is LSPI."""
    lq = ("env=linear_system", "algorithm=dqn", "boosting=on")
    lq += ("env.tasks.task=[lq,lq]", "env.tasks.horizon=[100,120]")
    lq += ("algorithm.steps=[2000,2400]", "algorithm.evaluation_episodes=5")
    with pytest.raises(ConfigError, match=r"algorithm\.learners=lspi.*first slot"):
        plans(*lq, "algorithm.learners=[lspi,lspi]", "curriculum=on")
    (made,) = plans(*lq, "curriculum=on")
    assert [stage.learner.name for stage in made.stages] == ["lspi", "dqn"]


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
            "on top": lambda: replace(start, base=Sum((start.base, previous.q))),
            "steering": lambda: replace(start, prior=previous.q, behavior=PPR),
            "network": lambda: replace(start, initial=Sum((previous.residual,))),
            "weights": lambda: replace(start, initial=previous.residual.online),
            "reading": lambda: replace(start, base=previous.q, boost=Boost("residual")),
        }[self.what]()


@pytest.mark.parametrize(
    ("what", "learner", "others", "key"),
    [
        ("nothing", FITTED, (), "transfer"),
        ("nothing", DEEP, (B,), "transfer"),
        ("no start", FITTED, (), "transfer"),
        ("base", FITTED, (B,), "boosting"),  # whose base it replaces
        ("base", FITTED, (), None),
        ("on top", FITTED, (B,), None),
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
    for what, random in (("base", 0), ("steering", 0), ("weights", 0)):
        stages = api.stages(TASKS, DEEP, Own(what))
        assert [s.learner.random_steps for s in stages] == [500, random, random]
    shaped = api.stages(TASKS, DEEP, SHAPE)
    assert {s.learner.random_steps for s in shaped} == {500}


def test_what_is_no_start_is_rejected_during_a_run_as_well():
    @dataclass(frozen=True)
    class Late:
        def __call__(self, start, previous):
            return previous.q.weights  # only a learned Q has some

    learned = begin([warm_start], None)
    assert learned == StageInit() and len(api.stages(TASKS, DEEP, Late())) == 3
    with pytest.raises(ConfigError, match="transfer"):
        begin([Late()], replace(LEARNED, q=SimpleNamespace(weights=())))
