"""`bcrl-inspect`: what each residual of a run's agents is worth, in tables, figures."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bcrl import __version__
from bcrl.common.files import make_directory, write_text
from bcrl.common.terminal import ready, say, show
from bcrl.envs import Env
from bcrl.errors import BcrlError
from bcrl.inspection.measures import Inspection
from bcrl.inspection.stack import stack
from bcrl.results.layout import INSPECTION
from bcrl.run.agents import seeds_with_agents

_ABOUT = """Look into a boosted Q-function, Q_t = α Q_(t-1) + ϱ_t: how large each
residual ϱ_t is, which greedy actions it changes, what happens without it, and where it
matters. Needs the agents of a run with boosting."""
_CELLS = 41  # of a map, along each axis
_PLANES = {"linear_system": (0, 2)}  # the components of maps, where not the first two


def main(arguments: Sequence[str] | None = None) -> int:
    """Console entry point; 2 for bad input."""
    ready()
    try:
        _inspect(_parser().parse_args(arguments))
    except BcrlError as error:
        say(f"bcrl-inspect: {error}")
        return 2
    return 0


def _inspect(asked: argparse.Namespace) -> None:
    from bcrl.inspection import figures  # matplotlib is slow to import
    from bcrl.report.figures import layout, style

    how = layout.Print(layout.inches(asked.width), layout.formats(asked.format))
    seeds = seeds_with_agents(asked.run, asked.seed)
    if asked.episodes < 1:
        raise BcrlError(f"--episodes {asked.episodes}: must be at least 1")
    out = asked.out or asked.run / INSPECTION
    stages, ablations, maps, plane = [], [], [], None
    for seed in seeds:
        own = Inspection(stack(asked.run, seed, asked.trust), asked.episodes)
        if plane is None:
            plane = plane_of(own, asked.components)
        stages.append(own.stages())
        ablations.append(own.ablations())
        maps.append([*own.contributions(plane.states)])
        say(f"seed {seed}: {len(maps[-1])} residuals")
    make_directory(out, "--out")
    tables = {"stages": pd.concat(stages), "ablations": pd.concat(ablations)}
    files = []
    for name, table in tables.items():
        text = table.to_csv(index=False, lineterminator="\n")
        files.append(write_text(out / f"{name}.csv", text))
    about = f"{asked.run.resolve().parent.name} {asked.run.resolve().name}"
    many = f"{len(seeds)} seed{'s' * (len(seeds) > 1)}"
    with style.sheet():
        drawn = {
            "stages": figures.figure_stages(tables["stages"], how.width),
            "ablations": figures.figure_ablations(tables["ablations"], how.width),
            "maps": figures.figure_maps(np.mean(maps, axis=0), plane, how.width),
        }
        for name, figure in drawn.items():
            title = f"{about}, {many}: {name}"
            files += layout.save_figure(figure, out, name, title, how)
    shown = tables["stages"].drop(columns="seed").groupby("stage").mean()
    show(shown.dropna(axis=1).round(4).to_string())
    show("\n".join(map(str, files)))


def plane_of(own: Inspection, components: Sequence[int] | None) -> Any:
    """The states of the maps: two components vary over the data, others are medians."""
    from bcrl.inspection.figures import Plane

    env = own.stack.agent.task
    d, seen = env.state_dim, own.visits[-1].points
    if d < 2:
        raise BcrlError(f"{env.name} has one state component; a map needs two")
    chosen = tuple(components or _PLANES.get(env.name, (0, 1)))
    if len({*chosen}) != 2 or not all(0 <= c < d for c in chosen):
        given = " ".join(map(str, chosen))
        raise BcrlError(f"--components {given}: must be two of 0 to {d - 1}")
    names = names_of(env, d)
    if hasattr(env, "states"):  # the lattice itself
        states = env.states()
        x, y = np.unique(states[:, 0]), np.unique(states[:, 1])
        return Plane(states, x, y, (names[0], names[1]), "")
    low, high = np.quantile(seen[:, chosen], [0.01, 0.99], axis=0)
    x, y = (np.linspace(a, b, _CELLS) for a, b in zip(low, high, strict=True))
    states = np.tile(np.median(seen, axis=0), (_CELLS**2, 1))
    grid = np.meshgrid(x, y, indexing="ij")
    for component, each in zip(chosen, grid, strict=True):
        states[:, component] = each.reshape(-1)
    fixed = ", ".join(
        f"{names[i]} = {states[0, i]:.3g}" for i in range(d) if i not in chosen
    )
    return Plane(states, x, y, (names[chosen[0]], names[chosen[1]]), fixed)


def names_of(env: Env, d: int) -> list[str]:
    """The names of the state's components; numbered where an env doesn't say them."""
    return list(getattr(env, "components", None) or [f"s[{i}]" for i in range(d)])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bcrl-inspect", description=_ABOUT)
    add = parser.add_argument
    more = {"action": "append", "default": []}
    add("run", type=Path, metavar="RUN", help="the folder of a variant's results")
    add("--seed", type=int, help="only this one; may be repeated", **more)
    text = "of each ablation, where they start at random; default: %(default)s"
    add("--episodes", type=int, default=50, help=text)
    text = "numbers of the two state components of the maps, from 0; default: 0 1"
    add("--components", type=int, nargs=2, metavar="N", help=text)
    add("--out", type=Path, metavar="FOLDER", help="default: RUN/inspection")
    add("--width", default="text", help="column, text or inches; default: %(default)s")
    add(
        "--format", nargs="+", default=["png,pdf"], metavar="KIND", help="png, pdf, svg"
    )
    add("--trust", metavar="PACKAGE", help="of your own", **more)
    add("--version", action="version", version=f"bcrl {__version__}")
    return parser


if __name__ == "__main__":
    sys.exit(main())
