"""Oracles against plainer searches, published values and linear algebra."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bcrl.envs.car_on_hill import CarOnHill
from bcrl.envs.maze import Maze
from bcrl.errors import BcrlError, ConfigError
from bcrl.evaluation import metrics
from bcrl.evaluation.oracle import cache, has_oracle, maze, oracles, reference
from bcrl.evaluation.oracle import car_on_hill as oracle
from bcrl.evaluation.oracle.__main__ import main
from bcrl.evaluation.oracle.car_on_hill import Search, cover, image_boxes
from tests.toys import Corridor

MASSES = pytest.mark.parametrize("mass", [0.8, 1.0, 1.2])
PUBLISHED = Path(__file__).parents[1] / "data" / "car_on_hill_qstar_mass_1.0.csv"


@pytest.fixture(autouse=True, scope="module")
def cache_folder(tmp_path_factory):
    """A cache of this module's own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BCRL_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def plain_search(env, state, action, depth):
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


@MASSES
def test_boxes_enclose_where_their_cells_go(mass):
    cells, n = oracle.COVERS[0], 200_000
    low, high = image_boxes(mass, cells)
    rng = np.random.default_rng(5)
    cell = rng.integers(0, cells, (n, 2))
    cell[: n // 2, 0] = rng.integers(cells // 3, 2 * cells // 3, n // 2)  # near p = 0
    state = 2.0 * (cell + rng.random((n, 2))) / cells - 1.0
    for action in (0, 1):
        after, _, _ = CarOnHill(mass=mass).step(state * (1, 3), np.full(n, action))
        within = (action, cell[:, 0], cell[:, 1])
        spare = 0.3 * np.array([2.0, 6.0]) / cells  # three tenths of a cell
        assert (after >= low[within] + spare).all()
        assert (after <= high[within] - spare).all()


@MASSES
def test_search_agrees_with_plain_search_and_needs_no_particular_cover(mass):
    env, depth = CarOnHill(mass=mass), 12
    states, steps = env.evaluation_states(), oracle.signed_steps(env)
    for s, a in np.ndindex(100, 2):
        plain = plain_search(env, states[s], a, depth) if s % 3 == 0 else 0
        assert plain in (0, steps[s, a])
        assert plain or s % 3 or abs(steps[s, a]) > depth
    coarse = Search(env, *cover(mass, 200), oracle.BUDGET)
    np.testing.assert_array_equal(coarse.signed_steps(states), steps)
    if mass == 1.2:
        assert steps.max() == 26
        for s, a in np.argwhere((steps >= 14) & (steps <= 16))[:3]:
            assert plain_search(env, states[s], a, 16) == steps[s, a]


def test_search_agrees_with_the_published_table():
    table = np.loadtxt(PUBLISHED, delimiter=",", skiprows=1)
    states, published = table[:100, :2], table[:, 3].reshape(2, 100).T
    env = CarOnHill()
    np.testing.assert_array_equal(states, env.evaluation_states())
    # the table counts failures that are not immediate one step too many
    expected = np.where(published < -1, published + 1, published)
    np.testing.assert_array_equal(oracle.signed_steps(env), expected)


def test_a_car_too_heavy_to_leave_the_valley_stays_there_forever():
    valley = np.array([[-0.5, 0.0]])
    search = Search(CarOnHill(mass=5.0), *cover(5.0, 500), oracle.BUDGET)
    steps = search.signed_steps(valley)
    np.testing.assert_array_equal(steps, [[0, 0]])
    np.testing.assert_array_equal(oracle.values(steps, 0.95), [[0.0, 0.0]])


def test_search_ends_at_its_budget(monkeypatch):
    monkeypatch.setattr(oracle, "BUDGET", 50)
    monkeypatch.setattr(oracle, "COVERS", (50, 60))
    with pytest.raises(BcrlError, match=r"env\.mass=1\.21"):
        oracle.signed_steps(CarOnHill(mass=1.21))


def test_values_are_signed_discounts_in_a_read_only_table():
    q = oracle.values(np.array([[1, 3], [-1, -4]]), 0.9)
    np.testing.assert_allclose(q, [[1.0, 0.81], [-1.0, -0.729]])
    known = reference(CarOnHill(mass=0.8))
    assert known is reference(CarOnHill(mass=0.8))
    assert known.q.shape == (100, 2)
    with pytest.raises(ValueError, match="read-only"):
        known.q[0, 0] = 1.0


def test_cache_survives_damage_and_unwritable_folders(tmp_path, monkeypatch):
    calls = []

    def query():
        def compute():
            calls.append(1)
            return np.array([[1, -26], [0, 3]])

        found = cache.cached("t", [Path(__file__)], compute)
        np.testing.assert_array_equal(found, [[1, -26], [0, 3]])
        return len(calls)

    monkeypatch.setenv("BCRL_CACHE", str(tmp_path / "new" / "folder"))
    assert query() == query() == 1
    (path,) = (tmp_path / "new" / "folder").iterdir()  # no draft is left behind
    whole = path.read_bytes()
    number = whole.index(np.int64(-26).tobytes())
    flipped = whole[:number] + b"\1" + whole[number + 1 :]
    for n, damaged in enumerate((b"", whole[:5], whole[:-9], flipped, b"\xff\0"), 2):
        path.write_bytes(damaged)
        assert query() == query() == n
    monkeypatch.setenv("BCRL_CACHE", str(path))  # a file where a folder should be
    assert query() == 7
    monkeypatch.setenv("BCRL_CACHE", "")
    monkeypatch.setenv("XDG_CACHE_HOME", "/some/where")
    assert cache.directory() == Path("/some/where/bcrl")


def test_value_iteration_agrees_with_linear_algebra():
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


def test_maze_optimum_is_the_papers():
    env = Maze(height=0.95)
    assert abs(maze.start_value(env) - -47.557563488) < 1e-8
    known = reference(env)
    assert known.q.shape == (len(known.states), 4)
    assert not (env.blocked(known.states) | env.is_goal(known.states)).any()
    row = np.flatnonzero((known.states == 0).all(-1))
    assert abs(known.q[row].max() - -47.557563488) < 1e-8
    floating = reference(Maze(preset="released"))  # leaves the lattice
    assert np.array_equal(floating.q, reference(Maze()).q)


def test_maze_optimum_is_what_its_greedy_episode_collects():
    env = Maze(height=0.35)
    q, state, value, factor = maze.lattice_q(env), np.zeros(2), 0.0, 1.0
    for _ in range(env.horizon):
        state, reward, done = env.step(state, q[env.index(state)].argmax())
        value, factor = value + factor * float(reward), factor * env.gamma
        if done:
            break
    assert done
    assert abs(value - maze.start_value(env)) < 1e-12


def test_printed_tables(capsys):
    assert main(["car_on_hill", "--mass", "1.0"]) == 0
    lines = capsys.readouterr().out.split()
    assert lines[0] == "position,velocity,action,signed_steps,q"
    for ours, theirs in zip(lines[1:], PUBLISHED.read_text().split()[1:], strict=True):
        assert ours.split(",")[:3] == theirs.split(",")[:3]
    assert main(["maze", "--height", "0.95"]) == 0
    captured = capsys.readouterr()
    assert len(captured.out.split()) == 1 + 4 * len(reference(Maze(0.95)).states)
    assert captured.err.startswith("V*(s0) = -47.557563488")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["car_on_hill", "--mass", "-1"], "env.mass=-1.0"),
        (["car_on_hill", "--mass", "heavy"], "--mass"),
        (["maze", "--preset", "released"], "no table"),
        (["maize"], "maize"),
    ],
)
def test_bad_arguments_are_named(arguments, named, capsys):
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    assert code == 2
    assert named in capsys.readouterr().err


@pytest.mark.parametrize("name", ["cache", "cover", "__main__", "a.b", "", "maze"])
def test_an_oracle_is_for_its_own_class_of_environments(name):
    class Other(Corridor):
        pass

    class Richer(Maze):
        pass

    Other.name = name
    assert not has_oracle(Other()) and reference(Other()) is None
    assert has_oracle(Maze()) and not has_oracle(Richer())
    with pytest.raises(ConfigError, match=r"env\.metrics=q_error"):
        metrics.check_metrics(["q_error"], Other())
    assert sorted(oracles()) == ["car_on_hill", "maze"]
