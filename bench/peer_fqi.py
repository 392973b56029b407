"""MushroomRL's FQI against ours, same sizes, on one core: make bench-peers

One iteration, after a few others, on 1000 random episodes of *its* car on the hill
(1 kg) by its agent with scikit-learn's extra-trees (50 trees, as in the paper), and of
our car by our learner. Both take turns; the least CPU time of several counts.
"""

from __future__ import annotations

from collections.abc import Callable

from mushroom_rl.algorithms.value.batch_td.fqi import FQI as TheirFQI
from mushroom_rl.core import Core
from mushroom_rl.environments.car_on_hill import CarOnHill as TheirCar
from mushroom_rl.policy import EpsGreedy
from mushroom_rl.utils.parameters import Parameter
from sklearn.ensemble import ExtraTreesRegressor
from threadpoolctl import threadpool_limits
from timing import by_turns, one_core

from bcrl.envs.car_on_hill import CarOnHill
from bcrl.evaluation.metrics import probed_states
from bcrl.learning.fqi import FQI
from bcrl.learning.stage import SeedBatch, Stage, learn
from bcrl.q.regressors.ours import ForestRegressor

EPISODES, EARLY = 1000, 6


def their_fqi() -> Callable[[], object]:
    """An iteration at each call."""
    car = TheirCar()
    agent = TheirFQI(
        car.info,
        EpsGreedy(Parameter(1.0)),
        ExtraTreesRegressor,
        n_iterations=1,
        quiet=True,
        approximator_params={
            "input_shape": car.info.observation_space.shape,
            "n_actions": 2,
            "n_estimators": 50,
            "min_samples_split": 5,
            "min_samples_leaf": 2,
            "n_jobs": 1,
        },
    )
    episodes = Core(agent, car).evaluate(n_episodes=EPISODES, quiet=True)
    print(f"MushroomRL's dataset: {len(episodes)} transitions")
    return lambda: agent.fit(episodes)


def our_fqi() -> Callable[[], object]:
    env = CarOnHill(mass=1.0)
    stage = Stage(1, 1, env, FQI(10**9, EPISODES, ForestRegressor()), (), 0)
    run = learn([stage], SeedBatch((0,), probed_states(env)))
    (data,) = next(run).result.data
    print(f"our dataset: {int(data.multiplicity.sum())} transitions")
    return lambda: next(run)


def main() -> None:
    one_core()
    with threadpool_limits(1):
        calls = [their_fqi(), our_fqi()]
        by_turns(calls, EARLY)
        theirs, ours = (1e3 * t for t in by_turns(calls, 3))
    print("| FQI iteration, car on the hill | MushroomRL | bcrl | ratio |")
    print(f"|---|---|---|---|\n| | {theirs:.0f} ms | {ours:.0f} ms ", end="")
    print(f"| {theirs / ours:.1f}× |")


if __name__ == "__main__":
    main()
