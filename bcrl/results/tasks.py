"""Which tasks the numbers in a run's CSVs mean, from its recorded config."""

from typing import Any, NamedTuple

from numpy.typing import NDArray

from bcrl.common.identity import Plain

_VARYING = ("tasks", "metrics", "paper_seeds")  # no constants of an environment


class Task(NamedTuple):
    """One task: what all tasks of its `env` section share, and its own values."""

    constants: Plain
    values: Plain


def numbered_tasks(config: Plain) -> tuple[list[Task], int]:
    """The tasks 1, 2, … of a run, those of the run that it starts from first, each of
    them once; and the target's number. Empty and 0 if the config doesn't name any."""
    section = config.get("env") or {}
    if not section.get("tasks"):
        return [], 0
    lists: dict[str, Any] = {k: v for k, v in section["tasks"].items() if v is not None}
    constants = {k: v for k, v in section.items() if k not in _VARYING}
    rows = zip(*lists.values(), strict=True) if lists else [()]
    own = [Task(constants, dict(zip(lists, row, strict=True))) for row in rows]
    start = (config.get("start") or {}).get("run")
    before = numbered_tasks(start["config"])[0] if start else []
    known = [*before, *(task for task in own if task not in before)]
    return known, known.index(own[-1]) + 1 if before else len(known)


def target_of(config: Plain, task: NDArray[Any]) -> int:
    """The target's number in a CSV's column `task`: the last of the config's tasks. Of
    the last row if the config doesn't name the tasks, or that one has no row."""
    target = numbered_tasks(config)[1]
    return target if target in task else int(task[-1])
