"""Our environments behind Gymnasium's interface: the same episodes, and its checks."""

import subprocess
import sys
import warnings
from itertools import product

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from bcrl.common.registration import REGISTERED
from bcrl.envs import env_class
from bcrl.envs.car_on_hill import CarOnHill
from bcrl.envs.gym_api import GymEnv, GymVectorEnv
from bcrl.envs.linear_system import LinearSystem
from bcrl.envs.maze import PRESETS, Maze
from bcrl.envs.rendering import draw
from bcrl.errors import BcrlError, ConfigError
from tests.toys import OpenCorridor

LINEAR = product(("lq", "target"), ("paper", "released"))
TASKS = [
    *(("CarOnHill", {"mass": mass}) for mass in (0.01, 0.8, 1.2)),
    *(("Maze", {"preset": preset, "height": 0.5}) for preset in PRESETS),
    *(("LinearSystem", {"task": task, "preset": preset}) for task, preset in LINEAR),
]
everything = pytest.mark.parametrize(("name", "constants"), TASKS, ids=str)


def make(name, **options):
    return gymnasium.make(f"bcrl/{name}-v0", **options)


@everything
def test_gymnasiums_own_checks_pass_without_a_warning(name, constants):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(name, **constants).unwrapped)


def test_all_are_registered_with_their_horizons():
    for name, (env, horizon) in REGISTERED.items():
        assert env_class(env).__name__ == name and env_class(env).horizon == horizon
        assert make(name).spec.max_episode_steps == horizon


def test_the_import_is_light_and_the_id_may_name_the_module():
    program = (
        "import sys, gymnasium; gymnasium.make('bcrl.gym:bcrl/Maze-v0', height=0.5)\n"
        "sys.exit(bool({'torch', 'numba', 'matplotlib'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0


@everything
def test_an_episode_is_the_pure_environments(name, constants):
    env = make(name, **constants)
    ours = env_class(REGISTERED[name][0])(**constants)
    state, info = env.reset(seed=7)
    rng, choices = np.random.default_rng(7), np.random.default_rng(1)
    expected = ours.initial(rng.random(ours.initial_noise))
    assert info == {} and state.tolist() == expected.tolist()
    for t in range(ours.horizon):
        action = int(choices.integers(ours.n_actions))
        state, reward, terminated, truncated, info = env.step(action)
        noise = rng.random(ours.step_noise)
        expected, r, absorbing = ours.step(expected, np.int64(action), noise)
        assert state.tolist() == expected.tolist()
        assert (reward, terminated) == (r, absorbing)
        assert info == {"is_success": bool(absorbing and r >= 0)}
        assert truncated == (t == ours.horizon - 1)
        if terminated or truncated:
            return
    raise AssertionError("an episode has no end")


@everything
def test_many_at_once_are_as_gymnasium_does_it_one_by_one(name, constants):
    options = {"num_envs": 5, "max_episode_steps": 30, **constants}
    ours, theirs = (
        gymnasium.make_vec(f"bcrl/{name}-v0", vectorization_mode=kind, **options)
        for kind in ("vector_entry_point", "sync")
    )
    assert isinstance(ours, GymVectorEnv)
    for each in ("observation_space", "action_space"):
        assert getattr(ours, each) == getattr(theirs, each)
    ours.action_space.seed(3)
    np.testing.assert_equal(ours.reset(seed=11), theirs.reset(seed=11))
    for _ in range(70):  # over two ends
        actions = ours.action_space.sample()
        np.testing.assert_equal(ours.step(actions), theirs.step(actions))


@everything
def test_no_state_leaves_the_box(name, constants):
    envs = gymnasium.make_vec(f"bcrl/{name}-v0", num_envs=200, **constants)
    box = envs.single_observation_space
    envs.action_space.seed(0)
    envs.reset(seed=0)
    for actions in (envs.action_space.sample() for _ in range(6)):
        seen = [envs.step(actions)[0] for _ in range(25)]  # holding one leads far
        assert ((seen >= box.low) & (seen <= box.high)).all()


def test_a_car_at_its_fastest_stays_in_the_box():
    states = np.stack(np.meshgrid(np.linspace(-1, 1, 101), np.linspace(-3, 3, 31)), -1)
    for mass, action in product((0.2, 0.8, 1.0, 1.2, 5.0), (0, 1)):
        low, high = CarOnHill(mass).bounds
        after, _, absorbing = CarOnHill(mass).step(states, np.array(action))
        assert absorbing.any() and ((after >= low) & (after <= high)).all()


def test_what_cannot_be_is_refused_with_the_key():
    wrong = {"mas": 1.0, "mass": -1.0, "horizon": 10, "render_mode": "ansi"}
    for key, value in wrong.items():
        with pytest.raises(ConfigError, match=f"{key}={value}: "):
            GymEnv("car_on_hill", **{key: value})
    with pytest.raises(BcrlError, match="did you mean maze"):
        GymEnv("mase")
    with pytest.raises(TypeError, match="mass"):
        GymEnv(CarOnHill(), mass=1.0)
    env = make("Maze")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="no action"):
        env.step(4)
    assert make("CarOnHill", mass=np.linspace(1, 2, 3)[1]).unwrapped.task.mass == 1.5


@everything
def test_pictures_show_the_state(name, constants):
    env = make(name, render_mode="rgb_array", **constants)
    env.reset(seed=0)
    before = env.render()
    env.step(1)
    assert before.shape == (400, 400, 3) and before.dtype == np.uint8
    assert (before != env.render()).sum() > 100


def test_pictures_show_the_action_and_bear_any_state():
    for env in (CarOnHill(), Maze(), LinearSystem(), LinearSystem(task="lq")):
        here = np.full((1, env.state_dim), 0.3)
        shown = [draw(env, here, action) for action in (None, 0, env.n_actions - 1)]
        assert (shown[0] != shown[1]).any() and (shown[1] != shown[2]).any()
        draw(env, np.full((3, env.state_dim), -1e9))
    for odd in (np.inf, np.nan):  # a car that is too light is lost so
        draw(CarOnHill(), np.full((1, 2), odd))
    force = draw(LinearSystem(task="lq"), np.zeros((1, 4)), np.array([1.0, 0.0]))
    assert (force == draw(LinearSystem(task="lq"), np.zeros((1, 4)), 0)).all()


def test_an_environment_of_the_users_own_is_wrapped():
    env = GymEnv(OpenCorridor(), render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)
    start, _ = env.reset(seed=1)
    assert start == np.floor(5 * np.random.default_rng(1).random(1))
    before = env.render()
    assert env.step(1)[0] == start + 1.0 and (env.render() != before).any()
