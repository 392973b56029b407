"""Oracles against plainer searches, published values and linear algebra."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bcrl.envs.car_on_hill import CarOnHill
from bcrl.envs.maze import Maze
from bcrl.errors import BcrlError, ConfigError
from bcrl.evaluation import metrics
from bcrl.evaluation.oracle import available, cache, maze, oracles, reference
from bcrl.evaluation.oracle import car_on_hill as oracle
from bcrl.evaluation.oracle.__main__ import main
from bcrl.evaluation.oracle.cover import FAR, cover, image_boxes
from tests.toys import Corridor

MASSES = (0.8, 1.0, 1.2)
PUBLISHED = Path(__file__).parents[1] / "data" / "car_on_hill_qstar_mass_1.0.csv"


@pytest.fixture(autouse=True, scope="module")
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A cache of this module's own."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BCRL_CACHE", str(folder))
        yield folder


def plain_search(
    env: CarOnHill, state: NDArray[np.float64], action: int, depth: int
) -> int:
    """Signed steps by breadth-first search over everything; 0 beyond `depth` steps."""
    frontier, reward, absorbing = env.step(state[None], np.array([action]))
    for k in range(1, depth + 1):
        if (reward > 0).any():
            return k
        frontier = frontier[~absorbing]
        if not len(frontier):
            return -k
        if k < depth:
            twice = np.repeat(frontier, 2, axis=0)
            choice = np.tile([0, 1], len(frontier))
            frontier, reward, absorbing = env.step(twice, choice)
    return 0


@pytest.mark.parametrize("mass", MASSES)
def test_boxes_enclose_where_their_cells_go(mass: float) -> None:
    cells, n = oracle.COVERS[0], 400_000
    low, high = image_boxes(mass, cells)
    rng = np.random.default_rng(5)
    cell = rng.integers(0, cells, (n, 2))
    cell[: n // 2, 0] = rng.integers(cells // 3, 2 * cells // 3, n // 2)  # near p = 0
    state = 2.0 * (cell + rng.random((n, 2))) / cells - 1.0
    for action in (0, 1):
        after, _, _ = CarOnHill(mass=mass).step(state * (1, 3), np.full(n, action))
        within = (action, cell[:, 0], cell[:, 1])
        # and with three tenths of a cell to spare
        spare = 0.3 * np.array([2.0, 6.0]) / cells
        assert (after >= low[within] + spare).all()
        assert (after <= high[within] - spare).all()


@pytest.mark.parametrize("mass", MASSES)
def test_search_agrees_with_plain_breadth_first_search(mass: float) -> None:
    env, depth = CarOnHill(mass=mass), 13
    states, steps = env.evaluation_states(), oracle.signed_steps(env)
    for s in range(0, 100, 2):
        for a in (0, 1):
            plain = plain_search(env, states[s], a, depth)
            assert plain == (steps[s, a] if abs(steps[s, a]) <= depth else 0)


def test_search_agrees_with_plain_search_at_sixteen_steps() -> None:
    env = CarOnHill(mass=1.2)
    states, steps = env.evaluation_states(), oracle.signed_steps(env)
    deep = np.argwhere((steps >= 14) & (steps <= 16))
    assert len(deep) > 3
    for s, a in deep[:6]:
        assert plain_search(env, states[s], a, 16) == steps[s, a]


def test_search_agrees_with_the_published_table() -> None:
    table = np.loadtxt(PUBLISHED, delimiter=",", skiprows=1)
    states, published = table[:100, :2], table[:, 3].reshape(2, 100).T
    env = CarOnHill()
    np.testing.assert_array_equal(states, env.evaluation_states())
    # the table counts failures that are not immediate one step too many
    expected = np.where(published < -1, published + 1, published)
    np.testing.assert_array_equal(oracle.signed_steps(env), expected)


def test_longest_shortest_path_of_the_heavy_car() -> None:
    assert oracle.signed_steps(CarOnHill(mass=1.2)).max() == 26


@pytest.mark.parametrize("mass", MASSES)
def test_bound_does_not_depend_on_the_cover(mass: float) -> None:
    env = CarOnHill(mass=mass)
    states = env.evaluation_states()
    coarse = oracle.search(env, states, cover(mass, 200), oracle.BUDGET)
    np.testing.assert_array_equal(coarse, oracle.signed_steps(env))


def test_bellman_equation_holds_along_the_search() -> None:
    # k(s, a) = 1 + the least k(s', ·) wherever s' can still arrive
    env = CarOnHill(mass=1.2)
    states = env.evaluation_states()
    known = cover(1.2, oracle.COVERS[0])
    steps = oracle.signed_steps(env)
    after, _, absorbing = env.step(states[:, None], np.arange(2))
    going = ~absorbing
    onward = oracle.search(env, after[going], known, oracle.BUDGET)
    best = np.where(onward > 0, onward, FAR).min(-1)
    longest = onward.min(-1)
    arrives = best < FAR
    expected = np.where(arrives, 1 + best, longest - 1)
    np.testing.assert_array_equal(steps[going], expected)


def test_a_car_too_heavy_to_leave_the_valley_stays_for_good() -> None:
    env = CarOnHill(mass=5.0)
    known = cover(5.0, 500)
    steps = oracle.search(env, np.array([[-0.5, 0.0]]), known, oracle.BUDGET)
    np.testing.assert_array_equal(steps, [[0, 0]])
    np.testing.assert_array_equal(oracle.values(steps, 0.95), [[0.0, 0.0]])


def test_search_gives_up_beyond_its_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    env = CarOnHill(mass=1.2)
    assert oracle.search(env, env.evaluation_states(), cover(1.2, 100), 50) is None
    monkeypatch.setattr(oracle, "BUDGET", 50)
    monkeypatch.setattr(oracle, "COVERS", (50, 60))
    with pytest.raises(BcrlError, match=r"env\.mass=1\.21"):
        oracle.signed_steps(CarOnHill(mass=1.21))


def test_values_are_signed_discounts() -> None:
    q = oracle.values(np.array([[1, 3], [-1, -4]]), 0.9)
    np.testing.assert_allclose(q, [[1.0, 0.81], [-1.0, -0.729]])


def test_reference_is_one_read_only_table_for_each_task() -> None:
    known = reference(CarOnHill(mass=0.8))
    assert known is reference(CarOnHill(mass=0.8))
    assert known.q.shape == (100, 2)
    with pytest.raises(ValueError, match="read-only"):
        known.q[0, 0] = 1.0

    @dataclasses.dataclass(frozen=True)
    class Elsewhere:
        name = "elsewhere"

    assert reference(Elsewhere()) is None


def test_cache_survives_damage_and_unwritable_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def ask() -> NDArray[np.int64]:
        def compute() -> NDArray[np.int64]:
            calls.append(1)
            return np.array([[1, -26], [0, 3]])

        return cache.cached("t", "mass 1", [Path(__file__)], (2, 2), compute)

    monkeypatch.setenv("BCRL_CACHE", str(tmp_path / "new" / "folder"))
    first = ask()
    np.testing.assert_array_equal(ask(), first)
    assert len(calls) == 1
    (path,) = (tmp_path / "new" / "folder").iterdir()  # no draft is left behind
    whole = path.read_bytes()
    flipped = whole.replace(b"-26", b"-25")
    for n, damaged in enumerate((b"", whole[:5], whole[:-9], flipped, b"\xff\0"), 2):
        path.write_bytes(damaged)
        np.testing.assert_array_equal(ask(), first)
        assert len(calls) == n
        assert path.read_bytes() == whole
    monkeypatch.setenv("BCRL_CACHE", str(path))  # a file where a folder should be
    np.testing.assert_array_equal(ask(), first)
    assert len(calls) == 7


def test_cache_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BCRL_CACHE", "")
    monkeypatch.setenv("XDG_CACHE_HOME", "/some/where")
    assert cache.directory() == Path("/some/where/bcrl")
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setenv("HOME", "/a/home")
    assert cache.directory() == Path("/a/home/.cache/bcrl")


def test_value_iteration_agrees_with_linear_algebra() -> None:
    # a random finite task: the fixpoint's greedy policy, evaluated by a linear solve
    rng = np.random.default_rng(6)
    n, gamma = 30, 0.9
    after, reward = rng.integers(0, n, (n, 3)), rng.normal(size=(n, 3))
    absorbing = rng.random((n, 3)) < 0.1
    q = maze.optimal_q(after, reward, absorbing, gamma)
    rows, greedy = np.arange(n), q.argmax(-1)
    moves = np.zeros((n, n))
    moves[rows, after[rows, greedy]] = ~absorbing[rows, greedy]
    value = np.linalg.solve(np.eye(n) - gamma * moves, reward[rows, greedy])
    np.testing.assert_allclose(q.max(-1), value, atol=1e-12)
    backup = reward + gamma * np.where(absorbing, 0.0, value[after])
    np.testing.assert_allclose(backup, q, atol=1e-12)  # so the policy is optimal


def test_maze_optimum_is_the_papers() -> None:
    env = Maze(height=0.95)
    assert abs(maze.start_value(env) - -47.557563488) < 1e-8
    known = reference(env)
    assert known.q.shape == (len(known.states), 4)
    assert not (env.blocked(known.states) | env.is_goal(known.states)).any()
    row = np.flatnonzero((known.states == 0).all(-1))
    assert abs(known.q[row].max() - -47.557563488) < 1e-8


def test_maze_optimum_is_what_its_greedy_episode_collects() -> None:
    env = Maze(height=0.35)
    q, state, value, factor = maze.lattice_q(env), np.zeros(2), 0.0, 1.0
    for _ in range(env.horizon):
        state, reward, done = env.step(state, q[env.index(state)].argmax())
        value, factor = value + factor * float(reward), factor * env.gamma
        if done:
            break
    assert done
    assert abs(value - maze.start_value(env)) < 1e-12


def test_maze_off_the_lattice_is_compared_with_the_lattices_values() -> None:
    floating, lattice = reference(Maze(preset="released")), reference(Maze())
    assert np.array_equal(floating.states, lattice.states)
    assert np.array_equal(floating.q, lattice.q)


def test_printed_table_matches_the_published_one(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["car_on_hill", "--mass", "1.0"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "position,velocity,action,signed_steps,q"
    for ours, theirs in zip(
        printed[1:], PUBLISHED.read_text().split()[1:], strict=True
    ):
        assert ours.split(",")[:3] == theirs.split(",")[:3]


def test_printed_maze_has_every_state_and_its_optimum(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["maze", "--height", "0.95"]) == 0
    captured = capsys.readouterr()
    assert len(captured.out.splitlines()) == 1 + 4 * len(reference(Maze(0.95)).states)
    assert captured.err.startswith("V*(s0) = -47.557563488")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["car_on_hill", "--mass", "-1"], "env.mass=-1.0"),
        (["car_on_hill", "--mass", "heavy"], "--mass"),
        (["maze", "--height", "1"], "env.height=1.0"),
        (["maze", "--preset", "released"], "no table"),
        (["maize"], "did you mean maze?"),
        ([], "ENV"),
    ],
)
def test_bad_arguments_get_one_line(
    arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    error = capsys.readouterr().err
    assert code == 2
    assert says in error
    assert error.count("\n") == 1


def test_a_closed_pipe_is_no_error() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "bcrl.oracle", "maze"]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert done.returncode == 141
    assert b"Traceback" not in done.stderr
    assert b"Error" not in done.stderr


@pytest.mark.parametrize(
    "name", ["cache", "cover", "riccati", "__main__", "__init__", "a.b", "", "maze"]
)
def test_only_an_oracle_of_an_environment_counts_as_its_oracle(name: str) -> None:
    class Other(Corridor):
        pass

    Other.name = name
    env = Other()
    assert not available(env) and reference(env) is None
    with pytest.raises(ConfigError, match=r"env\.metrics=q_error"):
        metrics.check(["q_error"], env)
    assert sorted(oracles()) == ["car_on_hill", "maze"]


def test_a_kind_of_maze_with_other_rewards_has_no_oracle() -> None:
    class Richer(Maze):
        pass

    assert available(Maze()) and not available(Richer())
