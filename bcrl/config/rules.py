"""The rule book: which learners, tasks and transfers make a course of stages.

The command line and `bcrl.api` both make their stages here, so what one of them makes
or rejects, the other does, too.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import accumulate, pairwise
from numbers import Integral, Real
from typing import Any, cast

from bcrl.common.checks import one_of
from bcrl.config.variant import Composition
from bcrl.envs import Env, is_finite
from bcrl.errors import ConfigError
from bcrl.learning.dqn import DQN
from bcrl.learning.fqi import FQI
from bcrl.learning.lspi import LSPI
from bcrl.learning.stage import Learner, Stage
from bcrl.learning.transfer import Boost, Shape, StageInit, warm_start
from bcrl.q.functions import ZERO
from bcrl.q.quadratic import FEATURES

_COUNTS = (
    *("iterations", "episodes", "steps", "target_update", "batch_size", "replay_size"),
    *("evaluate_every", "evaluation_episodes", "lockstep", "workers", "threads"),
    *("max_iterations", "max_episodes", "max_steps"),
)
_STEPS = ("random_steps", "learning_starts", "anneal_steps")
_PROBABILITIES = ("epsilon", "epsilon_start", "evaluation_epsilon")
_POSITIVE = ("learning_rate", "noise_std", "checkpoint_every")
ABOVE_0 = math.nextafter(0.0, 1.0)
#: A setting's type, its least and its greatest value.
BOUNDS = {
    **dict.fromkeys(_COUNTS, (Integral, 1, math.inf)),
    **dict.fromkeys(_STEPS, (Integral, 0, math.inf)),
    **dict.fromkeys(_PROBABILITIES, (Real, 0, 1)),
    **dict.fromkeys(_POSITIVE, (Real, ABOVE_0, math.inf)),
    **{"first": (Integral, 0, 2**32), "count": (Integral, 1, 10**6)},
}
#: What FQI knows of shaping: none, or the paper's.
SHAPES = (None, Shape())
#: Settings that a warm start passes on, so that they can't differ between slots.
PASSED_ON = {FQI: ("regressor",), DQN: ("hidden", "learning_rate")}


def course(chosen: Composition, learners: Sequence[Learner]) -> tuple[Stage, ...]:
    """The stages of a composition, given the learner of each slot.

    One stage per slot. Plain DQN has one in all, with the steps of all slots and the
    other settings of the last: its networks, task and replay stay the same. Raises
    ConfigError for what can't be learned, or would have no effect.
    """
    chosen.check()
    _check(chosen, learners)
    slots = list(zip(chosen.order, learners, strict=True))
    all_dqn = [learner for learner in learners if isinstance(learner, DQN)]
    warm = chosen.transfers == (warm_start,)
    if warm and chosen.target_only and len(all_dqn) == len(learners):
        steps = sum(learner.steps for learner in all_dqn)
        slots = [(chosen.order[-1], replace(all_dqn[-1], steps=steps))]
    # Whoever starts without a policy fills the replay at random; shaping gives none.
    start, made = chosen.start, list[Stage]()
    known = (start.base, start.initial, start.prior) if start else ()
    has_policy = start is None or any(q is not ZERO for q in known)
    for number, (task, learner) in enumerate(slots, start=1):
        env = chosen.tasks[task]
        if isinstance(learner, FQI) and not learner.new_data:
            learner = _with_data(learner, env, made)
        if isinstance(learner, DQN) and made and has_policy:
            learner = replace(learner, random_steps=0)
        made.append(Stage(number, task + 1, env, learner, chosen.transfers, 0))
    return _placed(made)


def capped(
    stages: Sequence[Stage], kind: type[FQI] | type[DQN], **most: int | None
) -> tuple[Stage, ...]:
    """The stages with a scale's caps on the budgets of one kind of learner."""
    made = []
    for stage in stages:
        learner = stage.learner
        if isinstance(learner, kind):
            caps = {k: min(getattr(learner, k), cap) for k, cap in most.items() if cap}
            learner = replace(learner, **caps)
        made.append(replace(stage, learner=learner))
    return _placed(made)


def _check(chosen: Composition, learners: Sequence[Learner]) -> None:
    """Raise ConfigError for learners that don't suit the slots, or each other."""
    n, start = len(chosen.order), chosen.start or StageInit()
    if len(learners) != n:
        why = f"there are {len(learners)} learners for {n} slots"
        raise ConfigError("algorithm.learners", list(learners), why)
    for slot, learner in enumerate(learners):
        same = isinstance(learner, FQI) == isinstance(learners[-1], FQI)
        if isinstance(learner, type) or not hasattr(learner, "learn") or not same:
            why = "is no learner with `learn`, such as DQN(), or stands beside FQI"
            raise ConfigError("algorithm.learners", learner, why)
        if isinstance(learner, FQI):
            _check_fqi(chosen, learner, chosen.slots[slot], start)
        elif isinstance(learner, DQN):
            _check_dqn(chosen, learner, start)
        elif isinstance(learner, LSPI):
            _check_slot(chosen, learner, slot, start)
    for one, other in pairwise(learners):
        for name in PASSED_ON.get(type(other), ()) if start.initial is not ZERO else ():
            here, there = getattr(one, name, None), getattr(other, name)
            if here != there:
                why = f"was {here} in the slot before; a warm start keeps it"
                raise ConfigError(f"algorithm.{name}", there, why)


def _check_fqi(chosen: Composition, learner: FQI, env: Env, start: StageInit) -> None:
    check_numbers("algorithm", vars(learner))
    regressor, why = learner.regressor, ""
    key, value = "algorithm.regressor", cast(Any, regressor)
    if isinstance(regressor, type) or not hasattr(regressor, "finite_only"):
        why = (
            "is no regressor of bcrl's; Sklearn(estimator) makes one of scikit-learn's"
        )
    elif regressor.finite_only and not is_finite(env):
        why = f"needs finitely many states, which {env.name} has not"
    elif learner.shared_data and learner.epsilon < 1:
        key, value = "algorithm.dataset", "shared"
        why = "seeds can share data only if all are random: algorithm.epsilon must be 1"
    elif chosen.boost and start.boost != Boost():
        key, value = "boosting", chosen.boost
        why = "is the released DQN's; FQI learns with the paper's, boosting=on"
    elif (start.behavior, start.boost) != (None, Boost()) or start.shape not in SHAPES:
        key, value = "transfer", chosen.transfer
        why = "is for algorithm=dqn; FQI learns with transfer=shaping, or without one"
    if why:
        raise ConfigError(key, value, why)


def _check_dqn(chosen: Composition, learner: DQN, start: StageInit) -> None:
    check_numbers("algorithm", vars(learner))
    size, widths, why = learner.replay_size, learner.hidden, ""
    key, value = "algorithm.replay_size", cast(Any, size)
    if size < learner.batch_size or size <= learner.learning_starts:
        why = f"must hold a batch, batch_size={learner.batch_size}, and more than "
        why += f"learning_starts={learner.learning_starts}"
    elif not widths or not all(isinstance(w, Integral) and w >= 1 for w in widths):
        key, value = "algorithm.hidden", list(widths)
        why = "must be a list of layer widths, each at least 1"
    elif start.initial is not ZERO and chosen.transfers != (warm_start,):
        key, value = "transfer", chosen.transfer
        why = "sets `initial`, but DQN starts from networks: set `base`, `potential` "
        why += "or `prior`"
    if why:
        raise ConfigError(key, value, why)


def _check_slot(chosen: Composition, lspi: LSPI, slot: int, start: StageInit) -> None:
    env = chosen.slots[slot]
    if getattr(env, "linear_quadratic", None) is None or not hasattr(env, "push"):
        why = "learns quadratic Q-functions of continuous actions, but "
        why += f"{env} is no linear-quadratic task"
    elif start.initial is not ZERO:
        why = "leaves no network to start DQN's from: boosting=on or a transfer needed"
    elif slot:
        why = f"starts from nothing, so slot {slot + 1} would drop what the one before "
        why += "has learned: LSPI in the first slot, DQN in the others"
    else:
        check_lspi(lspi)
        lspi.episodes_per_iteration(env)  # says whether they are whole
        return
    raise ConfigError("algorithm.learners", lspi.name, why)


def check_lspi(learner: LSPI) -> None:
    """Raise ConfigError for settings of LSPI's out of bounds."""
    check_numbers("algorithm.lspi", vars(learner))
    one_of("algorithm.lspi.features", learner.features, FEATURES)


def check_numbers(section: str, values: Mapping[str, Any]) -> None:
    """Raise ConfigError for a setting out of its bounds."""
    for name, (kind, least, most) in BOUNDS.items():
        value = values.get(name, least)
        fits = isinstance(value, kind) and not isinstance(value, bool)
        if not fits or not least <= value <= most or value == math.inf:
            noun = "an integer" if kind is Integral else "a number"
            bounds = f"of at least {least}" if least != ABOVE_0 else "above 0"
            bounds = f"from {least} to {most}" if most < math.inf else bounds
            key = f"{section}.{name}".lstrip(".")
            raise ConfigError(key, value, f"must be {noun} {bounds}")


def _with_data(learner: FQI, env: Env, before: Sequence[Stage]) -> FQI:
    """With new data unless the stage before had this task, whose data are kept then."""
    if not before or before[-1].env != env:
        return replace(learner, new_data=True)
    kept: Any = before[-1].learner
    if (learner.epsilon, learner.episodes) != (kept.epsilon, kept.episodes):
        why = "the task's data are kept, so epsilon and episodes must stay the same"
        raise ConfigError("algorithm.new_data", "task", why)
    return learner


def _placed(stages: Sequence[Stage]) -> tuple[Stage, ...]:
    """Stages whose `before` counts what the ones before them take."""
    lengths = accumulate((stage.learner.length for stage in stages), initial=0)
    return tuple(replace(s, before=n) for s, n in zip(stages, lengths, strict=False))
