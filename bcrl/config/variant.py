"""What curriculum, boosting and transfer choose: an order of tasks, and transfers."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

from bcrl.common import plugins
from bcrl.common.checks import construct, one_of
from bcrl.common.identity import Plain
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

    def error(self, key: str, value: object, why: str) -> ConfigError:
        """A ConfigError that names `value` as the caller did."""
        return ConfigError(key, self.written.get(key, value), why)

    def check(self) -> None:
        """Raise ConfigError for choices that make no sense together."""
        boost, transfer, start = self.boost, self.transfer, self.start
        if len(self.order) == 1 and self._chosen:
            key = "boosting" if boost else "transfer"
            raise self.error(key, boost or transfer, _one_task(self.tasks[-1]))
        if start is None:
            return
        why, residual = "", isinstance(start.behavior, ResidualPolicy)
        if start.behavior and self.target_only:
            why = "needs an earlier task whose policy helps: curriculum=on"
        elif residual and getattr(self.tasks[-1], "actions", None) is None:
            why = "combines actions as vectors, which env.action_vectors has to name"
        elif residual and start.base is not ZERO:
            why = (
                "its Q is about its own actions, not the executed ones that a base is "
            )
            why += "about: boosting=off"
        if why:
            raise self.error("transfer", transfer, why)
        for key, one, other in (
            ("transfer", transfer, boost),
            ("boosting", boost, transfer),
        ):
            rest = () if other is None else (other,)
            if one is not None and tried(rest) == start:
                why = "has no effect: the next stage starts as it does without"
                raise self.error(key, one, why)


def composition(config: Plain, tasks: list[Env]) -> Composition:
    """The groups' choices; `check` says whether they make sense together."""
    boost = _component("boosting", config["boosting"], {"off": _Nothing, "on": Boost})
    transfers = {"none": _Nothing, **TRANSFERS}
    transfer = _component("transfer", config["transfer"], transfers)
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
    if n == 1 and curriculum != "off":
        raise ConfigError("curriculum", curriculum, _one_task(tasks[-1]))
    ordered = curriculum if callable(curriculum) else _curriculum(curriculum)
    try:
        found: Any = ordered(n)
        again = ordered(n)
        listed = isinstance(found, (list, tuple, range)) and bool not in map(
            type, found
        )
        order = tuple(map(operator.index, found)) if listed else ()
        same = list(found) == list(again)
    except Exception as error:  # whatever a function of the user's does
        why = f"failed for {n} tasks: {type(error).__name__}: {error}"
        raise ConfigError("curriculum", curriculum, why) from error
    if len(order) != n or not set(order) <= set(range(n)) or n - 1 not in order:
        why = f"visits {found!r:.80}, but must return a list of {n} integers from 0 to "
        why += f"{n - 1}, one per slot, with the target, {n - 1}, among them"
        raise ConfigError("curriculum", curriculum, why)
    if not same:
        why = f"visits {found}, then {again}: it must depend on its argument only"
        raise ConfigError("curriculum", curriculum, why)
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
    return CURRICULA[str(name)]


def _option(name: str, chosen: object) -> str:
    """The option of conf/ that a choice is: the released readings turn every switch."""
    switches = fields(chosen) if isinstance(chosen, (Boost, Shape)) else ()
    if switches and all(getattr(chosen, s.name) != s.default for s in switches):
        return "released" if isinstance(chosen, Boost) else f"{name}_released"
    return name


@dataclass(frozen=True)
class _Nothing:
    """`boosting=off`, `transfer=none`."""


#: The values of switches that follow the paper or the authors' code.
_SWITCHES = {
    "greedy_on": ("sum", "residual"),
    "maxima": ("one", "two"),
    "next_state": ("stored", "before_reset"),
}


def _component(group: str, section: object, classes: Mapping[str, type]) -> Any:
    """The transfer that a section names, one of ours or a trusted `module.Class`."""
    if not isinstance(section, dict):
        raise ConfigError(group, section, "must be a section with a name")
    values = dict(section)
    name = values.pop("name", None)
    if group == "transfer" and isinstance(name, str) and "." in name:
        return construct(group, plugins.component("transfer.name", name, name), values)
    one_of(f"{group}.name", name, list(classes))
    made = construct(group, classes[name], values)
    for key in _SWITCHES.keys() & values.keys():
        one_of(f"{group}.{key}", values[key], _SWITCHES[key])
    return None if isinstance(made, _Nothing) else made
