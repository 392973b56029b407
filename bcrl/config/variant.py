"""What curriculum, boosting and transfer choose: an order of tasks, and transfers."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property

from bcrl.common import plugins
from bcrl.common.checks import construct, one_of
from bcrl.common.identity import Plain
from bcrl.config.schema import Choice
from bcrl.envs import Env
from bcrl.errors import ConfigError
from bcrl.learning.curriculum import CURRICULA
from bcrl.learning.transfer import (
    TRANSFERS,
    Boost,
    ResidualPolicy,
    Shape,
    StageInit,
    Transfer,
    tried,
    warm_start,
)
from bcrl.q.functions import ZERO


@dataclass(frozen=True)
class Composition:
    """What the groups besides `algorithm` choose, as an algorithm sees it."""

    tasks: tuple[Env, ...]  # easiest first, the target last
    order: tuple[int, ...]  # the task of each slot
    boost: Boost | None = None
    transfer: Transfer | None = None
    scale: Plain = field(default_factory=dict)
    written: Mapping[str, object] = field(default_factory=dict)  # key → as it was named

    @property
    def transfers(self) -> tuple[Transfer, ...]:
        """What happens between two stages: a warm start unless something else does."""
        return self._chosen or (warm_start,)

    @property
    def _chosen(self) -> tuple[Transfer, ...]:
        return tuple(t for t in (self.boost, self.transfer) if t is not None)

    @property
    def slots(self) -> tuple[Env, ...]:
        """The environment of each slot."""
        return tuple(self.tasks[task] for task in self.order)

    @property
    def target_only(self) -> bool:
        """Whether every slot has the target, or a task that is equal to it."""
        return all(env == self.tasks[-1] for env in self.slots)

    @cached_property
    def start(self) -> StageInit | None:
        """What a later stage starts from, as far as transfers tell without training."""
        return tried(self.transfers)

    def refusal(self, key: str, value: object, why: str) -> ConfigError:
        """A ConfigError that names `value` as the caller did."""
        return ConfigError(key, self.written.get(key, value), why)

    def check(self) -> None:
        """Raise ConfigError for choices that make no sense together."""
        boost, transfer, start = self.boost, self.transfer, self.start
        if len(self.order) == 1 and self._chosen:
            key = "boosting" if boost else "transfer"
            raise self.refusal(key, boost or transfer, _one_task(self.tasks[-1]))
        if start is None:
            return
        if start.behavior and self.target_only:
            why = "needs an earlier task whose policy helps: curriculum=on"
            raise self.refusal("transfer", transfer, why)
        if isinstance(start.behavior, ResidualPolicy):
            if getattr(self.tasks[-1], "actions", None) is None:
                why = (
                    "combines actions as vectors, which env.action_vectors has to name"
                )
                raise self.refusal("transfer", transfer, why)
            if start.base is not ZERO:
                why = "its Q is about its own actions, not the executed ones that a "
                raise self.refusal(
                    "transfer", transfer, why + "base is about: boosting=off"
                )
        for key, one, other in (
            ("transfer", transfer, boost),
            ("boosting", boost, transfer),
        ):
            rest = () if other is None else (other,)
            if one is not None and tried(rest) == start:
                why = "has no effect: the next stage starts as it does without"
                raise self.refusal(key, one, why)


def composition(config: Plain, tasks: list[Env]) -> Composition:
    """The groups' choices; `check` says whether they make sense together."""
    boost, transfer = boost_of(config["boosting"]), transfer_of(config["transfer"])
    made = Composition(
        tuple(tasks),
        order_of(config["curriculum"]["name"], tasks),
        boost,
        transfer,
        config["scale"],
        {
            "boosting": _option(config["boosting"]["name"], boost),
            "transfer": _option(config["transfer"]["name"], transfer),
        },
    )
    if len(tasks) == 1 and not (made.start and made.start.behavior):
        made.check()  # before budgets, which are lists with one entry per task
    return made


def order_of(curriculum: object, tasks: Sequence[Env]) -> tuple[int, ...]:
    """The task of each slot: as many slots as tasks, the target among them.

    `curriculum` is one of CURRICULA, a trusted `module.function` or a function from the
    number of tasks to their order. Raises ConfigError for an order that is none.
    """
    n = len(tasks)

    def wrong(why: str) -> ConfigError:
        return ConfigError("curriculum", curriculum, why)

    if n == 1 and curriculum != "off":
        raise wrong(_one_task(tasks[-1]))
    ordered = curriculum if callable(curriculum) else _curriculum(curriculum)
    try:
        found, again = ordered(n), ordered(n)
    except Exception as error:  # whatever a function of the user's does
        raise wrong(f"failed for {n} tasks: {type(error).__name__}: {error}") from error
    try:
        fits = isinstance(found, (list, tuple, range)) and not any(
            isinstance(task, bool) for task in found
        )
        order = tuple(operator.index(task) for task in found) if fits else ()
    except TypeError:
        order = ()
    if not order or not set(order) <= set(range(n)):
        why = f"visits {found!r:.80}, but must return a list of {n} integers"
        raise wrong(f"{why}, tasks from 0 to {n - 1}")
    if len(order) != n:
        why = f"has {len(order)} slots, budgets are lists with one entry a task"
        raise wrong(f"{why} ({n})")
    if list(again) != list(found):
        raise wrong(
            f"visits {found}, then {again}: it must depend on its argument only"
        )
    if n - 1 not in order:
        why = f"visits {found}, never the target, which is task {n - 1}"
        raise wrong(f"{why}: a run is measured in the target, so let a slot have it")
    return order


def _one_task(env: Env) -> str:
    why = f"{env.name} has one task, so there is no stage to hand over"
    return f"{why}; env.tasks needs at least two values"


def _curriculum(name: object) -> Callable[[int], list[int]]:
    """The order called `name`, or a trusted function `module.name` of the user's."""
    if isinstance(name, str) and "." in name:
        found = plugins.attribute("curriculum.name", name, name)
        if not callable(found):
            raise ConfigError("curriculum.name", name, "must be a function")
        return found
    one_of("curriculum.name", name, list(CURRICULA))
    return CURRICULA[name]


def _option(name: str, chosen: object) -> str:
    """The option of conf/ that a choice is: the released readings turn every switch."""
    switches = fields(chosen) if isinstance(chosen, (Boost, Shape)) else ()
    if switches and all(getattr(chosen, s.name) != s.default for s in switches):
        return "released" if isinstance(chosen, Boost) else f"{name}_released"
    return name


def boost_of(section: Plain) -> Boost | None:
    values = _named("boosting", section, ["on", "off"])
    if section["name"] == "off":
        construct("boosting", Choice, section)
        return None
    boost = construct("boosting", Boost, values)
    one_of("boosting.greedy_on", boost.greedy_on, ["sum", "residual"])
    one_of("boosting.maxima", boost.maxima, ["one", "two"])
    return boost


def transfer_of(section: Plain) -> Transfer | None:
    """The transfer chosen besides boosting, one of ours or a trusted `module.Class`."""
    name = section.get("name") if isinstance(section, dict) else None
    own = [name] if isinstance(name, str) and "." in name else []
    values = _named("transfer", section, ["none", *TRANSFERS, *own])
    if name == "none":
        construct("transfer", Choice, section)
        return None
    cls = plugins.component("transfer.name", name, name) if own else TRANSFERS[name]
    transfer = construct("transfer", cls, values)
    if isinstance(transfer, Shape):
        one_of("transfer.next_state", transfer.next_state, ["stored", "before_reset"])
    return transfer


def _named(group: str, section: object, names: list[str]) -> Plain:
    """A section's values besides its name, which must be one of `names`."""
    if not isinstance(section, dict):
        raise ConfigError(group, section, "must be a section with a name")
    one_of(f"{group}.name", section.get("name"), names)
    return {key: value for key, value in section.items() if key != "name"}
