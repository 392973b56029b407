"""`bcrl-report --compare` and `--sweep`: figures of the runs that a user names."""

import itertools
import os
import re
from argparse import Namespace
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from matplotlib.figure import Figure

from bcrl.common.terminal import say
from bcrl.errors import BcrlError, closest, did_you_mean
from bcrl.report.figures.curves import figure_metrics, metrics_of
from bcrl.report.figures.layout import Print, save_figure
from bcrl.report.figures.style import lines_of
from bcrl.report.figures.sweep import figure_final, figure_map, figure_sweep
from bcrl.report.load import load_chosen
from bcrl.report.sweeps import another, sweeps_of
from bcrl.report.variants import Methods, Runs, Variant
from bcrl.results.layout import recorded_seeds

_KEYS = 2  # that one figure can sweep
_LONGEST = 120  # characters of a file's name, about
Named = Iterator[tuple[str, Figure]]  # figures and the ends of their files' names


def draw_chosen(options: Namespace, out: Path, how: Print) -> list[Path]:
    """Write the figures that the command line asks for; BcrlError for unknown names."""
    if options.sweep and len(options.sweep) > _KEYS:
        raise BcrlError(f"--sweep {' '.join(options.sweep)}: takes one key or two")
    place = options.runs_dir, options.scale, options.env
    runs = load_chosen(folders_of(*place, options.compare), options.allow_incomplete)
    for note in runs.notes:
        say(f"note: {note.text}")
    methods = labelled(runs.variants)
    metrics = _chosen_metrics(methods, options.metrics)
    envs = "+".join(dict.fromkeys(variant.env for variant in runs.variants))
    kind = "sweep" if options.sweep else "compare"
    tags = {variant.tag for variant in runs.variants}
    tag = f"@{tags.pop()}" if len(tags) == 1 and None not in tags else ""
    stem = options.name or f"{kind}_{envs}_{runs.scale.replace(' and ', '+')}{tag}"
    draw = _sweep_figures if options.sweep else _compared
    files, names = list[Path](), list[str]()
    for end, figure in draw(runs, methods, metrics, how.width, options):
        names.append(another(_file_name(f"{stem}_{end}"), names))
        files += save_figure(figure, out, names[-1], f"{envs}: {end}", how)
    return files


def _file_name(text: str) -> str:
    """A text as a file's name, without the middle of a long one."""
    name = re.sub(r"[^\w.@=+-]+", "-", text)
    half = _LONGEST // 2
    return name if len(name) <= _LONGEST else f"{name[:half]}-{name[-half:]}"


def folders_of(
    runs_dir: Path, scale: str, env: str | None, names: Sequence[str] | None
) -> list[Path]:
    """The variants' folders: of `runs_dir`/`scale`/`env`, all or those of these names
    or patterns (`BC-FQI*`); a name with a slash is itself a folder."""
    names = names or ["*"]
    patterns = [name for name in names if "/" not in name]
    place = _env_folder(runs_dir / scale, env, patterns) if patterns else runs_dir
    found: list[Path] = []
    for name in names:
        if "/" in name:
            found.append(_variant_folder(Path(name)))
        else:
            there = _folders(place)
            found += [place / each for each in there if fnmatchcase(each, name)]
    # A link to a variant keeps its name, which the method and the tag are read from.
    return list(dict.fromkeys(Path(os.path.abspath(path)) for path in found))


def _variant_folder(path: Path) -> Path:
    """The folder if it has seeds; else BcrlError."""
    if recorded_seeds(path, "json"):
        return path
    why = "has no seed_*.json" if path.is_dir() else "is not a folder"
    form = "RUNS_DIR/SCALE/ENV/VARIANT"
    raise BcrlError(f"--compare {path}: {why}; a variant's folder is {form}")


def _env_folder(place: Path, env: str | None, patterns: Sequence[str]) -> Path:
    """The folder of the environment that has variants of all these names; BcrlError if
    there is none, or if there are several and `env` does not name one."""
    envs = {each: _folders(place / each) for each in _folders(place)}
    if not envs:
        others = ", ".join(_folders(place.parent)) or "nothing"
        raise BcrlError(f"no runs in {place}; in {place.parent} there is: {others}")
    if env and env not in envs:
        raise BcrlError(f"--env {env}: no runs in {place}; {did_you_mean(env, envs)}")
    searched = {env: envs[env]} if env else envs
    for pattern in patterns:
        fitting = {
            e: v for e, v in searched.items() if any(fnmatchcase(n, pattern) for n in v)
        }
        if not fitting:
            known = sorted({name for names in searched.values() for name in names})
            near = closest(pattern, known)
            meant = f"did you mean {near}? " if near else ""
            lists = "; ".join(f"{e}: {', '.join(v)}" for e, v in searched.items())
            why = f"no such variant in {place}"
            raise BcrlError(f"--compare {pattern}: {why}. {meant}There are {lists}")
        searched = fitting
    if len(searched) > 1:
        raise BcrlError(f"--env: needed, one of {', '.join(searched)}")
    return place / next(iter(searched))


def _folders(place: Path) -> list[str]:
    """The names of the folders in a folder, without hidden ones and `figures`."""
    if not place.is_dir():
        return []
    found = (path.name for path in place.iterdir() if path.is_dir())
    return sorted(n for n in found if not n.startswith(".") and n != "figures")


def labelled(variants: Sequence[Variant]) -> Methods:
    """The variants by name, with environment, scale and place where these differ."""
    roots = [variant.folder.parents[2] for variant in variants]
    common = os.path.commonpath(roots)
    found: dict[str, Variant] = {}
    origins = [
        (variant.env, variant.folder.parts[-3], os.path.relpath(root, common))
        for variant, root in zip(variants, roots, strict=True)
    ]
    differ = [len(set(column)) > 1 for column in zip(*origins, strict=True)]
    for variant, origin in zip(variants, origins, strict=True):
        told = ", ".join(itertools.compress(origin, differ))
        found[f"{variant.name} ({told})" if told else variant.name] = variant
    return found


def _chosen_metrics(methods: Methods, names: Sequence[str] | None) -> list[str]:
    """The metrics to draw; BcrlError for unknown ones or for two kinds of counters."""
    families = {variant.family: label for label, variant in methods.items()}
    if len(families) > 1:
        both = ", ".join(f"{label} ({family})" for family, label in families.items())
        why = "they count iterations and steps; draw the families in separate figures"
        raise BcrlError(f"--compare: {both}: {why}")
    known = metrics_of(methods)
    for name in names or ():
        if name not in known:
            raise BcrlError(f"--metrics {name}: {did_you_mean(name, known)}")
    return list(names or known)


def _compared(
    runs: Runs, methods: Methods, metrics: list[str], width: float, options: Namespace
) -> Named:
    """One figure per metric with the curves of all variants that record it; a variant
    looks alike in all."""
    lines = lines_of(methods)
    for metric in metrics:
        shown = {name: v for name, v in methods.items() if metric in v.metrics}
        look = {name: lines[name] for name in shown}
        figure = figure_metrics(runs, shown, [metric], width, options.target_only, look)
        yield metric, figure


def _sweep_figures(
    runs: Runs, methods: Methods, metrics: list[str], width: float, options: Namespace
) -> Named:
    """Curves of each sweep and what they end with; for two keys the latter as maps."""
    sweeps = sweeps_of([*methods.values()], options.sweep)
    for metric in metrics:
        having = [each for each in sweeps if each.records(metric)]
        if len(options.sweep) == _KEYS:
            for each in having:
                yield f"{each.label}_{metric}", figure_map(runs, each, metric, width)
            continue
        if having:
            yield f"final_{metric}", figure_final(runs, having, metric, width)
        for each in having:
            figure = figure_sweep(runs, each, metric, width, options.target_only)
            yield f"{each.label}_{metric}", figure
