"""For scripts and notebooks: tasks become stages, and `run` gives a data frame.

The objects are those of the `bcrl` command, without configs and files:

    tasks = [CarOnHill(mass=m) for m in (0.8, 1.0, 1.2)]
    learner = FQI(iterations=20, episodes=200, regressor=Forest())
    results = run(stages(tasks, learner, Boost()), seeds=range(5))
"""

from collections.abc import Callable, Iterable, Sequence
from numbers import Integral

import pandas as pd
from tqdm import tqdm

from bcrl.common import compiling
from bcrl.config.rules import course
from bcrl.config.variant import Composition, order_of
from bcrl.envs import Env, check_tasks, is_simulated
from bcrl.envs.car_on_hill import CarOnHill
from bcrl.envs.compiled import compiled_step
from bcrl.envs.gymnasium import Gymnasium
from bcrl.envs.linear_system import LinearSystem
from bcrl.envs.maze import Maze
from bcrl.errors import BcrlError, ConfigError
from bcrl.evaluation import metrics as fqi_metrics
from bcrl.evaluation.step_metrics import StepProbe
from bcrl.learning.dqn import DQN
from bcrl.learning.fqi import FQI
from bcrl.learning.lspi import LSPI
from bcrl.learning.stage import Learner, SeedBatch, Stage, Transfer, learn
from bcrl.learning.transfer import Boost, PolicyReuse, ResidualPolicy, Shape, warm_start
from bcrl.learning.transitions import Transitions
from bcrl.q.regressors.ours import ForestRegressor as Forest
from bcrl.q.regressors.ours import Tabular
from bcrl.q.regressors.scikit import Sklearn
from bcrl.results.tables import read_folder as read
from bcrl.run.workers import cores

__all__ = ["CarOnHill", "Gymnasium", "LinearSystem", "Maze", "compiled_step"]
__all__ += ["read", "run", "stages"]
__all__ += ["DQN", "FQI", "LSPI", "Forest", "Sklearn", "Tabular"]
__all__ += ["Boost", "PolicyReuse", "ResidualPolicy", "Shape", "warm_start"]
__all__ += ["Transitions"]


def stages(
    tasks: Sequence[Env],
    learner: Learner | Sequence[Learner],
    *transfers: Transfer,
    curriculum: str | Callable[[int], Sequence[int]] | None = None,
) -> tuple[Stage, ...]:
    """The stages of a curriculum, as the command makes them from a config.

    The slots are the `tasks` as listed, the target last; `learner` is one for all slots
    or a list with one per slot. With `curriculum` ("on", "off" or a function of the
    number of tasks) each task is listed once, and the curriculum makes the slots.
    Without `transfers` the approximator is passed on (`warm_start`): [target] · n is
    the plain algorithm, and an easier task first makes it C-. `Boost()` makes it B- or
    BC-, `Shape()` SC-, both SBC-. Raises ConfigError for invalid combinations.
    """
    tasks = list(tasks)
    boosts = [t for t in transfers if isinstance(t, Boost)]
    others = [t for t in transfers if not isinstance(t, Boost) and t is not warm_start]
    _check(tasks, transfers, max(len(boosts), len(others)))
    if curriculum is None:
        different = [*dict.fromkeys(t for t in tasks if t != tasks[-1]), tasks[-1]]
        order = tuple(different.index(task) for task in tasks)
    else:
        different, order = tasks, order_of(curriculum, tasks)
    check_tasks(tasks[-1].name, different)
    chosen = Composition(tuple(different), order, *(boosts or [None]), *others)
    one = hasattr(learner, "learn") or not isinstance(learner, Iterable)
    learners = [learner] * len(order) if one else list(learner)
    try:
        return course(chosen, learners)
    except ConfigError as error:  # a config's key, where there is no config
        key = error.key.removeprefix("algorithm.")
        raise ConfigError(key, error.value, error.allowed) from error


def _check(tasks: Sequence[Env], transfers: Sequence[Transfer], most: int) -> None:
    """Raise ConfigError for arguments that no config could have."""
    if not tasks:
        raise ConfigError("tasks", "0 tasks", "at least one is needed, the target last")
    kinds = ("tasks", tasks, "n_actions"), ("transfers", transfers, "__call__")
    for key, values, needed in kinds:
        for value in values:
            if isinstance(value, type) or not hasattr(value, needed):
                raise ConfigError(key, value, "must be an object, as Maze() or Boost()")
    if most > 1 or (warm_start in transfers and len(transfers) > 1):
        why = "must be one Boost() and one other at most, or warm_start alone"
        raise ConfigError("transfers", list(transfers), why)
    if len({is_simulated(task) for task in tasks}) > 1:
        why = "simulators and pure environments can't be combined"
        raise ConfigError("tasks", tasks[-1], why)


def run(
    stages: Sequence[Stage],
    seeds: Iterable[int] = range(3),
    metrics: Sequence[str] = ("return", "solved"),
    threads: int | None = None,
    progress: bool = True,
) -> pd.DataFrame:
    """Train seeds through the stages, in lockstep; one row per seed and evaluation.

    Columns are seed, stage, task, then iteration and `metrics` (FQI) or step and the
    metrics of docs/reference/metrics.md (DQN); learners have `evaluate_every`. No
    seed's results depend on the others. Raises BcrlError for seeds that diverge.
    """
    compiling.check()
    if isinstance(seeds, Integral):
        raise ConfigError("seeds", seeds, f"name them: range({seeds}) or [{seeds}]")
    seeds, metrics, target = tuple(seeds), tuple(metrics), stages[-1].env
    whole = all(isinstance(seed, Integral) and seed >= 0 for seed in seeds)
    if not whole or not 0 < len(seeds) == len(set(seeds)):
        raise ConfigError("seeds", seeds, "must be different whole numbers from 0 on")
    tasks = [*dict.fromkeys(s.env for s in stages if s.env != target), target]
    probe: fqi_metrics.Probe | StepProbe = StepProbe(seeds, tasks)
    if isinstance(stages[-1].learner, FQI):
        fqi_metrics.check_metrics(metrics, target)
        probe = fqi_metrics.Probe(seeds, tasks, metrics)
    batch = SeedBatch(seeds, probe.states, threads or cores())
    rows, length = [], sum(stage.learner.length for stage in stages)
    with tqdm(total=length, unit=probe.index, disable=not progress) as bar:
        for snapshot in learn(stages, batch):
            for seed, row in zip(seeds, probe.measure(snapshot), strict=True):
                rows.append({"seed": seed} | probe.place(snapshot) | row)
            if lost := [f"seed {seeds[s]}: {why}" for s, why in probe.failed.items()]:
                raise BcrlError(f"at {probe.index} {snapshot.count}: {', '.join(lost)}")
            bar.set_description_str(f"task {snapshot.stage.task}", refresh=False)
            bar.update(snapshot.count - bar.n)
    return pd.DataFrame(rows)
