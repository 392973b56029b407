"""Training without files: rows as they are measured, in one process or in several."""

import importlib
import pickle
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import partial
from numbers import Number
from typing import Any

import cloudpickle
import gymnasium
import numpy as np

from bcrl.common.signals import Stop
from bcrl.common.text import shorten
from bcrl.config.variant import method_name
from bcrl.errors import BcrlError, ConfigError
from bcrl.evaluation.metrics import Probe
from bcrl.evaluation.step_metrics import StepProbe
from bcrl.learning.fqi import FQI
from bcrl.learning.stage import SeedBatch, Snapshot, Stage, learn
from bcrl.learning.transfer import SEARCH
from bcrl.q.regressors.ours import REGRESSORS
from bcrl.results.layout import SETTING
from bcrl.run.workers import do_jobs

SeedRows = list[dict[str, Any]]  # of one evaluation, one per seed
#: Takes the place of a group, its iterations or steps so far, the task, and new rows.
Report = Callable[[int, tuple[int, int, SeedRows]], None]


@dataclass(frozen=True)
class SeedGroup:
    """Seeds that train together in one process."""

    stages: Sequence[Stage]
    seeds: tuple[int, ...]
    metrics: tuple[str, ...]
    threads: int
    device: str

    def measured(self) -> Iterator[tuple[Snapshot, SeedRows]]:
        """Each evaluation; BcrlError after one in which a seed can't continue."""
        target = self.stages[-1].env
        tasks = [*dict.fromkeys(s.env for s in self.stages if s.env != target), target]
        probe: Probe | StepProbe = StepProbe(self.seeds, tasks)
        if isinstance(self.stages[-1].learner, FQI):
            probe = Probe(self.seeds, tasks, self.metrics)
        batch = SeedBatch(self.seeds, probe.states, self.threads, self.device)
        for snapshot in learn(self.stages, batch):
            pairs = zip(self.seeds, probe.rows(snapshot), strict=True)
            yield snapshot, [{"seed": seed} | row for seed, row in pairs]
            reasons = [f"seed {self.seeds[s]}: {x}" for s, x in probe.failed.items()]
            if reasons:
                where = f"at {probe.index} {snapshot.count}"
                raise BcrlError(f"{where}: {', '.join(reasons)}")


def train_groups(groups: Sequence[SeedGroup], report: Report) -> None:
    """Train each group in a separate process, a single one in this process.

    Raises BcrlError if a seed diverges or a process fails, ConfigError for stages that
    can't be sent to a process.
    """
    if len(groups) == 1:
        _train(groups[0], partial(report, 0), Stop())
        return
    try:
        known = _registered(groups[0].stages)
        jobs = [cloudpickle.dumps((*known, group)) for group in groups]
    except Exception as error:  # whatever a user's object raises
        why = f"can't send the stages to other processes ({error}); workers=1 can"
        raise ConfigError("workers", len(groups), why) from error
    with closing(do_jobs(_serve, jobs, len(groups), report, Stop())) as outcomes:
        for _, failure in outcomes:
            if isinstance(failure, str):  # the process died
                raise BcrlError(f"workers={len(groups)}: {failure}")
            if failure:
                raise BcrlError(*failure)


def _serve(job: bytes, report: Callable, stop: Any) -> tuple[str, ...]:
    """`_train` in another process; why it failed, if it did."""
    try:
        modules, specs, group = pickle.loads(job)
        for module in modules:
            importlib.import_module(module)
        gymnasium.registry.update(specs)
        _train(group, report, stop)
    except BcrlError as error:
        return (str(error),)
    except Exception:  # unforeseen: show where
        return (traceback.format_exc(),)
    return ()


def _registered(stages: Sequence[Stage]) -> tuple[set[str], dict[str, Any]]:
    """What this process knows of the tasks' ids: modules imported, registry entries."""
    ids = [str(getattr(stage.env, "id", "")).rpartition(":") for stage in stages]
    names = {name for *_, name in ids} & {*gymnasium.registry}
    modules = {module for module, *_ in ids} & {*sys.modules}
    return modules, {name: gymnasium.registry[name] for name in names}


def _train(group: SeedGroup, report: Callable, stop: Any) -> None:
    for snapshot, rows in group.measured():
        report((snapshot.count, snapshot.stage.task, rows))
        if stop.requested:
            return


def about(stages: Sequence[Stage]) -> tuple[str, dict[str, Any]]:
    """The method's name, such as BC-FQI, and the settings in which the target's learner
    differs from the defaults of its class, by columns such as `learner.episodes`."""
    last = stages[-1]
    target_only = all(stage.env == last.env for stage in stages)
    name = getattr(last.learner, "name", type(last.learner).__name__)
    method, alpha = method_name(name, last.transfers, target_only), last.boost.alpha
    if alpha != 1.0:
        method += "@line_search" if alpha == SEARCH else f"@alpha={alpha}"
    return method, _settings(last.learner)


def _settings(thing: Any, prefix: str = SETTING) -> dict[str, Any]:
    """The fields of a dataclass that differ from their defaults; nested ones, too."""
    found: dict[str, Any] = {}
    for field in fields(thing) if is_dataclass(thing) else ():
        value, key = getattr(thing, field.name), f"{prefix}{field.name}"
        if field.default is MISSING or _cell(value) != _cell(field.default):
            found[key] = _cell(value)
            found |= _settings(value, f"{key}.")
    return found


def _cell(value: Any) -> Any:
    """A value as a table has it: a number, a name or a short text."""
    if isinstance(value, Number | str | np.generic):
        return value
    names = {cls: name for name, cls in REGRESSORS.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return names.get(type(value), type(value).__name__)
    text = getattr(value, "__name__", None) or " ".join(repr(value).split())
    return shorten(text)
