"""GIFs of what was learned: a greedy episode in the target task, as recorded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bcrl.common.files import write_atomically
from bcrl.envs import is_simulated, tasks_of
from bcrl.envs.rendering import draw, frames_per_second
from bcrl.errors import BcrlError, did_you_mean
from bcrl.report.variants import Runs, Variant
from bcrl.results.read import bad_file

_COLOURS = 64  # of a GIF's palette
_PAUSE = 1500  # ms that the last frame stands
_RETURNS = ("greedy_return", "return")  # columns that say how good a policy is


def animations(
    runs: Runs, out: Path, tag: str | None, names: Sequence[str] = ()
) -> tuple[list[Path], list[str]]:
    """Write a GIF for each variant chosen; the files, and what was skipped and why.

    `names` of variants (`BC-FQI`); without any, an environment's and family's best.
    BcrlError if there is no variant of that name.
    """
    files, skipped = [], []
    for variant in _chosen(runs, tag, names):
        path = gif_of(runs, variant, out)
        try:
            shown = list(frames(variant, typical_seed(variant)))
            files.append(_write(path, *zip(*shown, strict=True)))
        except BcrlError as error:
            skipped.append(f"{path.name}: {error}")
        except Exception as error:  # whatever an environment of the user's does
            skipped.append(f"{path.name}: {type(error).__name__}: {error}")
    return files, skipped


def gif_of(runs: Runs, variant: Variant, out: Path) -> Path:
    """Where a variant's GIF is, if it has one."""
    return out / f"agent_{variant.env}_{variant.name}_{runs.scale}.gif"


def _chosen(runs: Runs, tag: str | None, names: Sequence[str]) -> list[Variant]:
    known = {variant.name for variant in runs.variants}
    for name in names:
        if name not in known:
            raise BcrlError(f"--gif {name}: {did_you_mean(name, known)}")
    if names:
        return [variant for variant in runs.variants if variant.name in names]
    best: dict[tuple[str, str], Variant] = {}
    for variant in (v for v in runs.variants if tag in (None, v.tag)):
        rival = best.setdefault((variant.env, variant.family), variant)
        best[variant.env, variant.family] = max(rival, variant, key=_merit)
    return list(best.values())


def _merit(variant: Variant) -> tuple[bool, bool, float]:
    """What makes a variant be shown: no tag, then BC-, then its last mean return."""
    boosted = variant.method.startswith("BC-")
    return variant.tag is None, boosted, float(_last_returns(variant).mean())


def _last_returns(variant: Variant) -> NDArray[np.float64]:
    """Each seed's return at the end, (S,); zeros if none was measured."""
    measured = [variant.last(name) for name in _RETURNS if name in variant.metrics]
    return measured[0] if measured else np.zeros(len(variant.seeds))


def typical_seed(variant: Variant) -> int:
    """The seed with the median return at the end, of two the worse one."""
    order = np.argsort(_last_returns(variant), kind="stable")
    return variant.seeds[order[(len(order) - 1) // 2]]


def frames(variant: Variant, seed: int) -> Iterator[tuple[NDArray[np.uint8], int]]:
    """The T + 1 pictures of a seed's recorded episode, and how long each stands, ms."""
    states, actions = variant.arrays(seed, "trajectory", "trajectory_actions")
    env = tasks_of(variant.sidecars[variant.seeds.index(seed)]["config"]["env"])[-1]
    if states.shape != (len(actions) + 1, env.state_dim):
        what = f"has a trajectory of shape {states.shape}, expected (T + 1, "
        what += f"{env.state_dim}) for actions of shape {actions.shape}"
        raise bad_file(variant.npz(seed), what)
    if is_simulated(env):
        (start,) = variant.arrays(seed, "trajectory_start")
        pictures = env.pictures(start, actions)
    else:
        pictures = (
            draw(
                *(env, states[: t + 1], actions[t] if t < len(actions) else None),
                f"{variant.name}, seed {seed}, step {t}",
            )
            for t in range(len(states))
        )
    duration = 1000 // frames_per_second(env)
    for t, picture in enumerate(pictures):
        yield picture, _PAUSE if t == len(actions) else duration


def _write(
    path: Path, pictures: Sequence[NDArray[np.uint8]], durations: Iterable[int]
) -> Path:
    """A GIF that repeats, all frames with the palette of a middle one."""
    images = [Image.fromarray(picture) for picture in pictures]
    middle = images[(len(images) - 1) // 2]
    palette = middle.quantize(_COLOURS, Image.Quantize.MAXCOVERAGE)
    plain = Image.Dither.NONE
    first, *others = (each.quantize(palette=palette, dither=plain) for each in images)
    options = {"duration": list(durations), "loop": 0, "append_images": others}
    return write_atomically(
        path, lambda handle: first.save(handle, "GIF", save_all=True, **options)
    )
