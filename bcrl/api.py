"""For scripts and notebooks: tasks become stages, stages are run, results are a frame.

The same objects as behind the `bcrl` command, without configs and files:

    tasks = [CarOnHill(mass=m) for m in (0.8, 1.0, 1.2)]
    learner = FQI(iterations=20, episodes=200, regressor=Forest())
    results = run(stages(tasks, learner, Boost()), seeds=range(5))
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd
from tqdm import tqdm

from bcrl import compiling, probes
from bcrl.composition import placed
from bcrl.envs import Env, check_tasks, is_simulated
from bcrl.envs.car_on_hill import CarOnHill
from bcrl.envs.gymnasium import Gymnasium
from bcrl.envs.linear_system import LinearSystem
from bcrl.envs.maze import Maze
from bcrl.errors import BcrlError, ConfigError
from bcrl.evaluation import StepProbe
from bcrl.files import seed_path, seeds_of
from bcrl.learners.dqn import DQN
from bcrl.learners.fqi import FQI
from bcrl.q.regressors import ForestRegressor as Forest
from bcrl.q.regressors import Tabular
from bcrl.q.scikit import Sklearn
from bcrl.stage import Course, Learner, Snapshot, Stage, Team, snapshots
from bcrl.transfer import (
    Boost,
    PolicyReuse,
    ResidualPolicy,
    Shape,
    Transfer,
    hands_on_a_policy,
    warm_start,
)
from bcrl.workers import cores

__all__ = [
    "DQN",
    "FQI",
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
) -> tuple[Stage, ...]:
    """One stage a task, in order, the target last; a learner for all, or one a task.

    Without `transfers` the approximator goes on (`warm_start`): [target] · n is the
    plain algorithm, an easier task first makes it C-. `Boost()` makes it B- or BC-,
    `Shape()` SC-, both SBC-. Raises ConfigError for what makes no sense together.
    """
    transfers = transfers or (warm_start,)
    learners = [learner] * len(tasks) if hasattr(learner, "learn") else learner
    _check(tasks, learners, transfers)
    different = list(dict.fromkeys(tasks))
    made = []
    for number, (task, own) in enumerate(zip(tasks, learners, strict=True), start=1):
        if isinstance(own, DQN) and number > 1 and hands_on_a_policy(transfers):
            own = replace(own, random_steps=0)
        made.append(Stage(number, different.index(task) + 1, task, own, transfers, 0))
    return placed(made)


def _check(
    tasks: Sequence[Env], learners: Sequence[Learner], transfers: Sequence[Transfer]
) -> None:
    """Raise ConfigError for what `stages` can't make a course of."""

    def wrong(what: object, why: str) -> ConfigError:
        return ConfigError("stages", what, why)

    if not tasks or len(learners) != len(tasks):
        raise wrong(f"{len(tasks)} tasks", f"there are {len(learners)} learners")
    target, fitted = tasks[-1], isinstance(learners[-1], FQI)
    for own in learners:
        if not hasattr(own, "learn") or isinstance(own, FQI) != fitted:
            raise wrong(own, "a course has learners of one family, FQI or DQN")
        regressor = getattr(own, "regressor", None)
        if fitted and (isinstance(regressor, type) or not hasattr(regressor, "fit")):
            raise wrong(regressor, "is no regressor")
        if fitted and not hasattr(regressor, "finite_only"):
            why = "is no regressor of bcrl's; Sklearn(estimator) makes one of it"
            raise wrong(regressor, why)
    for transfer in transfers:
        steers = isinstance(transfer, (PolicyReuse, ResidualPolicy))
        if isinstance(transfer, type):
            raise wrong(transfer.__name__, f"is a class, write {transfer.__name__}()")
        if steers and fitted:
            raise wrong(transfer, "steers step by step, FQI learns from whole episodes")
        combines = isinstance(transfer, ResidualPolicy)
        if combines and getattr(target, "actions", None) is None:
            raise wrong(
                transfer, f"combines actions as vectors, {target.name} has none"
            )
    others = [task for task in dict.fromkeys(tasks) if task != target]
    if {is_simulated(task) for task in tasks} != {is_simulated(target)}:
        raise wrong(target, "simulators and pure environments don't mix")
    check_tasks(target.name, [*others, target])


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
    seeds, target = _seeds(seeds), course[-1].env
    tasks = [*dict.fromkeys(s.env for s in course if s.env != target), target]
    if isinstance(course[-1].learner, FQI):
        probes.check(metrics, target)
        probe = probes.Probe(seeds, tasks, metrics)
    else:
        probe = StepProbe(seeds, tasks)
    team = Team(seeds, probe.states, threads or cores())
    rows = []
    length = sum(stage.learner.length for stage in course)
    with tqdm(total=length, unit=probe.index, disable=not progress) as bar:
        for now in snapshots(Course(course, team)):
            rows += _rows(now, probe, seeds)
            bar.set_description_str(f"task {now.stage.task}", refresh=False)
            bar.update(now.count - bar.n)
    return pd.DataFrame(rows)


def _seeds(seeds: Iterable[int]) -> tuple[int, ...]:
    if isinstance(seeds, int):
        raise ConfigError("seeds", seeds, f"name them: range({seeds}) or [{seeds}]")
    found = tuple(seeds)
    if not found or len(set(found)) < len(found) or min(found) < 0:
        raise ConfigError("seeds", found, "must be different numbers from 0 on")
    return found


def _rows(now: Snapshot, probe: probes.Probe | StepProbe, seeds: Sequence[int]) -> list:
    if now.failed:
        lost = ", ".join(f"seed {seeds[s]}: {why}" for s, why in now.failed.items())
        raise BcrlError(f"at {probe.index} {now.count}: {lost}")
    where = {"stage": now.stage.number, "task": now.stage.task, probe.index: now.count}
    return [
        {"seed": seed} | where | measured
        for seed, measured in zip(seeds, probe.measure(now), strict=True)
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
