"""`bcrl-report --compare` and `--sweep`: figures of the runs that a user names."""

import re
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from matplotlib.figure import Figure

from bcrl.errors import BcrlError, closest, did_you_mean
from bcrl.report.figures.curves import figure_metrics, metrics_of
from bcrl.report.figures.layout import Print, save_figure
from bcrl.report.figures.sweep import figure_final, figure_map, figure_sweep
from bcrl.report.load import load_chosen
from bcrl.report.sweeps import sweeps_of
from bcrl.report.variants import Methods, Runs, Variant
from bcrl.results.layout import recorded_seeds

_KEYS = 2  # that one figure can sweep
Named = Iterator[tuple[str, Figure]]  # figures and the ends of their files' names


def draw_chosen(options: Namespace, out: Path, how: Print) -> list[Path]:
    """Write the figures that the command line asks for; BcrlError for unknown names."""
    if options.sweep and len(options.sweep) > _KEYS:
        raise BcrlError(f"--sweep {' '.join(options.sweep)}: takes one key or two")
    place = options.runs_dir, options.scale, options.env
    runs = load_chosen(folders_of(*place, options.compare), options.allow_incomplete)
    methods = labelled(runs.variants)
    metrics = _chosen_metrics(methods, options.metrics)
    envs = "+".join(dict.fromkeys(variant.env for variant in runs.variants))
    kind = "sweep" if options.sweep else "compare"
    stem = options.name or f"{kind}_{envs}_{runs.scale.replace(' and ', '+')}"
    draw = _sweep_figures if options.sweep else _compared
    files: list[Path] = []
    for end, figure in draw(runs, methods, metrics, how.width, options):
        name = re.sub(r"[^\w.@=+-]+", "-", f"{stem}_{end}")
        files += save_figure(figure, out, name, f"{envs}: {end}", how)
    return files


def folders_of(
    runs_dir: Path, scale: str, env: str | None, names: Sequence[str] | None
) -> list[Path]:
    """The variants' folders: of `runs_dir`/`scale`/`env`, all or those of these names
    or patterns (`BC-FQI*`); a name with a slash is itself a folder."""
    paths = [Path(name) for name in names or () if "/" in name]
    for path in paths:
        if not recorded_seeds(path.resolve(), "json"):
            why = "has no seed_*.json" if path.is_dir() else "is not a folder"
            form = "RUNS_DIR/SCALE/ENV/VARIANT"
            raise BcrlError(f"--compare {path}: {why}; a variant's folder is {form}")
    patterns = [name for name in names or ("*",) if "/" not in name]
    if not patterns:
        return paths
    folder = _env_folder(runs_dir / scale, env, patterns)
    there = _folders(folder)
    for pattern in patterns:
        found = [name for name in there if fnmatchcase(name, pattern)]
        if not found:
            near = closest(pattern, there)
            meant = f"did you mean {near}? " if near else ""
            text = f"{meant}In {folder} there are: {', '.join(there)}"
            raise BcrlError(f"--compare {pattern}: no such variant; {text}")
        paths += [folder / name for name in found]
    return list(dict.fromkeys(paths))


def _env_folder(place: Path, env: str | None, patterns: Sequence[str]) -> Path:
    """The folder of the environment, which needs a name if several have the runs."""
    envs = _folders(place)
    if not envs:
        others = ", ".join(_folders(place.parent)) or "nothing"
        raise BcrlError(f"no runs in {place}; in {place.parent} there is: {others}")
    if env and env not in envs:
        raise BcrlError(f"--env {env}: no runs in {place}; {did_you_mean(env, envs)}")
    fitting = [
        each
        for each in envs
        if all(any(fnmatchcase(v, p) for v in _folders(place / each)) for p in patterns)
    ]
    if not env and len(fitting) > 1:
        raise BcrlError(f"--env: needed, one of {', '.join(fitting)}")
    return place / (env or [*fitting, *envs][0])


def _folders(place: Path) -> list[str]:
    """The names of the folders in a folder, without hidden ones and `figures`."""
    if not place.is_dir():
        return []
    found = (path.name for path in place.iterdir() if path.is_dir())
    return sorted(n for n in found if not n.startswith(".") and n != "figures")


def labelled(variants: Sequence[Variant]) -> Methods:
    """The variants by name, with environment, scale and place if these differ."""
    origins = [(v.env, v.folder.parts[-3], str(v.folder.parents[2])) for v in variants]
    differing = [len(set(column)) > 1 for column in zip(*origins, strict=True)]
    found: dict[str, Variant] = {}
    for variant, origin in zip(variants, origins, strict=True):
        told = [
            part for part, differs in zip(origin, differing, strict=True) if differs
        ]
        found[f"{variant.name} ({', '.join(told)})" if told else variant.name] = variant
    return found


def _chosen_metrics(methods: Methods, names: Sequence[str] | None) -> list[str]:
    """The metrics to draw; BcrlError for unknown ones or for two kinds of counters."""
    families = {variant.family: label for label, variant in methods.items()}
    if len(families) > 1:
        both = ", ".join(f"{label} ({family})" for family, label in families.items())
        text = (
            "one counts iterations, the other environment steps; draw one figure each"
        )
        raise BcrlError(f"--compare: {both}: {text}")
    known = metrics_of(methods)
    for name in names or ():
        if name not in known:
            raise BcrlError(f"--metrics {name}: {did_you_mean(name, known)}")
    return list(names or known)


def _compared(
    runs: Runs, methods: Methods, metrics: list[str], width: float, options: Namespace
) -> Named:
    """One figure per metric with the curves of all variants."""
    for metric in metrics:
        shown = _having(methods, metric)
        yield metric, figure_metrics(runs, shown, [metric], width, options.target_only)


def _having(methods: Methods, metric: str) -> Mapping[str, Variant]:
    """The variants that record a metric."""
    return {name: v for name, v in methods.items() if metric in v.metrics}


def _sweep_figures(
    runs: Runs, methods: Methods, metrics: list[str], width: float, options: Namespace
) -> Named:
    """Curves of each sweep and what they end with; for two keys the latter as maps."""
    sweeps = sweeps_of([*methods.values()], options.sweep)
    for metric in metrics:
        if len(options.sweep) == 1:
            yield f"final_{metric}", figure_final(runs, sweeps, metric, width)
        for each in sweeps:
            name = f"{each.label}_{metric}"
            if len(options.sweep) == 1:
                drawn = figure_sweep(runs, each, metric, width, options.target_only)
            else:
                drawn = figure_map(runs, each, metric, width)
            yield name, drawn
