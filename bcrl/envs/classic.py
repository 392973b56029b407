"""The physics of Gymnasium's classic control, as functions of its hidden state.

Each function does what `step` of Gymnasium's class does, operation by operation, so the
numbers are equal in every bit; another order of operations would change results. The
constants come from an environment, so they hold all arguments and attributes.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bcrl.common.compiling import kept
from bcrl.envs.base import Floats
from bcrl.envs.compiled import compiled_step

_SQUARE = 2.0  # a constant, since a compiler replaces a literal power by x · x


class Physics(NamedTuple):
    """What replaces the step of one class."""

    step: Callable[..., tuple]  # of hidden states (n, h) and the constants
    constants: Callable[[Any, list], tuple]  # of an environment and its actions
    observation: Callable[[Floats], NDArray]  # (n, d) of hidden states (n, h)


class UnknownPhysics(Exception):
    """An environment whose step is not known here."""


def _numbers(env: Any, names: str) -> tuple[float, ...]:
    """Attributes of an environment; UnknownPhysics for one that is no plain number."""
    found = [getattr(env, name) for name in names.split()]
    if not all(type(value) in (int, float) for value in found):
        raise UnknownPhysics
    return tuple(map(float, found))


@kept(nogil=True)
def _clipped(x: float, low: float, high: float) -> float:
    x = low if x < low else x
    return high if x > high else x


def _as_float32(hidden: Floats) -> NDArray[np.float32]:
    return hidden.astype(np.float32)


@compiled_step
def _cart_pole(state, action, noise, forces, constants, euler, sutton_barto):
    """State (x, ẋ, angle, its rate); both limits end an episode."""
    gravity, pole, total, length, pole_length, tau, limit, angle_limit = constants
    x, x_dot, angle, rate = state
    cosine, sine = math.cos(angle), math.sin(angle)
    push = (forces[action] + pole_length * (rate * rate) * sine) / total
    inertia = length * (4.0 / 3.0 - pole * (cosine * cosine) / total)
    rate_dot = (gravity * sine - cosine * push) / inertia
    x_dot_dot = push - pole_length * rate_dot * cosine / total
    if euler:
        x, angle = x + tau * x_dot, angle + tau * rate
    x_dot, rate = x_dot + tau * x_dot_dot, rate + tau * rate_dot
    if not euler:
        x, angle = x + tau * x_dot, angle + tau * rate
    fallen = x < -limit or x > limit or angle < -angle_limit or angle > angle_limit
    reward = (-1.0 if fallen else 0.0) if sutton_barto else 1.0
    return (x, x_dot, angle, rate), reward, fallen


def _cart_pole_constants(env: Any, actions: list) -> tuple:
    names = "gravity masspole total_mass length polemass_length tau"
    constants = _numbers(env, f"{names} x_threshold theta_threshold_radians")
    (force,) = _numbers(env, "force_mag")
    forces = np.array([force if action == 1 else -force for action in actions])
    euler = env.kinematics_integrator == "euler"
    return forces, constants, euler, bool(env._sutton_barto_reward)


@compiled_step
def _mountain_car(state, action, noise, pushes, constants):
    """State (position, velocity)."""
    gravity, fastest, low, high, goal, goal_velocity = constants
    position, velocity = state
    velocity += pushes[action] + math.cos(3.0 * position) * -gravity
    velocity = _clipped(velocity, -fastest, fastest)
    position = _clipped(position + velocity, low, high)
    if position == low and velocity < 0.0:
        velocity = 0.0
    arrived = position >= goal and velocity >= goal_velocity
    return (position, velocity), -1.0, arrived


def _mountain_car_constants(env: Any, actions: list) -> tuple:
    names = "force gravity max_speed min_position max_position goal_position"
    force, *constants = _numbers(env, f"{names} goal_velocity")
    return np.array([(action - 1) * force for action in actions]), tuple(constants)


@kept(nogil=True, error_model="numpy")
def _slope(state: Any, torque: float, constants: Any, nips: bool) -> tuple:
    """The acrobot's derivative: of its angles, then of their rates."""
    m1, m2, l1, c1, c2, inertia, square = constants
    a1, a2, v1, v2 = state
    d1 = m2 * (pow(l1, square) + pow(c2, square) + 2.0 * l1 * c2 * math.cos(a2))
    d1 = m1 * pow(c1, square) + d1 + inertia + inertia
    d2 = m2 * (pow(c2, square) + l1 * c2 * math.cos(a2)) + inertia
    phi2 = m2 * c2 * 9.8 * math.cos(a1 + a2 - math.pi / 2.0)
    phi1 = -m2 * l1 * c2 * pow(v2, square) * math.sin(a2)
    phi1 -= 2.0 * m2 * l1 * c2 * v2 * v1 * math.sin(a2)
    phi1 += (m1 * c1 + m2 * l1) * 9.8 * math.cos(a1 - math.pi / 2.0)
    phi1 += phi2
    push = torque + d2 / d1 * phi1
    if not nips:
        push -= m2 * l1 * c2 * pow(v1, square) * math.sin(a2)
    below = m2 * pow(c2, square) + inertia - pow(d2, square) / d1
    v2_dot = (push - phi2) / below
    return v1, v2, -(d2 * v2_dot + phi1) / d1, v2_dot


@kept(nogil=True)
def _along(state: Any, dt: float, k: Any) -> tuple:
    a1, a2, v1, v2 = state
    return a1 + dt * k[0], a2 + dt * k[1], v1 + dt * k[2], v2 + dt * k[3]


@kept(nogil=True)
def _mean(k1: float, k2: float, k3: float, k4: float) -> float:
    return k1 + 2.0 * k2 + 2.0 * k3 + k4


@kept(nogil=True)
def _wrapped(angle: float) -> float:
    while angle > math.pi:
        angle = angle - 2.0 * math.pi
    while angle < -math.pi:
        angle = angle + 2.0 * math.pi
    return angle


@compiled_step
def _acrobot(state, action, noise, torques, dt, fastest, constants, nips):
    """State: two angles, then their rates; one Runge-Kutta step of fourth order."""
    torque, s = torques[action], (state[0], state[1], state[2], state[3])
    a = _slope(s, torque, constants, nips)
    b = _slope(_along(s, dt / 2.0, a), torque, constants, nips)
    c = _slope(_along(s, dt / 2.0, b), torque, constants, nips)
    d = _slope(_along(s, dt, c), torque, constants, nips)
    k1, k2 = _mean(a[0], b[0], c[0], d[0]), _mean(a[1], b[1], c[1], d[1])
    k3, k4 = _mean(a[2], b[2], c[2], d[2]), _mean(a[3], b[3], c[3], d[3])
    a1, a2, v1, v2 = _along(s, dt / 6.0, (k1, k2, k3, k4))
    a1, a2 = _wrapped(a1), _wrapped(a2)
    v1 = _clipped(v1, -fastest[0], fastest[0])
    v2 = _clipped(v2, -fastest[1], fastest[1])
    high = -math.cos(a1) - math.cos(a2 + a1) > 1.0
    return (a1, a2, v1, v2), (0.0 if high else -1.0), high


def _acrobot_constants(env: Any, actions: list) -> tuple:
    dt, noise, *fastest = _numbers(env, "dt torque_noise_max MAX_VEL_1 MAX_VEL_2")
    if noise > 0.0:
        raise UnknownPhysics
    names = "LINK_MASS_1 LINK_MASS_2 LINK_LENGTH_1 LINK_COM_POS_1 LINK_COM_POS_2"
    constants = *_numbers(env, f"{names} LINK_MOI"), _SQUARE
    torques = np.array([env.AVAIL_TORQUE[action] for action in actions], np.float64)
    return torques, dt, tuple(fastest), constants, env.book_or_nips == "nips"


def _acrobot_seen(hidden: Floats) -> NDArray[np.float32]:
    a1, a2, v1, v2 = hidden.T
    seen = [np.cos(a1), np.sin(a1), np.cos(a2), np.sin(a2), v1, v2]
    return np.array(seen, np.float32).T


@compiled_step
def _pendulum(state, action, noise, pushes, costs, pull, dt, fastest, square):
    """State (angle from upright, its rate); an episode never terminates."""
    angle, rate = state
    normal = (angle + math.pi) % (2.0 * math.pi) - math.pi
    cost = pow(normal, square) + 0.1 * pow(rate, square) + costs[action]
    rate += (pull * math.sin(angle) + pushes[action]) * dt
    rate = _clipped(rate, -fastest, fastest)
    return (angle + rate * dt, rate), -cost, False


def _pendulum_constants(env: Any, actions: list) -> tuple:
    g, mass, length, dt, fastest, most = _numbers(env, "g m l dt max_speed max_torque")
    torques = [np.clip(action, -most, most)[0] for action in actions]  # float32
    pushes = np.array([3.0 / (mass * length**2) * u for u in torques], np.float64)
    costs = np.array([0.001 * (u**2) for u in torques], np.float64)
    return pushes, costs, 3 * g / (2 * length), dt, fastest, _SQUARE


def _pendulum_seen(hidden: Floats) -> NDArray[np.float32]:
    angle, rate = hidden.T
    return np.array([np.cos(angle), np.sin(angle), rate], np.float32).T


#: By module and name of Gymnasium's class.
PHYSICS = {
    "cartpole.CartPoleEnv": Physics(_cart_pole, _cart_pole_constants, _as_float32),
    "mountain_car.MountainCarEnv": Physics(
        _mountain_car, _mountain_car_constants, _as_float32
    ),
    "acrobot.AcrobotEnv": Physics(_acrobot, _acrobot_constants, _acrobot_seen),
    "pendulum.PendulumEnv": Physics(_pendulum, _pendulum_constants, _pendulum_seen),
}


def physics_of(env: Any) -> Physics | None:
    """The physics of an unwrapped environment, if it is known here."""
    cls = type(env)
    owner, _, module = cls.__module__.rpartition(".")
    ours = owner == "gymnasium.envs.classic_control"
    return PHYSICS.get(f"{module}.{cls.__qualname__}") if ours else None
