"""The misleading curricula as data: environments, source tasks, budgets, methods."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from bcrl.api import DQN, FQI, LSPI, Boost, Forest, Shape
from bcrl.envs.base import Env
from bcrl.learning.stage import Learner, Transfer
from research.altered import Hill, Lattice, MountainCar, PointMass

ONLY = "target only"  # the curriculum of methods that have no source

_SEARCH = Boost(alpha="search")
#: Method → its transfers. Those of ALONE learn the target only.
METHODS: dict[str, tuple[Transfer, ...]] = {
    "plain": (),
    "B": (Boost(),),
    "B line search": (_SEARCH,),
    "C": (),
    "BC": (Boost(),),
    "BC line search": (_SEARCH,),
    "SC": (Shape(),),
    "SBC": (Boost(), Shape()),
    "SBC line search": (_SEARCH, Shape()),
}
ALONE = ("plain", "B", "B line search")
WITH_SOURCE = tuple(method for method in METHODS if method not in ALONE)
IN_MATRIX = ("BC", "BC line search")  # with B and its line search on the diagonal


@dataclass(frozen=True)
class Setting:
    """An environment of the suite: its target, sources, learner and budget."""

    target: Any  # an Env
    sources: Mapping[str, tuple[Any, ...]]  # scenario → tasks before the target
    learner: FQI | DQN  # of one stage; its length follows from `total`
    total: int  # iterations or environment steps of all slots
    late: float  # `final` is the mean over this last share of the budget
    seconds: float  # CPU time of a seed, measured
    #: Scenarios whose source is a task of the matrix, beside the target.
    matrix: tuple[str, ...] = ()

    def curricula(self) -> dict[str, tuple[Any, ...]]:
        """Curriculum → its tasks, the target last."""
        found = {name: (*tasks, self.target) for name, tasks in self.sources.items()}
        return {ONLY: (self.target,)} | found

    def matrix_tasks(self) -> dict[str, Any]:
        """Name → task of the matrix, the target last."""
        found = {name: self.sources[name][0] for name in self.matrix}
        return found | {"target": self.target}

    def slots(self, tasks: tuple[Env, ...], method: str) -> list[tuple[Env, Learner]]:
        """The task and learner of each slot."""
        tasks = tasks * 2 if len(tasks) == 1 else tasks
        if isinstance(self.learner, FQI):
            own = replace(self.learner, iterations=self.total // len(tasks))
            return [(task, own) for task in tasks]
        return self._slots_of_dqn(tasks, method, self.learner)

    def _slots_of_dqn(
        self, tasks: tuple[Any, ...], method: str, dqn: DQN
    ) -> list[tuple[Env, Learner]]:
        """Sources share a third of the steps, but LSPI needs only a fifteenth.

        LSPI learns the linear-quadratic task in the first slot, except for C, which
        trains the same networks further.
        """
        tasks = tasks[-1:] if method == "plain" else tasks
        sources = tasks[:-1]
        lspi = sources and sources[0].task == "lq" and not sources[0].order
        share = self.total // 15 if lspi and method != "C" else self.total // 3
        lengths = [share // len(sources) for _ in sources]
        lengths.append(self.total - sum(lengths))
        found: list[tuple[Env, Learner]] = []
        for place, (task, length) in enumerate(zip(tasks, lengths, strict=True)):
            # Random steps begin a stage without a policy; shaping gives none.
            random = dqn.random_steps if place == 0 or method == "SC" else 0
            found.append((task, replace(dqn, steps=length - random)))
        if lspi and method != "C":
            found[0] = sources[0], LSPI(steps=share)
        return found


def _scenarios(
    easy: Any, changes: Mapping[str, Mapping[str, Any]], shift: float, harder: Any
) -> dict[str, tuple[Any, ...]]:
    """Scenario → the sources: the easier task, changed in one respect each."""
    every = {"helpful": {}, **changes}
    every |= {"rewards x0.01": {"scale": 0.01}, "rewards x100": {"scale": 100.0}}
    every |= {"rewards shifted": {"shift": shift}, "irrelevant": {"irrelevant": True}}
    found = {name: (replace(easy, **change),) for name, change in every.items()}
    return found | {"order reversed": (harder, easy)}


_FOREST = Forest(trees=25)
_DRIFT = -0.25
_OPPOSITE = (2, 3, 0, 1, 7, 6, 5, 4)  # the action with the opposite force
_LQ = PointMass(task="lq", horizon=100)

SETTINGS: dict[str, Setting] = {
    "hill": Setting(
        target=Hill(mass=1.0),
        sources=_scenarios(
            Hill(mass=0.8),
            {"goal moved": {"goal_left": True}, "reversed": {"order": (1, 0)}},
            shift=0.1,
            harder=Hill(mass=0.9),
        ),
        learner=FQI(21, episodes=300, regressor=_FOREST, evaluate_every=2),
        total=42,
        late=1 / 4,
        seconds=1.3,
        matrix=("helpful", "goal moved", "reversed", "irrelevant"),
    ),
    "maze": Setting(
        target=Lattice(height=0.35),
        sources=_scenarios(
            Lattice(height=0.15),
            {
                "goal moved": {"goal": (0.05, 0.95)},
                "mirrored": {"goal": (0.95, 0.05)},
                "reversed": {"order": (1, 0, 3, 2)},
            },
            shift=2.0,
            harder=Lattice(height=0.25),
        ),
        learner=FQI(42, episodes=500, regressor=_FOREST, evaluate_every=4),
        total=84,
        late=1 / 4,
        seconds=0.35,
        matrix=("helpful", "mirrored", "reversed", "irrelevant"),
    ),
    "mountain_car": Setting(
        target=MountainCar(force=0.003),
        sources=_scenarios(
            MountainCar(force=0.005),
            {"goal moved": {"goal_left": True}, "reversed": {"order": (2, 1, 0)}},
            shift=2.0,
            harder=MountainCar(force=0.004),
        ),
        learner=FQI(21, episodes=80, regressor=_FOREST, evaluate_every=2),
        total=42,
        late=1 / 4,
        seconds=1.3,
    ),
    "point_mass": Setting(
        target=PointMass(drift=_DRIFT),
        sources={
            "helpful": (_LQ,),
            "goal moved": (PointMass(drift=_DRIFT, goal=(-4.7, 0.0)),),
            "mirrored": (PointMass(task="lq", horizon=100, order=_OPPOSITE),),
            "reversed": (PointMass(drift=-2 * _DRIFT),),
            "rewards x0.01": (replace(_LQ, scale=0.01),),
            "rewards x100": (replace(_LQ, scale=100.0),),
            "rewards shifted": (PointMass(drift=0.0, shift=2.0),),
            "irrelevant": (PointMass(drift=_DRIFT, irrelevant=True),),
            "order reversed": (PointMass(drift=-0.15), PointMass(drift=0.0)),
        },
        learner=DQN(hidden=(64, 64), learning_rate=3e-4, target_update=1000),
        total=42_000,
        late=4 / 21,  # 8000 steps
        seconds=2.0,
    ),
}


def smoke(setting: Setting) -> Setting:
    """The same with a budget of seconds, to try the chain."""
    if isinstance(setting.learner, DQN):
        few = replace(setting.learner, evaluate_every=500, evaluation_episodes=2)
        return replace(setting, learner=few, total=6000)
    few_fits = replace(
        setting.learner, episodes=20, regressor=Forest(trees=3), evaluate_every=1
    )
    return replace(setting, learner=few_fits, total=6)
