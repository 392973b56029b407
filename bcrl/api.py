"""For scripts and notebooks: tasks become stages, stages are run, results are a frame.

The same objects as behind the `bcrl` command, without configs and files:

    tasks = [CarOnHill(mass=m) for m in (0.8, 1.0, 1.2)]
    learner = FQI(iterations=20, episodes=200, regressor=Forest())
    results = run(stages(tasks, learner, Boost()), seeds=range(5))
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from numbers import Integral
from pathlib import Path

import pandas as pd
from tqdm import tqdm

from bcrl.common import compiling
from bcrl.common.files import seed_path, seeds_of
from bcrl.config.rules import course
from bcrl.config.variant import Composition, order_of
from bcrl.envs import Env, check_tasks, is_simulated
from bcrl.envs.car_on_hill import CarOnHill
from bcrl.envs.gymnasium import Gymnasium
from bcrl.envs.linear_system import LinearSystem
from bcrl.envs.maze import Maze
from bcrl.errors import BcrlError, ConfigError
from bcrl.evaluation import metrics as probes
from bcrl.evaluation.step_metrics import StepProbe
from bcrl.learning.dqn import DQN
from bcrl.learning.fqi import FQI
from bcrl.learning.lspi import LSPI
from bcrl.learning.stage import (
    CurriculumRun,
    Learner,
    SeedBatch,
    Snapshot,
    Stage,
    snapshots,
)
from bcrl.learning.transfer import (
    Boost,
    PolicyReuse,
    ResidualPolicy,
    Shape,
    Transfer,
    warm_start,
)
from bcrl.q.regressors.ours import ForestRegressor as Forest
from bcrl.q.regressors.ours import Tabular
from bcrl.q.regressors.scikit import Sklearn
from bcrl.run.workers import cores

__all__ = [
    "DQN",
    "FQI",
    "LSPI",
    "Boost",
    "CarOnHill",
    "Forest",
    "Gymnasium",
    "LinearSystem",
    "Maze",
    "PolicyReuse",
    "ResidualPolicy",
    "Shape",
    "Sklearn",
    "Tabular",
    "read",
    "run",
    "stages",
    "warm_start",
]


def stages(
    tasks: Sequence[Env],
    learner: Learner | Sequence[Learner],
    *transfers: Transfer,
    curriculum: str | Callable[[int], Sequence[int]] | None = None,
) -> tuple[Stage, ...]:
    """The stages of a course, the same as the command line's; a learner for all slots,
    or one per slot.

    The slots are the `tasks` as listed, the target last. With `curriculum` (as in the
    group: "on", "off" or a function of the number of tasks) they are the tasks that it
    visits, `tasks` then being listed once each. Without `transfers` the approximator
    is passed on (`warm_start`): [target] · n is the plain algorithm, an easier task
    first makes it C-. `Boost()` makes it B- or BC-, `Shape()` SC-, both SBC-. Raises
    ConfigError for what makes no sense together.
    """
    tasks = list(tasks)
    if not tasks:
        raise ConfigError("tasks", "0 tasks", "at least one is needed, the target last")
    boosts = [t for t in transfers if isinstance(t, Boost)]
    others = [t for t in transfers if not isinstance(t, Boost) and t is not warm_start]
    _check(tasks, transfers, max(len(boosts), len(others)))
    if curriculum is None:
        earlier = [task for task in tasks if task != tasks[-1]]
        different = [t for i, t in enumerate(earlier) if t not in earlier[:i]]
        different.append(tasks[-1])
        order = tuple(different.index(task) for task in tasks)
    else:
        different, order = tasks, order_of(curriculum, tasks)
    check_tasks(tasks[-1].name, different)
    chosen = Composition(tuple(different), order, *(boosts or [None]), *others)
    one = hasattr(learner, "learn") or not isinstance(learner, Iterable)
    each = [learner] * len(order) if one else list(learner)
    try:
        return course(chosen, each)
    except ConfigError as error:  # a config's keys, where there is no config
        key = error.key.removeprefix("algorithm.")
        raise ConfigError(key, error.value, error.allowed) from error


def _check(tasks: Sequence[Env], transfers: Sequence[Transfer], most: int) -> None:
    """Raise ConfigError for arguments that no config could say."""
    for task in tasks:
        if isinstance(task, type) or not hasattr(task, "n_actions"):
            raise ConfigError("tasks", task, "is no environment, such as Maze()")
    for transfer in transfers:
        if isinstance(transfer, type):
            why = f"is a class, write {transfer.__name__}()"
            raise ConfigError("transfers", transfer.__name__, why)
        if not callable(transfer):
            raise ConfigError("transfers", transfer, "is no transfer, such as Boost()")
    if most > 1 or (warm_start in transfers and len(transfers) > 1):
        why = "must be one Boost() and one other at most, or warm_start alone"
        raise ConfigError("transfers", list(transfers), why)
    if len({is_simulated(task) for task in tasks}) > 1:
        why = "simulators and pure environments don't mix"
        raise ConfigError("tasks", tasks[-1], why)


def run(
    course: Sequence[Stage],
    seeds: Iterable[int] = range(3),
    metrics: Sequence[str] = ("return", "solved"),
    threads: int | None = None,
    progress: bool = True,
) -> pd.DataFrame:
    """Train seeds through the stages, in lockstep; a row a seed and evaluation.

    Columns are seed, stage, task, then iteration and `metrics` (FQI) or step and those
    of docs/metrics.md (DQN). Seeds have the same results in any company. Raises
    BcrlError for seeds that diverge.
    """
    compiling.check()
    seeds, metrics, target = _seeds(seeds), tuple(metrics), course[-1].env
    tasks = [*dict.fromkeys(s.env for s in course if s.env != target), target]
    if isinstance(course[-1].learner, FQI):
        probes.check_metrics(metrics, target)
        probe = probes.Probe(seeds, tasks, metrics)
    else:
        probe = StepProbe(seeds, tasks)
    team = SeedBatch(seeds, probe.states, threads or cores())
    rows = []
    length = sum(stage.learner.length for stage in course)
    with tqdm(total=length, unit=probe.index, disable=not progress) as bar:
        for now in snapshots(CurriculumRun(course, team)):
            rows += _rows(now, probe, seeds)
            bar.set_description_str(f"task {now.stage.task}", refresh=False)
            bar.update(now.count - bar.n)
    return pd.DataFrame(rows)


def _seeds(seeds: Iterable[int]) -> tuple[int, ...]:
    if isinstance(seeds, Integral):
        raise ConfigError("seeds", seeds, f"name them: range({seeds}) or [{seeds}]")
    found = tuple(seeds)
    whole = all(isinstance(seed, Integral) for seed in found)
    if not whole or not found or len(set(found)) < len(found) or min(found) < 0:
        raise ConfigError("seeds", found, "must be different whole numbers from 0 on")
    return found


def _rows(now: Snapshot, probe: probes.Probe | StepProbe, seeds: Sequence[int]) -> list:
    rows = probe.measure(now)
    if probe.failed:
        lost = ", ".join(f"seed {seeds[s]}: {why}" for s, why in probe.failed.items())
        raise BcrlError(f"at {probe.index} {now.count}: {lost}")
    where = {"stage": now.stage.number, "task": now.stage.task, probe.index: now.count}
    return [
        {"seed": seed} | where | measured
        for seed, measured in zip(seeds, rows, strict=True)
    ]


def read(folder: str | Path) -> pd.DataFrame:
    """The seeds that `bcrl` has recorded in a run's folder, as `run` gives them."""
    numbers = seeds_of(Path(folder), "csv")
    if not numbers:
        raise BcrlError(f"{folder}: there is no seed_*.csv")
    found = {n: pd.read_csv(seed_path(Path(folder), n, "csv")) for n in numbers}
    return (
        pd.concat(found, names=["seed", None])
        .reset_index("seed")
        .reset_index(drop=True)
    )
