"""Oracles against plainer searches, published values and linear algebra."""

from pathlib import Path

import numpy as np
import pytest

from bcrl.envs.car_on_hill import CarOnHill
from bcrl.envs.maze import Maze
from bcrl.errors import BcrlError
from bcrl.evaluation.oracle import car_on_hill as oracle
from bcrl.evaluation.oracle import has_oracle, maze, reference
from bcrl.evaluation.oracle.__main__ import main
from tests.toys import Corridor

MASSES = pytest.mark.parametrize("mass", [0.8, 1.0, 1.2])
PUBLISHED = Path(__file__).parents[1] / "data" / "car_on_hill_qstar_mass_1.0.csv"


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
    cells, n = oracle.CELLS, 200_000
    low, high = oracle.image_boxes(mass)
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
def test_search_agrees_with_plain_search_and_needs_no_particular_cover(
    mass, monkeypatch
):
    env, depth = CarOnHill(mass=mass), 12
    states, steps = env.evaluation_states(), oracle.signed_steps(env)
    for s, a in np.ndindex(100, 2):
        plain = plain_search(env, states[s], a, depth) if s % 3 == 0 else 0
        assert plain in (0, steps[s, a])
        assert plain or s % 3 or abs(steps[s, a]) > depth
    monkeypatch.setattr(oracle, "CELLS", 150)
    np.testing.assert_array_equal(oracle.signed_steps(env), steps)
    if mass == 1.2:
        assert steps.max() == 26
        for s, a in np.argwhere((steps >= 14) & (steps <= 16))[:3]:
            assert plain_search(env, states[s], a, 16) == steps[s, a]


def test_search_agrees_with_the_published_table():
    table, env = np.loadtxt(PUBLISHED, delimiter=",", skiprows=1), CarOnHill()
    states, published = table[:100, :2], table[:, 3].reshape(2, 100).T
    np.testing.assert_array_equal(states, env.evaluation_states())
    # the table counts failures that are not immediate one step too many
    expected = np.where(published < -1, published + 1, published)
    np.testing.assert_array_equal(oracle.signed_steps(env), expected)
    q = 0.95 ** (abs(expected) - 1) * np.sign(expected)
    np.testing.assert_allclose(reference(env).q, q)


def test_a_car_too_heavy_to_leave_the_valley_is_an_error():
    with pytest.raises(BcrlError, match=r"env\.mass=5\.0"):
        reference(CarOnHill(mass=5.0))


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
    known = reference(env)
    assert known.q.shape == (len(known.states), 4)
    assert not (env.blocked(known.states) | env.is_goal(known.states)).any()
    row = np.flatnonzero((known.states == 0).all(-1))
    assert abs(known.q[row].max() - -47.557563488) < 1e-8
    floating = reference(Maze(preset="released"))  # leaves the lattice
    assert np.array_equal(floating.q, reference(Maze()).q)


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


def test_an_oracle_is_for_its_own_class_of_environments():
    class Richer(Maze):
        pass

    assert has_oracle(Maze()) and not has_oracle(Richer())
    assert reference(Richer()) is None and reference(Corridor()) is None
