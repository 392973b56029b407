"""Environments as pictures: one function each, and bars for other environments."""

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from bcrl.envs import Env
from bcrl.envs.base import Floats
from bcrl.envs.maze import GOAL_RADIUS

_SIZE = 400  # pixels of a picture's sides
FINER = 2  # the drawing has so many times the pixels, for smooth edges
FONT = ImageFont.load_default(15 * FINER)

#: Okabe and Ito's colours, which colour-blind people can distinguish, and greys.
BLUE, ORANGE, GREEN, RED, SKY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9"
PAPER, PALE, GREY, INK = "#FBFBF9", "#E4E4DF", "#8A8A85", "#2B2B2B"


class Canvas:
    """A square picture of [left, left + side] × [bottom, bottom + side].

    Points (n, 2) and lengths have the view's units, y upwards; widths are in pixels.
    """

    def __init__(self, left: float, bottom: float, side: float, ground: str) -> None:
        self.corner, self.scale = np.array([left, bottom]), _SIZE * FINER / side
        self._image = Image.new("RGB", (_SIZE * FINER, _SIZE * FINER), ground)
        self._pen = ImageDraw.Draw(self._image)

    def _pixels(self, points: Any) -> list[tuple[float, float]]:
        x, y = ((np.asarray(points, float) - self.corner) * self.scale).T
        return list(zip(x, _SIZE * FINER - y, strict=True))

    def polygon(self, points: Any, fill: str) -> None:
        self._pen.polygon(self._pixels(points), fill)

    def rectangle(self, x0: float, y0: float, x1: float, y1: float, fill: str) -> None:
        self.polygon([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], fill)

    def line(self, points: Any, fill: str, width: int) -> None:
        self._pen.line(self._pixels(points), fill, width * FINER, joint="curve")

    def disc(self, at: Any, radius: float, fill: str, edge: str | None = None) -> None:
        ((x, y),) = self._pixels([at])
        self._pen.circle((x, y), radius * self.scale, fill, edge, 2 * FINER)

    def arrow(self, at: Any, vector: Any, fill: str, width: int = 3) -> None:
        """From `at` along `vector`; nothing if that is shorter than its head."""
        length, head = np.linalg.norm(vector), 4 * width * FINER / self.scale
        if length >= head:
            along = np.asarray(vector) / length
            across = 0.5 * head * np.array([-along[1], along[0]])
            tip = np.asarray(at) + vector
            neck = tip - head * along
            self.line([at, neck], fill, width)
            self.polygon([tip, neck + across, neck - across], fill)

    def text(self, x: int, y: int, words: str, anchor: str = "la") -> None:
        """Words at a pixel of the picture, from its upper left corner."""
        self._pen.text((x * FINER, y * FINER), words, INK, FONT, anchor)

    def picture(self) -> NDArray[np.uint8]:
        """The drawing, (400, 400, 3)."""
        return np.asarray(self._image.reduce(FINER))


def draw(env: Env, path: Floats, action: Any = None, caption: str = "") -> NDArray:
    """A picture (400, 400, 3), with a caption, of an environment in states (n, d).

    `action`, a number or a force (k,), is applied in the last state of `path`.
    """
    vectors = getattr(env, "actions", None)
    if action is not None and np.ndim(action) == 0 and vectors is not None:
        action = vectors[action]
    drawing = {
        "bcrl.envs.car_on_hill": _car_on_hill,
        "bcrl.envs.linear_system": _linear_system,
        "bcrl.envs.maze": _maze,
    }.get(type(env).__module__, _bars)
    canvas = drawing(env, np.asarray(path, float), action)
    canvas.text(12, _SIZE - 10, caption, "ld")
    return canvas.picture()


def frames_per_second(env: Env) -> int:
    """The number of steps that an animation shows per second."""
    return 20 if type(env).__module__ == "bcrl.envs.linear_system" else 10


def _height(p: Any) -> Any:
    return np.where(p < 0.0, p * p + p, p / np.sqrt(1.0 + 5.0 * p * p))


def _car_on_hill(env: Any, path: Floats, force: Any) -> Canvas:
    """The car on its hill: the goal's flag on the right, the drop on the left."""
    canvas = Canvas(-1.3, -0.95, 2.6, PAPER)
    p = np.linspace(-1.3, 1.3, 131)
    profile = np.stack([p, _height(p)], -1)
    canvas.polygon([(-1.3, -0.95), *profile, (1.3, -0.95)], PALE)
    canvas.line(profile, GREY, 3)
    top = float(_height(1.0))
    canvas.line([(1.0, top), (1.0, top + 0.34)], INK, 3)
    canvas.polygon([(1.0, top + 0.34), (1.0, top + 0.2), (1.19, top + 0.27)], GREEN)
    for y in np.arange(0.0, 0.6, 0.1):  # a car that crosses this line is lost
        canvas.line([(-1.0, y), (-1.0, y + 0.05)], RED, 2)
    at = min(max(path[-1, 0], -1.25), 1.25)
    along = np.array([2e-3, _height(at + 1e-3) - _height(at - 1e-3)])
    along /= np.linalg.norm(along)
    axes = np.array([along, [-along[1], along[0]]])
    foot = np.array([at, float(_height(at))])
    body = [(-0.13, 0.05), (0.13, 0.05), (0.13, 0.1), (-0.13, 0.1)]
    cabin = [(-0.08, 0.1), (0.06, 0.1), (0.03, 0.16), (-0.06, 0.16)]
    canvas.polygon(foot + body @ axes, BLUE)
    canvas.polygon(foot + cabin @ axes, SKY)
    canvas.disc(foot + (-0.075, 0.04) @ axes, 0.04, INK)
    canvas.disc(foot + (0.075, 0.04) @ axes, 0.04, INK)
    if force is not None:
        side = np.sign(force[0])
        start = foot + (0.15 * side, 0.09) @ axes
        canvas.arrow(start, 0.25 * side * along, ORANGE, 4)
    canvas.text(_SIZE // 2, 320, f"{path[-1, 1]:+.2f} m/s", "mm")
    canvas.text(12, 10, f"Car on the hill, {env.mass:g} kg")
    return canvas


def _maze(env: Any, path: Floats, force: Any) -> Canvas:
    """The two walls, the goal, the way so far."""
    canvas = Canvas(-0.13, -0.13, 1.26, PALE)
    low, high = -0.025, 1.025  # half a lattice cell beyond the outermost positions
    canvas.rectangle(low, low, high, high, PAPER)
    (x, y), r = env.goal, GOAL_RADIUS  # a diamond, whose outer corners are covered
    canvas.polygon([(x - r, y), (x, y - r), (x + r, y), (x, y + r)], GREEN)
    canvas.rectangle(high, low, 1.1, 1.1, PALE)
    canvas.rectangle(low, high, 1.1, 1.1, PALE)
    for x0, y0, x1, y1 in env.walls:
        below, above = (low if y0 == 0 else y0), (high if y1 == 1 else y1)
        canvas.rectangle(x0, below, x1, above, GREY)
    canvas.disc(path[0], 0.016, PAPER, INK)
    canvas.line(path, SKY, 3)
    canvas.disc(path[-1], 0.024, BLUE)
    if force is not None:
        canvas.arrow(path[-1], 1.6 * np.asarray(force), ORANGE)
    canvas.text(12, 8, f"Maze, walls of height {env.height:g}")
    return canvas


def _linear_system(env: Any, path: Floats, force: Any) -> Canvas:
    """The x–y plane: pathway and goal, the mass with its velocity and the force."""
    left, bottom, side = -5.4, -3.4, 6.8
    scene, narrow = env.scene(), env.task == "target"
    canvas = Canvas(left, bottom, side, PALE if narrow else PAPER)
    if narrow:
        x0, y0, x1, y1 = scene["pathway"]
        canvas.rectangle(x0, y0, x1, y1, PAPER)
        canvas.line([(x0, y0), (x0, y1)], INK, 4)
        canvas.line([(x1, y0), (x1, y1)], INK, 4)
        canvas.arrow((-1.5, -0.95), 1.6 * scene["drift"], GREY)
        canvas.text(250, 246, "drift")
    canvas.line([(left, 0), (left + side, 0)], PALE, 1)
    canvas.disc(scene["goal"][:2], float(scene["goal"][2]), GREEN)
    x0, y0, x1, y1 = scene["start"] + np.array([-0.04, -0.04, 0.04, 0.04])
    canvas.rectangle(x0, y0, x1, y1, PALE)
    places = path[:, [0, 2]]
    for a, b in itertools.pairwise(places):
        if np.abs(b - a).max() < 0.4:  # more is a fresh start, not a motion
            canvas.line([a, b], SKY, 3)
    low = np.array([left, bottom]) + 0.12
    at = np.clip(places[-1], low, low + side - 0.24)
    canvas.disc(at, 0.09, BLUE)
    canvas.arrow(at, 0.8 * path[-1][[1, 3]], BLUE)
    if force is not None:
        canvas.arrow(at, 0.8 * np.asarray(force), ORANGE)
    task = f"narrow pathway, drift {env.drift:g}" if narrow else "LQ task"
    canvas.text(12, 10, f"Linear system, {task}")
    return canvas


def _bars(env: Any, path: Floats, force: Any) -> Canvas:
    """The present state's components as bars, long as x / (1 + |x|)."""
    canvas = Canvas(-1.6, -1.6, 3.2, PAPER)
    height = min(0.4, 2.4 / path.shape[1])
    top = 0.5 * height * path.shape[1]
    for i, value in enumerate(path[-1]):
        y, thick = top - (i + 0.5) * height, 0.3 * height
        end = value / (1.0 + abs(value)) if np.isfinite(value) else 0.0
        canvas.rectangle(-1.0, y - thick, 1.0, y + thick, PALE)
        canvas.rectangle(min(0, end), y - thick, max(0, end), y + thick, BLUE)
        row = round((1.6 - y) / 3.2 * _SIZE)
        canvas.text(8, row, f"s{i}", "lm")
        canvas.text(_SIZE - 8, row, f"{value:.3g}", "rm")
    canvas.line([(0, -top), (0, top)], GREY, 1)
    canvas.text(12, 10, getattr(env, "name", type(env).__name__))
    return canvas
