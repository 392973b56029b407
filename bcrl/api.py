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

from bcrl import probes
from bcrl.composition import placed
from bcrl.envs import Env, is_simulated
from bcrl.envs.car_on_hill import CarOnHill
from bcrl.envs.gymnasium import Gymnasium
from bcrl.envs.linear_system import LinearSystem
from bcrl.envs.maze import Maze
from bcrl.errors import BcrlError, ConfigError
from bcrl.evaluation import StepProbe
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
    if not tasks or len(learners) != len(tasks):
        why = f"there are {len(learners)} learners for {len(tasks)} tasks"
        raise ConfigError("stages", "tasks", why)
    different = list(dict.fromkeys(tasks))
    if is_simulated(tasks[-1]):
        tasks[-1].check_tasks(different)
    made = []
    for number, (task, own) in enumerate(zip(tasks, learners, strict=True), start=1):
        if isinstance(own, DQN) and number > 1 and hands_on_a_policy(transfers):
            own = replace(own, random_steps=0)
        steering = [
            t for t in transfers if isinstance(t, (PolicyReuse, ResidualPolicy))
        ]
        if isinstance(own, FQI) and steering:
            why = "steers step by step, FQI learns from whole episodes"
            raise ConfigError("stages", steering[0], why)
        made.append(Stage(number, different.index(task) + 1, task, own, transfers, 0))
    return placed(made)


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
    seeds, target = tuple(seeds), course[-1].env
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
    files = sorted(Path(folder).glob("seed_*.csv"))
    if not files:
        raise BcrlError(f"{folder}: there is no seed_*.csv")
    found = {int(path.stem.removeprefix("seed_")): pd.read_csv(path) for path in files}
    return (
        pd.concat(found, names=["seed", None])
        .reset_index("seed")
        .reset_index(drop=True)
    )
