"""GIFs of what was learned: a greedy episode in the target task, as recorded."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from bcrl.common.files import write_atomically
from bcrl.envs import is_simulated, tasks_of
from bcrl.envs.rendering import draw, frames_per_second
from bcrl.errors import BcrlError, did_you_mean
from bcrl.report.variants import Runs, Variant

_COLOURS = 64  # of a GIF's palette
_PAUSE = 1500  # ms that the last frame stands


def animations(
    runs: Runs, out: Path, tag: str | None, names: Sequence[str] = ()
) -> tuple[list[Path], list[str]]:
    """Write a GIF for the variants `names` (`BC-FQI`), or for each environment's best:
    the files, and what was skipped and why. BcrlError for an unknown name."""
    files, skipped = [], []
    for variant in _chosen(runs, tag, names):
        path = gif_of(runs, variant, out)
        try:
            files.append(_write(path, *frames(variant, typical_seed(variant))))
        except Exception as error:  # whatever an environment of the user's does
            kind = "" if isinstance(error, BcrlError) else f"{type(error).__name__}: "
            skipped.append(f"{path.name}: {kind}{error}")
    return files, skipped


def gif_of(runs: Runs, variant: Variant, out: Path) -> Path:
    """Where a variant's GIF is, if it has one."""
    return out / f"agent_{variant.env}_{variant.name}_{runs.scale}.gif"


def _chosen(runs: Runs, tag: str | None, names: Sequence[str]) -> list[Variant]:
    """The variants of these names; without names the best of each environment. Untagged
    ones are better, then BC- ones, then those with a larger last mean return."""
    known = {variant.name for variant in runs.variants}
    for name in names:
        if name not in known:
            raise BcrlError(f"--gif {name}: {did_you_mean(name, known)}")
    if names:
        return [variant for variant in runs.variants if variant.name in names]

    def merit(variant: Variant) -> tuple[bool, bool, float]:
        boosted = variant.method.startswith("BC-")
        return variant.tag is None, boosted, float(_last_returns(variant).mean())

    groups = ([v for v in runs.of(*p) if tag in (None, v.tag)] for p in runs.pairs)
    return [max(group, key=merit) for group in groups if group]


def _last_returns(variant: Variant) -> np.ndarray:
    """Each seed's return at the end, (S,); zeros if none was measured."""
    zeros = np.zeros((len(variant.seeds), 1))
    found = variant.metrics.get("greedy_return", variant.metrics.get("return", zeros))
    return found[:, -1]


def typical_seed(variant: Variant) -> int:
    """The seed with the median return at the end, of two the worse one."""
    order = np.argsort(_last_returns(variant), kind="stable")
    return variant.seeds[order[(len(order) - 1) // 2]]


def frames(variant: Variant, seed: int) -> tuple[list[np.ndarray], int]:
    """The T + 1 pictures of a seed's recorded episode, and how long one stands, ms."""
    states, actions = variant.arrays(seed, "trajectory", "trajectory_actions")
    env = tasks_of(variant.sidecars[variant.seeds.index(seed)]["config"]["env"])[-1]
    if is_simulated(env):
        (start,) = variant.arrays(seed, "trajectory_start")
        pictures = env.pictures(start, actions)
    else:
        title, shown = f"{variant.name}, seed {seed}, step", enumerate([*actions, None])
        pictures = (draw(env, states[: t + 1], a, f"{title} {t}") for t, a in shown)
    return list(pictures), 1000 // frames_per_second(env)


def _write(path: Path, pictures: list[np.ndarray], duration: int) -> Path:
    """A GIF that repeats, all frames with the palette of a middle one."""
    images, plain = [Image.fromarray(each) for each in pictures], Image.Dither.NONE
    middle = images[(len(images) - 1) // 2]
    palette = middle.quantize(_COLOURS, Image.Quantize.MAXCOVERAGE)
    first, *others = (each.quantize(palette=palette, dither=plain) for each in images)
    options = {"duration": [duration] * len(others) + [_PAUSE], "append_images": others}
    save = partial(first.save, format="GIF", save_all=True, loop=0, **options)
    return write_atomically(path, save)
