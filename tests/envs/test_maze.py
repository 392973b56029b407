"""The maze's geometry, rewards and presets."""

import numpy as np
import pytest

from bcrl.envs.maze import Maze

LEFT, RIGHT, UP = 0, 1, 3


def step(env, x, y, action):
    after, reward, absorbing = env.step(np.array([x, y]), np.array(action))
    return after.tolist(), float(reward), bool(absorbing)


def test_moves_are_a_twentieth_and_clipped_to_the_unit_square():
    env = Maze(0.05)
    assert step(env, 0.5, 0.5, RIGHT) == ([0.55, 0.5], pytest.approx(-0.85), False)
    assert step(env, 0.0, 0.5, LEFT)[0] == [0.0, 0.5]
    assert step(env, 0.4, 1.0, UP)[0] == [0.4, 1.0]


def test_walls_block_strictly_inside_and_leave_the_boundary_free():
    env = Maze(0.95)
    assert step(env, 0.15, 0.5, RIGHT)[0] == [0.15, 0.5]  # first wall, x = 0.2
    assert step(env, 0.15, 0.0, RIGHT)[0] == [0.15, 0.0]  # it stands on the floor
    assert step(env, 0.15, 0.95, RIGHT)[0] == [0.2, 0.95]  # its top edge is free
    assert step(env, 0.55, 0.05, RIGHT)[0] == [0.6, 0.05]  # below the second wall
    assert step(env, 0.55, 0.1, RIGHT)[0] == [0.55, 0.1]
    assert env.blocked(env.states()).sum() == 19 + 19


def test_the_goals_boundary_belongs_to_it_unless_the_text_is_taken_literally():
    boundary = np.array([[0.85, 0.95], [0.95, 0.85], [0.9, 0.9], [0.9, 1], [1, 0.9]])
    assert Maze().is_goal(boundary).all()
    assert not Maze(preset="paper").is_goal(boundary).any()


def test_reaching_the_goal_pays_five_and_absorbs():
    assert step(Maze(), 0.8, 0.95, RIGHT) == ([0.85, 0.95], 5.0, True)


def test_the_released_preset_accumulates_floats():
    state = np.zeros(2)
    for _ in range(3):
        state, _, _ = Maze(preset="released").step(state, np.array(UP))
    assert state[1] == 0.15000000000000002  # 0.05 + 0.05 + 0.05
    assert not Maze(preset="released").finite


def test_index_inverts_states():
    assert np.array_equal(Maze().index(Maze().states()), np.arange(441))
