"""For scripts and notebooks: tasks become stages, and `run` gives a data frame.

The objects are those of the `bcrl` command, without configs and files:

    tasks = [CarOnHill(mass=m) for m in (0.8, 1.0, 1.2)]
    learner = FQI(iterations=20, episodes=200, regressor=Forest())
    results = run(stages(tasks, learner, Boost()), seeds=range(5), workers=2)
    plot(results)
"""

import os
from collections.abc import Callable, Iterable, Sequence
from numbers import Integral
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from bcrl.common import compiling
from bcrl.common.files import write_text
from bcrl.config.plan import usable_device
from bcrl.config.rules import course
from bcrl.config.variant import Composition, order_of
from bcrl.envs import Env, check_tasks, is_simulated
from bcrl.envs.car_on_hill import CarOnHill
from bcrl.envs.compiled import compiled_step
from bcrl.envs.gymnasium import Gymnasium
from bcrl.envs.linear_system import LinearSystem
from bcrl.envs.maze import Maze
from bcrl.errors import ConfigError
from bcrl.evaluation import metrics as fqi_metrics
from bcrl.learning.dqn import DQN
from bcrl.learning.export import export
from bcrl.learning.fqi import FQI
from bcrl.learning.lspi import LSPI
from bcrl.learning.stage import Learner, Stage, Transfer
from bcrl.learning.transfer import Boost, PolicyReuse, ResidualPolicy, Shape, warm_start
from bcrl.learning.transitions import Transitions
from bcrl.q.regressors.ours import ForestRegressor as Forest
from bcrl.q.regressors.ours import Tabular
from bcrl.q.regressors.scikit import Sklearn
from bcrl.results.layout import INDEX
from bcrl.results.tables import read_results as read
from bcrl.run.agents import load
from bcrl.run.frame import SeedGroup, SeedRows, about, train_groups
from bcrl.run.workers import cores

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["CarOnHill", "Gymnasium", "LinearSystem", "Maze", "compiled_step"]
__all__ += ["export", "load", "plot", "read", "run", "stages"]
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
    *,
    workers: int = 1,
    device: str = "cpu",
    save: str | Path | None = None,
    on_row: Callable[[dict[str, Any]], object] | None = None,
) -> pd.DataFrame:
    """Train seeds through the stages, in lockstep; one row per seed and evaluation.

    Columns are method (such as BC-FQI), seed, stage, task, then iteration and `metrics`
    (FQI) or step and the metrics of docs/reference/metrics.md (DQN), then the settings
    of the target's learner that are not its class's defaults, as `learner.episodes`.
    Frames of several calls can be concatenated. No seed's results depend on the others.

    Args:
        stages: What `stages` returns; its learners say how often to evaluate.
        seeds: Different whole numbers from 0 on, such as range(5) or [3, 7].
        metrics: Names of FQI's metrics; DQN always records all its metrics.
        threads: Threads per process that grow forests; None divides the cores among the
            workers. They change no result.
        progress: Whether a bar shows the iterations or steps done.
        workers: Processes that train groups of the seeds side by side, at least 1. On a
            CPU they change no result. Objects of your script or notebook are sent to
            them, functions and classes included.
        device: Where DQN's networks are: "cpu", "cuda", or "auto" for a GPU if there is
            one. Forests always grow on the CPU.
        save: A CSV file for the frame, in a folder that exists. It is written at the
            end, as a whole, over an older one; `read(save)` returns an equal frame.
        on_row: A function that is called with each row, as a dict by column, once it
            is measured. It runs in this process, for all workers.

    Raises:
        ConfigError: An argument is not allowed; no work was started.
        BcrlError: A seed diverges, or a process or the file fails.
    """
    compiling.check()
    if isinstance(seeds, Integral):
        raise ConfigError("seeds", seeds, f"name them: range({seeds}) or [{seeds}]")
    if not stages:
        raise ConfigError("stages", stages, "must be what bcrl.api.stages(…) returns")
    seeds, metrics, last = tuple(seeds), tuple(metrics), stages[-1]
    whole = all(isinstance(seed, Integral) and seed >= 0 for seed in seeds)
    if not whole or not 0 < len(seeds) == len(set(seeds)):
        raise ConfigError("seeds", seeds, "must be different whole numbers from 0 on")
    family = "FQI" if isinstance(last.learner, FQI) else "DQN"
    if family == "FQI":
        fqi_metrics.check_metrics(metrics, last.env)
    _check_how(workers, threads, save, on_row)
    device = usable_device(device, family)
    groups = np.array_split(np.arange(len(seeds)), min(workers, len(seeds)))
    threads = threads or max(1, cores() // len(groups))
    method, settings = about(stages)
    rows: list[tuple[int, int, dict[str, Any]]] = []  # evaluation, seed's place, row
    done, evaluations = [0] * len(groups), [0] * len(groups)
    length = sum(stage.learner.length for stage in stages)
    with tqdm(total=length, unit=INDEX[family][-1], disable=not progress) as bar:

        def take(group: int, measured: tuple[int, int, SeedRows]) -> None:
            done[group], task, found = measured
            for place, row in zip(groups[group], found, strict=True):
                row = {"method": method} | row | settings
                rows.append((evaluations[group], int(place), row))
                if on_row is not None:
                    on_row(dict(row))
            evaluations[group] += 1
            bar.set_description_str(f"task {task}", refresh=False)
            bar.update(sum(done) // len(done) - bar.n)

        own = (tuple(seeds[place] for place in group) for group in groups)
        common = metrics, threads, device
        train_groups([SeedGroup(stages, each, *common) for each in own], take)
    frame = pd.DataFrame([row for *_, row in sorted(rows, key=itemgetter(0, 1))])
    if save is not None:
        write_text(Path(save), frame.to_csv(index=False, lineterminator="\n"))
    return frame


def _check_how(workers: Any, threads: Any, save: Any, on_row: Any) -> None:
    """Raise ConfigError for arguments that say how to run and can't be obeyed."""
    for key, value in (("workers", workers), ("threads", threads)):
        whole = isinstance(value, Integral) and not isinstance(value, bool)
        if not (whole and value >= 1) and (key, value) != ("threads", None):
            raise ConfigError(key, value, "must be a whole number of at least 1")
    if on_row is not None and not callable(on_row):
        why = "must be a function that takes a row, or None: on_row=print"
        raise ConfigError("on_row", on_row, why)
    if save is None:
        return
    if not isinstance(save, str | Path):
        raise ConfigError("save", save, "must be the path of a CSV file, or None")
    folder = Path(save).parent
    if Path(save).is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
        raise ConfigError("save", save, "must be a file in a folder that you can write")


def plot(frame: pd.DataFrame, metric: str = "return") -> "Figure":
    """The learning curves of a frame of `run` or `read`, as a matplotlib figure.

    Each method has the mean over seeds and its bootstrapped 95 % interval, in the
    report's colours; runs of one method are told apart by the settings that differ.
    `plot(frame).savefig("curves.pdf")` writes it. Raises BcrlError for an unknown
    metric, and for a frame that lacks columns or counts iterations and steps.
    """
    from bcrl.report.figures.frames import figure_frame  # matplotlib is slow to import

    return figure_frame(frame, metric)
