"""Searches: variants of one method beside each other, with what they differ in."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bcrl.common.identity import OUTPUT_KEYS, flat
from bcrl.report.late import WINDOW, late
from bcrl.report.statistics import bootstrap
from bcrl.report.tables import ABSENT, Section, TextTable, mean_cell, seeds_cell
from bcrl.report.variants import Runs, Variant
from bcrl.results.layout import spelled

#: The return that ranks variants, by family.
_DECISIVE = {"FQI": "last return", "DQN": "late return"}
_IGNORED = (*OUTPUT_KEYS, "scale")  # top-level keys of a config that all may differ in

SWEEPS_PREAMBLE = f"""\
Variants of one method that differ in their configuration, compared over the seeds
named in their rows. *Late*: a seed's mean over the evaluations of its last {WINDOW}
environment steps; *last*: the last evaluation or iteration. Brackets are 95 %
percentile bootstrap intervals over seeds; the best mean of a group is **bold**: late
for the DQN family, last for FQI. Chance flatters the best of many: test it on other
seeds.
"""


@dataclass(frozen=True)
class Group:
    """One method's variants in one environment and the settings they differ in.

    `keys` are dotted; `settings` maps a variant's name to its values of them, as text.
    """

    env: str
    method: str
    variants: tuple[Variant, ...]
    keys: tuple[str, ...]
    settings: dict[str, tuple[str, ...]]

    @property
    def best(self) -> Variant | None:
        """The variant with the largest mean return, None if all are non-finite."""
        ranked = {}
        for variant in self.variants:
            values = measured(variant)[_DECISIVE[variant.family]]
            if values is not None and np.isfinite(values.mean()):
                ranked[variant.name] = values.mean()
        best = max(ranked, key=lambda name: ranked[name], default=None)
        return next((v for v in self.variants if v.name == best), None)


def measured(variant: Variant) -> dict[str, NDArray[np.float64] | None]:
    """Late and last return and success rate, (S,) each; None for what FQI lacks."""
    metrics, dqn = variant.metrics, variant.family == "DQN"
    success = variant.last("solved") if "solved" in metrics else None
    return {
        "late return": late(variant, "return") if dqn else None,
        "last return": variant.last("return") if "return" in metrics else None,
        "success rate": late(variant, "success_rate") if dqn else success,
    }


def groups(runs: Runs) -> list[Group]:
    """Methods with more than one variant, in the order of environment and method."""
    together: dict[tuple[str, str], list[Variant]] = {}
    for variant in runs.variants:
        together.setdefault((variant.env, variant.method), []).append(variant)
    found = []
    for (env, method), variants in together.items():
        texts = {v.name: _texts(v) for v in variants}
        known = dict.fromkeys(key for each in texts.values() for key in each)
        differ = [k for k in known if len({t.get(k) for t in texts.values()}) > 1]
        settings = {
            n: tuple(t.get(k, ABSENT) for k in differ) for n, t in texts.items()
        }
        if len(variants) > 1:
            found.append(Group(env, method, tuple(variants), tuple(differ), settings))
    return found


def _texts(variant: Variant) -> dict[str, str]:
    """Dotted keys of a variant's config → values as JSON, strings without quotes."""
    config = variant.sidecars[0].get("config") or {}
    kept = flat({k: v for k, v in config.items() if k not in _IGNORED})
    return {k: json.dumps(v, ensure_ascii=False).strip('"') for k, v in kept.items()}


def sweep_sections(found: list[Group]) -> Iterator[Section]:
    """Per group: how many variants, which is best, and a table of all."""
    for group in found:
        used = {spelled(variant.seeds) for variant in group.variants}
        same = f"Seeds {used.pop()}." if len(used) == 1 else "Seeds differ by row."
        text = f"{len(group.variants)} variants. {same}"
        if (best := group.best) is not None:
            pairs = zip(group.keys, group.settings[best.name], strict=True)
            chosen = ", ".join(f"{key} = {value}" for key, value in pairs)
            text += f" Best: {best.name}{f' ({chosen})' if chosen else ''}."
        rows = [_row(group, variant) for variant in group.variants]
        header = [
            "variant",
            *group.keys,
            "seeds · number",
            *measured(group.variants[0]),
        ]
        table = TextTable(header, rows)
        yield Section(f"{group.env}: {group.method}", [f"{text}\n", table])


def _row(group: Group, variant: Variant) -> list[str]:
    seeds = f"{spelled(variant.seeds)} · {seeds_cell(variant)}"
    cells = {name: mean_cell(values) for name, values in measured(variant).items()}
    if variant is group.best:
        cells[_DECISIVE[variant.family]] = f"**{cells[_DECISIVE[variant.family]]}**"
    return [variant.name, *group.settings[variant.name], seeds, *cells.values()]


def sweep_report(runs: Runs, found: list[Group]) -> str:
    """The Markdown document of all groups, and the notes on their runs."""
    parts = [f"# Variants compared, scale {runs.scale}\n", SWEEPS_PREAMBLE]
    parts += map(str, sweep_sections(found))
    ours = {(group.env, group.method) for group in found}
    odd = [n.text for n in runs.notes if (n.env, n.method) in ours]
    if odd:
        parts.append("## Notes on these runs\n")
        parts.append("\n".join(f"- {text}" for text in odd) + "\n")
    return "\n".join(parts)


def sweep_table(found: list[Group]) -> pd.DataFrame:
    """One row per variant: settings as JSON text, seeds, means and their intervals."""
    rows = []
    for group in found:
        for variant in group.variants:
            settings = zip(group.keys, group.settings[variant.name], strict=True)
            row: dict[str, object] = {
                "env": group.env,
                "method": group.method,
                "variant": variant.name,
                "settings": json.dumps(dict(settings), ensure_ascii=False),
                "seeds": spelled(variant.seeds),
                "complete": len(variant.seeds),
                "failed": len(variant.failed),
            }
            for label, values in measured(variant).items():
                name = label.replace(" ", "_")
                given = np.array([np.nan]) if values is None else values
                low, high = bootstrap(given)
                row |= {name: given.mean(), f"{name}_low": low, f"{name}_high": high}
            rows.append(row | {"best": variant is group.best})
    return pd.DataFrame(rows)
