"""The rule book of courses, from which the command line and `bcrl.api` make stages."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import accumulate, pairwise
from numbers import Integral, Real
from typing import Any, cast

from bcrl.common.checks import one_of
from bcrl.common.identity import Plain
from bcrl.config.variant import Composition, Past
from bcrl.envs import Env, is_finite
from bcrl.errors import ConfigError
from bcrl.learning.dqn import DQN
from bcrl.learning.fqi import FQI
from bcrl.learning.line_search import LEAST
from bcrl.learning.lspi import LSPI
from bcrl.learning.stage import Learner, Stage
from bcrl.learning.transfer import NEVER, SEARCH, Boost, Shape, StageInit, warm_start
from bcrl.learning.transitions import LoggedFile, transitions_of
from bcrl.q.functions import ZERO
from bcrl.q.quadratic import FEATURES

ABOVE_0 = math.nextafter(0.0, 1.0)
#: A type, the least and the greatest value, and the settings that have them.
BOUNDS: tuple[tuple[Any, float, float, str], ...] = (
    (Integral, 1, math.inf, "iterations episodes steps target_update batch_size"),
    (Integral, 1, math.inf, "replay_size evaluate_every evaluation_episodes lockstep"),
    (Integral, 1, math.inf, "workers threads max_iterations max_episodes max_steps"),
    (Integral, 0, math.inf, "random_steps learning_starts anneal_steps"),
    (Real, 0, 1, "epsilon epsilon_start evaluation_epsilon"),
    (Real, ABOVE_0, math.inf, "learning_rate noise_std checkpoint_every"),
    (Integral, 0, 2**32, "first"),
    (Integral, 1, 10**6, "count"),
)
#: Settings that a warm start passes on, so that they can't differ between slots.
PASSED_ON = {FQI: ("regressor",), DQN: ("hidden", "learning_rate")}


def course(chosen: Composition, learners: Sequence[Learner]) -> tuple[Stage, ...]:
    """The stages of a composition, given the learner of each slot.

    One stage per slot; plain DQN has one in all, with the steps of all slots and the
    other settings of the last. The scale caps the budgets. Raises ConfigError for what
    can't be learned, or would have no effect.
    """
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
    past = chosen.past or Past(0, 0, ())
    known_tasks = [*past.tasks, *(t for t in chosen.tasks if t not in past.tasks)]
    for number, (task, learner) in enumerate(slots, start=past.stages + 1):
        env = chosen.tasks[task]
        if isinstance(learner, FQI) and not learner.new_data:
            learner = _with_data(learner, env, made)
        if isinstance(learner, DQN) and number > 1 and has_policy:
            learner = replace(learner, random_steps=0)
        place = known_tasks.index(env) + 1 if past.tasks else task + 1
        own = task + 1 if past.tasks else 0
        made.append(Stage(number, place, env, learner, chosen.transfers, 0, own))
    ready = [_capped(stage.learner, chosen.scale) for stage in made]
    before = accumulate((learner.length for learner in ready), initial=past.count)
    each = zip(made, ready, before, strict=False)
    return tuple(replace(stage, learner=x, before=n) for stage, x, n in each)


def _capped(learner: Learner, scale: Plain) -> Learner:
    """A learner of ours with a scale's caps on its budget, which LSPI has none of."""
    if not isinstance(learner, FQI | DQN):
        return learner
    caps = {k: scale.get(f"max_{k}") for k in ("iterations", "episodes", "steps")}
    own = vars(learner).items()
    return replace(learner, **{k: min(v, caps[k]) for k, v in own if caps.get(k)})


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
            _check_logged(chosen, learners, slot)
        elif isinstance(learner, DQN):
            _check_dqn(chosen, learner, start)
        elif isinstance(learner, LSPI):
            _check_slot(chosen, learner, slot, start)
        elif (start.alpha, start.boost.fold) != (1.0, NEVER):
            key = "alpha" if start.alpha != 1.0 else "fold"
            why = f"is for FQI and DQN; {type(learner).__name__} has the base as it is"
            raise ConfigError(f"boosting.{key}", getattr(start.boost, key), why)
    if chosen.past and start.initial is not ZERO:
        given = chosen.past.learner
        if isinstance(learners[0], DQN) and not isinstance(given, DQN):
            why = "leaves no network to train further: boosting=on or a transfer needed"
            raise ConfigError("start.from", getattr(given, "name", given), why)
        learners = [given, *learners] if given else learners
    for one, other in pairwise(learners):
        for name in PASSED_ON.get(type(other), ()) if start.initial is not ZERO else ():
            here, there = getattr(one, name, None), getattr(other, name)
            if here != there:
                why = f"was {here} in the slot before; a warm start keeps it"
                raise ConfigError(f"algorithm.{name}", there, why)


def _check_fqi(chosen: Composition, learner: FQI, env: Env, start: StageInit) -> None:
    check_numbers("algorithm", vars(learner))
    regressor, why = learner.regressor, ""
    loss = Boost.fold_loss  # the factor and folding go with FQI, too
    boost = replace(start.boost, alpha=1.0, fold="never", fold_loss=loss)
    key, value = "algorithm.regressor", cast(Any, regressor)
    if isinstance(regressor, type) or not hasattr(regressor, "finite_only"):
        why = "is no regressor of ours; Sklearn(estimator) makes one of scikit-learn's"
    elif regressor.finite_only and not is_finite(env):
        why = f"needs finitely many states, which {env.name} has not"
    elif learner.shared_data and learner.epsilon < 1:
        key, value = "algorithm.dataset", "shared"
        why = "seeds can share data only if all are random: algorithm.epsilon must be 1"
    elif chosen.boost and boost != Boost():
        key, value = "boosting", chosen.boost
        why = "is the released DQN's; FQI learns with the paper's, boosting=on"
    elif start.behavior or (boost, start.shape or Shape()) != (Boost(), Shape()):
        key, value = "transfer", chosen.transfer
        why = "is for algorithm=dqn; FQI learns with transfer=shaping, or without one"
    if why:
        raise ConfigError(key, value, why)


def _check_logged(chosen: Composition, learners: Sequence[Any], slot: int) -> None:
    """Raise ConfigError for logged data that are not those of the slot's task."""
    data, env, task = learners[slot].dataset, chosen.slots[slot], chosen.order[slot] + 1
    unread = isinstance(data, LoggedFile) and not data.is_named
    if data is None or unread or transitions_of(data, task, env).task is not None:
        return
    for other, learner in zip(chosen.slots, learners, strict=True):
        if getattr(learner, "dataset", None) == data and other != env:
            why = "has no array `task`, so it suits one task: name one dataset per slot"
            raise ConfigError("algorithm.dataset", data, why)


def _check_dqn(chosen: Composition, learner: DQN, start: StageInit) -> None:
    check_numbers("algorithm", vars(learner))
    size, widths, why = learner.replay_size, learner.hidden, ""
    key, value = "algorithm.replay_size", cast(Any, size)
    if size < learner.batch_size or size <= learner.learning_starts:
        why = f"must hold a batch and exceed learning_starts={learner.learning_starts}"
    elif not widths or not all(isinstance(w, Integral) and w >= 1 for w in widths):
        key, value = "algorithm.hidden", list(widths)
        why = "must be a list of layer widths, each at least 1"
    elif start.alpha == SEARCH and learner.learning_starts + 1 < LEAST:
        key, value = "algorithm.learning_starts", learner.learning_starts
        why = f"must be at least {LEAST - 1}: a line search needs {LEAST} transitions"
    elif start.initial is not ZERO and chosen.transfers != (warm_start,):
        key, value = "transfer", chosen.transfer
        why = "sets `initial`, but DQN needs networks there: set `base` or `prior`"
    if why:
        raise ConfigError(key, value, why)


def _check_slot(chosen: Composition, lspi: LSPI, slot: int, start: StageInit) -> None:
    check_lspi(lspi)
    env, why = chosen.slots[slot], ""
    if getattr(env, "linear_quadratic", None) is None or not hasattr(env, "push"):
        why = f"learns quadratic Q-functions, but {env} is no linear-quadratic task"
    elif start.initial is not ZERO and len(chosen.order) > 1:
        why = "leaves no network to start DQN's from: boosting=on or a transfer needed"
    elif slot or chosen.past:
        why = "starts from nothing: LSPI in the first slot only, DQN in the others"
    if why:
        raise ConfigError("algorithm.learners", lspi.name, why)
    lspi.episodes_per_iteration(env)  # says whether they are whole


def check_lspi(learner: LSPI) -> None:
    """Raise ConfigError for settings of LSPI's out of bounds."""
    check_numbers("algorithm.lspi", vars(learner))
    one_of("algorithm.lspi.features", learner.features, FEATURES)


def check_numbers(section: str, values: Mapping[str, Any]) -> None:
    """Raise ConfigError for a setting out of its bounds."""
    for kind, least, most, names in BOUNDS:
        for name in (each for each in names.split() if each in values):
            value = values[name]
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
