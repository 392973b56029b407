"""The under-powered car that must rock its way up a hill (paper, §6.1 and C.1)."""

import math
from dataclasses import dataclass

import numpy as np

from bcrl.common.compiling import kept
from bcrl.envs.base import Floats, Ints, Step, check_episodes
from bcrl.envs.compiled import compiled_step
from bcrl.errors import ConfigError

FORCE = 4.0  # N, to the left (action 0) or to the right (action 1)
GRAVITY = 9.81  # m/s²
STEP_TIME = 0.1  # s that a force is held
SUBSTEPS = 6  # Runge-Kutta steps a force is held for; error below 1e-7
MAX_POSITION, MAX_SPEED = 1.0, 3.0  # m, m/s
GRID = 10  # evaluation states along each axis
_START = (-0.5, 0.0)  # m, m/s: at rest in the valley


@dataclass(frozen=True)
class CarOnHill:
    """Drive a car over the hill's right end; not too fast, and not off the left end.

    | | |
    |---|---|
    | observation | p in [−1, 1] m (horizontal position), v in [−3, 3] m/s (its rate) |
    | actions | 0: force u = −4 N, 1: u = +4 N, held for 0.1 s |
    | hill | h'(p) = 2p + 1 if p < 0, else (1 + 5p²)^(−3/2) |
    | | h''(p) = 2 if p < 0, else −15p (1 + 5p²)^(−5/2): a jump at p = 0 |
    | dynamics | dp/dt = v; dv/dt = (u − g m h' − v² m h' h'') / (m (1 + h'²)) |
    | reward | +1 if p > 1 and \\|v\\| ≤ 3; −1 if p < −1 or \\|v\\| > 3; else 0 |
    | absorbing | if the reward is not 0; only the state after 0.1 s counts |
    | start | (−0.5, 0); episodes are cut after 100 steps |
    | source | Ernst, Geurts & Wehenkel (2005); Klink et al. (2022), C.1 |

    `mass` m [kg] is the task parameter, `gamma` the discount per step, `horizon` counts
    steps. A state outside the bounds never changes again and gives reward 0. Raises
    ConfigError for mass ≤ 0, γ outside [0, 1) or a horizon below 1.
    """

    mass: float = 1.0
    gamma: float = 0.95
    horizon: int = 100

    components = ("position p, m", "speed v, m/s")  # of the state
    name, n_actions, state_dim = "car_on_hill", 2, 2
    initial_noise, step_noise = 0, 0
    actions = np.array([[-FORCE], [FORCE]])

    def __post_init__(self) -> None:
        if not 0.0 < self.mass < math.inf:
            raise ConfigError("env.mass", self.mass, "must be positive and finite (kg)")
        check_episodes(self.gamma, self.horizon)

    @property
    def bounds(self) -> Floats:
        """The lowest and the highest states that a step can lead to, (2, 2).

        |dv/dt| ≤ c + v² with c = u/m + g/2, so v grows at most like a tangent, which
        is infinite within a step of a very light car.
        """
        root = math.sqrt(FORCE / self.mass + GRAVITY / 2.0)
        angle = math.atan(MAX_SPEED / root) + root * STEP_TIME
        speed = root * math.tan(angle) if angle < math.pi / 2.0 else math.inf
        high = np.array([MAX_POSITION + STEP_TIME * speed, speed])
        return np.stack([-high, high])

    def initial(self, noise: Floats) -> Floats:
        """The valley (−0.5, 0) for noise of shape (..., 0)."""
        return np.broadcast_to(np.array(_START), (*noise.shape[:-1], 2)).copy()

    def step(self, state: Floats, action: Ints, noise: Floats | None = None) -> Step:
        """Hold a force for 0.1 s; IndexError for an action other than 0 and 1."""
        return _step(state, action, None, self.mass)

    def evaluation_states(self) -> Floats:
        """A 10 × 10 grid over the bounds, position-major, shape (100, 2)."""
        axes = (np.linspace(-x, x, GRID) for x in (MAX_POSITION, MAX_SPEED))
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)


@kept(nogil=True, error_model="numpy")
def _acceleration(p: float, v: float, pull: float, left: bool) -> float:
    """dv/dt [m/s²] on the left or right branch of the hill, both continued past 0."""
    if left:
        slope = 2.0 * p + 1.0
        return (pull - slope * (GRAVITY + 2.0 * v * v)) / (1.0 + slope * slope)
    # with q = 1 + 5p², numerator and denominator times q⁴: one root and one division
    q = 1.0 + 5.0 * p * p
    q2 = q * q
    force = pull * q2 * q2 - GRAVITY * q2 * math.sqrt(q) + 15.0 * p * v * v
    return force / (q2 * q2 + q)


@kept(nogil=True, error_model="numpy")
def _runge_kutta(p: float, v: float, dt: float, pull: float, left: bool) -> tuple:
    """(p, v) after `dt` seconds on one branch: the fifth-order Dormand–Prince step."""
    a1 = _acceleration(p, v, pull, left)
    v2 = v + dt * (a1 / 5)
    p2 = p + dt * (v / 5)
    a2 = _acceleration(p2, v2, pull, left)
    v3 = v + dt * (a1 * (3 / 40) + a2 * (9 / 40))
    p3 = p + dt * (v * (3 / 40) + v2 * (9 / 40))
    a3 = _acceleration(p3, v3, pull, left)
    v4 = v + dt * (a1 * (44 / 45) - a2 * (56 / 15) + a3 * (32 / 9))
    p4 = p + dt * (v * (44 / 45) - v2 * (56 / 15) + v3 * (32 / 9))
    a4 = _acceleration(p4, v4, pull, left)
    b1, b2, b3, b4 = 19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729
    v5 = v + dt * (a1 * b1 + a2 * b2 + a3 * b3 + a4 * b4)
    p5 = p + dt * (v * b1 + v2 * b2 + v3 * b3 + v4 * b4)
    a5 = _acceleration(p5, v5, pull, left)
    b1, b2, b3, b4, b5 = 9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656
    v6 = v + dt * (a1 * b1 + a2 * b2 + a3 * b3 + a4 * b4 + a5 * b5)
    p6 = p + dt * (v * b1 + v2 * b2 + v3 * b3 + v4 * b4 + v5 * b5)
    a6 = _acceleration(p6, v6, pull, left)
    b1, b3, b4, b5, b6 = 35 / 384, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84
    p += dt * (v * b1 + v3 * b3 + v4 * b4 + v5 * b5 + v6 * b6)
    v += dt * (a1 * b1 + a3 * b3 + a4 * b4 + a5 * b5 + a6 * b6)
    return p, v


@kept(nogil=True, error_model="numpy")
def _exit_time(p: float, v: float, a: float, left: bool) -> float:
    """Seconds until p leaves its branch through 0 at constant acceleration, or inf."""
    if left:
        p, v, a = -p, -v, -a
    square = v * v - 2.0 * a * p
    if square < 0.0 or (v >= 0.0 and a >= 0.0):
        return math.inf
    if v > 0.0:
        return (v + math.sqrt(square)) / -a
    bottom = math.sqrt(square) - v
    return 2.0 * p / bottom if bottom > 0.0 else 0.0


@kept(nogil=True, error_model="numpy")
def _cross(p: float, v: float, dt: float, pull: float, left: bool) -> tuple:
    """(p, v, seconds used) at p = 0, or after `dt` if the branch is not left.

    Newton steps correct the parabola's exit time for as long as they land nearer to 0:
    where the car barely turns at 0, an error is small, since the branches differ by v².
    """
    t = _exit_time(p, v, _acceleration(p, v, pull, left), left)
    best_t = max(0.0, min(t, dt))
    best_p, best_v = _runge_kutta(p, v, best_t, pull, left)
    for _ in range(5):
        if best_v == 0.0 or best_p == 0.0:
            break
        t = max(0.0, min(best_t - best_p / best_v, dt))
        new_p, new_v = _runge_kutta(p, v, t, pull, left)
        if abs(new_p) >= abs(best_p):
            break
        best_p, best_v, best_t = new_p, new_v, t
    return best_p, best_v, best_t


@kept(nogil=True, error_model="numpy")
def _advance(p: float, v: float, pull: float) -> tuple[float, float]:
    """(p, v) after 0.1 s under `pull` = u / m [m/s²], bounds ignored.

    A step that crosses the jump of h'' at p = 0 is cut there, then the next one begins.
    """
    left = p < 0.0
    if p == 0.0:
        left = (v if v != 0.0 else _acceleration(p, v, pull, False)) < 0.0
    for _ in range(SUBSTEPS):
        rest = STEP_TIME / SUBSTEPS
        for _ in range(4):  # crossings in one substep; two (in and out) can happen
            new_p, new_v = _runge_kutta(p, v, rest, pull, left)
            crosses = new_p > 0.0 if left else new_p < 0.0
            if not crosses and (v < 0.0) != (new_v < 0.0):  # turned: before 0?
                a = _acceleration(p, v, pull, left)
                crosses = _exit_time(p, v, a, left) < rest
            if not crosses:
                break
            p, v, used = _cross(p, v, rest, pull, left)
            left = not left
            rest -= used
            new_p, new_v = p, v
            if rest <= 0.0:
                break
        p, v = new_p, new_v
    return p, v


@kept(nogil=True, error_model="numpy")
def _outcome(p: float, v: float) -> float:
    """Reward on arriving at (p, v): +1 at the goal, −1 if lost (NaN too), else 0."""
    if not (p >= -MAX_POSITION and abs(v) <= MAX_SPEED):
        return -1.0
    return 1.0 if p > MAX_POSITION else 0.0


@compiled_step
def _step(state, action, noise, mass):
    """The next state, the reward and whether it is absorbing."""
    p, v = state
    if action != 0 and action != 1:
        raise IndexError("car_on_hill has the actions 0 (left) and 1 (right)")
    if _outcome(p, v) != 0.0:
        return (p, v), 0.0, True
    p, v = _advance(p, v, (FORCE if action == 1 else -FORCE) / mass)
    reward = _outcome(p, v)
    return (p, v), reward, reward != 0.0


ENV = CarOnHill
