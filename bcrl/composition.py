"""What curriculum, boosting and transfer choose: an order of tasks, and transfers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from bcrl import trust
from bcrl.config import Choice, construct, one_of
from bcrl.curriculum import CURRICULA
from bcrl.envs import Env
from bcrl.errors import ConfigError
from bcrl.identity import Plain
from bcrl.stage import Stage
from bcrl.transfer import (
    TRANSFERS,
    Boost,
    PolicyReuse,
    ResidualPolicy,
    Shape,
    Transfer,
    warm_start,
)


@dataclass(frozen=True)
class Composition:
    """What the groups besides `algorithm` choose, as an algorithm sees it."""

    tasks: tuple[Env, ...]  # easiest first, the target last
    order: tuple[int, ...]  # the task of each slot
    boost: Boost | None
    transfer: Transfer | None
    scale: Plain

    @property
    def transfers(self) -> tuple[Transfer, ...]:
        """What happens between two stages: a warm start unless something else does."""
        chosen = (self.boost, self.transfer)
        return tuple(t for t in chosen if t is not None) or (warm_start,)

    @property
    def target_only(self) -> bool:
        """Whether every slot has the same task."""
        return len(set(self.order)) == 1


def composition(config: Plain, tasks: list[Env]) -> Composition:
    """The groups' choices, as far as they make sense together."""
    name = config["curriculum"]["name"]
    curriculum, ordered = name != "off", _curriculum(name)
    boost, transfer = boost_of(config["boosting"]), transfer_of(config["transfer"])
    if len(tasks) == 1 and (curriculum or boost or transfer):
        key = "curriculum" if curriculum else "boosting" if boost else "transfer"
        why = f"{config['env']['name']} has one task, so there is no stage to hand over"
        raise ConfigError(
            key,
            config[key]["name"],
            f"{why}; env.tasks needs at least two values",
        )
    if isinstance(transfer, (PolicyReuse, ResidualPolicy)) and not curriculum:
        why = "needs an earlier task whose policy helps: curriculum=on"
        raise ConfigError("transfer", config["transfer"]["name"], why)
    vectors = getattr(tasks[-1], "actions", None)
    if isinstance(transfer, ResidualPolicy) and vectors is None:
        why = "combines actions as vectors, which env.action_vectors has to name"
        raise ConfigError("transfer", "residual_policy", why)
    if isinstance(transfer, ResidualPolicy) and boost:
        why = (
            "its Q is about its own actions, not the executed ones that a base is "
            "about: boosting=off"
        )
        raise ConfigError("transfer", "residual_policy", why)
    order = ordered(len(tasks))
    if not set(order) <= set(range(len(tasks))):
        why = f"visits {order}, but the tasks are 0 to {len(tasks) - 1}"
        raise ConfigError("curriculum", name, why)
    if len(order) != len(tasks):
        why = f"has {len(order)} slots, budgets are lists with one entry a task"
        raise ConfigError("curriculum", name, f"{why} ({len(tasks)})")
    return Composition(tuple(tasks), tuple(order), boost, transfer, config["scale"])


def _curriculum(name: object) -> Callable[[int], list[int]]:
    """The order called `name`, or a trusted function `module.name` of the user's."""
    if isinstance(name, str) and "." in name:
        return trust.attribute("curriculum.name", name, name)
    one_of("curriculum.name", name, list(CURRICULA))
    return CURRICULA[name]


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
    cls = trust.component("transfer.name", name, name) if own else TRANSFERS[name]
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


def capped(value: int, cap: int | None) -> int:
    """A budget under the scale's cap."""
    return value if cap is None else min(value, cap)


def placed(stages: Sequence[Stage]) -> tuple[Stage, ...]:
    """Stages whose `before` counts what the ones before them take."""
    done, out = 0, []
    for stage in stages:
        out.append(replace(stage, before=done))
        done += stage.learner.length
    return tuple(out)
