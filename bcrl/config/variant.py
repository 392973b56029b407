"""What curriculum, boosting and transfer choose: an order of tasks, and transfers."""

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from bcrl.common import plugins
from bcrl.common.checks import construct, one_of
from bcrl.common.identity import Plain
from bcrl.config.schema import Choice
from bcrl.envs import Env
from bcrl.errors import ConfigError
from bcrl.learning import transfer as handed
from bcrl.learning.curriculum import CURRICULA
from bcrl.q.functions import ZERO

ONE_TASK = "there is one task; env.tasks needs at least two values"


@dataclass(frozen=True)
class Past:
    """What was learned before the first stage, by the run that it starts from."""

    stages: int
    count: int  # iterations or environment steps
    tasks: tuple[Env, ...]
    learner: Any = None  # of the last stage; None if its approximator isn't passed on


@dataclass(frozen=True)
class Composition:
    """What the groups besides `algorithm` choose, as an algorithm sees it."""

    tasks: tuple[Env, ...]  # easiest first, the target last
    order: tuple[int, ...]  # the task of each slot
    boost: handed.Boost | None = None
    transfer: handed.Transfer | None = None
    scale: Plain = field(default_factory=dict)
    past: Past | None = None  # None: the first stage starts from nothing

    @property
    def transfers(self) -> tuple[handed.Transfer, ...]:
        """What happens between two stages: a warm start unless something else does."""
        return self._chosen or (handed.warm_start,)

    @property
    def _chosen(self) -> tuple[handed.Transfer, ...]:
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
    def start(self) -> handed.StageInit | None:
        """What a later stage starts from, as far as transfers tell without training."""
        return handed.tried(self.transfers)

    def __post_init__(self) -> None:
        """Raise ConfigError for choices that make no sense together."""
        boost, transfer, start = self.boost, self.transfer, self.start
        if len(self.order) == 1 and self._chosen and self.past is None:
            key = "boosting" if boost else "transfer"
            raise ConfigError(key, boost or transfer, ONE_TASK)
        if start is None:
            return
        why, residual = "", isinstance(start.behavior, handed.ResidualPolicy)
        if start.behavior and self.target_only and self.past is None:
            why = "needs an earlier task whose policy helps: curriculum=on"
        elif residual and getattr(self.tasks[-1], "actions", None) is None:
            why = "combines actions as vectors, which env.action_vectors has to name"
        elif residual and start.base is not ZERO:
            why = "learns Q of learned actions, a base of executed ones: boosting=off"
        if why:
            raise ConfigError("transfer", transfer, why)
        for key, one in (("transfer", transfer), ("boosting", boost)):
            rest = tuple(other for other in self._chosen if other is not one)
            if one is not None and handed.tried(rest) == start:
                raise ConfigError(key, one, "has no effect: stages start as without it")


def method_name(
    algorithm: str, transfers: Sequence[handed.Transfer], target_only: bool
) -> str:
    """`SBC-DQN` and the like; policy reuse and residual policy by their own names."""
    others = [t for t in transfers if not isinstance(t, handed.Boost)]
    boosted = len(others) < len(transfers)
    transfer = next((t for t in others if t is not handed.warm_start), None)
    shaped = isinstance(transfer, handed.Shape)
    prefix = "S" * shaped + "B" * boosted + "C" * (not target_only)
    whole = f"{prefix}-{algorithm.rpartition('.')[2].upper()}".lstrip("-")
    if isinstance(transfer, handed.ResidualPolicy):
        return "RPL"
    if isinstance(transfer, handed.PolicyReuse):
        return f"PPR-{whole}" if boosted else "PPR"
    if transfer is None or shaped:
        return whole
    own = getattr(transfer, "__name__", type(transfer).__name__)
    return f"{own.strip('<>')}-{whole}"  # a function may be a lambda


def composition(config: Plain, tasks: list[Env], past: Past | None) -> Composition:
    """The groups' choices; ConfigError if they make no sense together."""
    boost = _component("boosting", config["boosting"], {"on": handed.Boost})
    transfer = _component("transfer", config["transfer"], handed.TRANSFERS)
    order = order_of(config["curriculum"]["name"], tasks, past)
    return Composition(tuple(tasks), order, boost, transfer, config["scale"], past)


def order_of(
    curriculum: object, tasks: Sequence[Env], past: Past | None = None
) -> tuple[int, ...]:
    """The task of each of n slots; ConfigError for an order without the target.

    `curriculum` is one of CURRICULA, a trusted `module.function` or a function of n.
    """
    n = len(tasks)
    if n == 1 and curriculum != "off" and past is None:
        raise ConfigError("curriculum", curriculum, ONE_TASK)
    ordered: Any = curriculum
    if isinstance(curriculum, str) and "." in curriculum:
        ordered = plugins.attribute("curriculum.name", curriculum, curriculum)
    elif not callable(curriculum):
        one_of("curriculum.name", curriculum, list(CURRICULA))
        ordered = CURRICULA[str(curriculum)]
    try:
        found, again = ordered(n), ordered(n)
        order = tuple(map(operator.index, found))
        whole = isinstance(found, list | tuple | range) and bool not in map(type, found)
        fits = len(order) == n and {n - 1} <= set(order) <= set(range(n))
        same = list(found) == list(again)
    except Exception as error:  # whatever a function of the user's does
        why = f"failed for {n} tasks: {type(error).__name__}: {error}"
        raise ConfigError("curriculum", curriculum, why) from error
    if not (whole and fits and same):
        why = f"visits {found!r:.80}, but must always return the same list of {n} "
        why += f"integers from 0 to {n - 1}, with the target, {n - 1}, among them"
        raise ConfigError("curriculum", curriculum, why)
    return order


def _component(group: str, section: Plain, classes: Mapping[str, type]) -> Any:
    """The transfer that a section names, one of ours or a trusted `module.Class`."""
    values = dict(section)
    name, nothing = values.pop("name", None), "off" if group == "boosting" else "none"
    if name == nothing:
        construct(group, Choice, section)
        return None
    if group == "transfer" and isinstance(name, str) and "." in name:
        return construct(group, plugins.component("transfer.name", name, name), values)
    one_of(f"{group}.name", name, [nothing, *classes])
    return construct(group, classes[name], values)
