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
from bcrl.report.tables import ABSENT, Section, Table, mean_cell, seeds_cell
from bcrl.report.variants import Runs, Variant
from bcrl.results.layout import spelled

IGNORED = (*OUTPUT_KEYS, "scale")  # top-level keys of a config that all may differ in

PREAMBLE = f"""\
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
        means = [np.mean(decisive(variant)) for variant in self.variants]
        best = int(np.argmax([v if np.isfinite(v) else -np.inf for v in means]))
        return self.variants[best] if np.isfinite(means[best]) else None


def measured(variant: Variant) -> dict[str, NDArray[np.float64] | None]:
    """Late and last return and success rate, (S,) each; None for what FQI lacks."""
    if variant.family == "DQN":
        late_return, success = late(variant, "return"), late(variant, "success_rate")
    else:
        late_return = None
        success = variant.last("solved") if "solved" in variant.metrics else None
    last_return = variant.last("return") if "return" in variant.metrics else None
    found = {"late return": late_return, "last return": last_return}
    return found | {"success rate": success}


def decisive(variant: Variant) -> NDArray[np.float64]:
    """The return that ranks variants: late, for FQI the last, (S,); nan without one."""
    name = "late return" if variant.family == "DQN" else "last return"
    values = measured(variant)[name]
    return np.full(len(variant.seeds), np.nan) if values is None else values


def groups(runs: Runs) -> list[Group]:
    """Methods with more than one variant, in the order of environment and method."""
    together: dict[tuple[str, str], list[Variant]] = {}
    for variant in runs.variants:
        together.setdefault((variant.env, variant.method), []).append(variant)
    found = []
    for (env, method), variants in together.items():
        if len(variants) > 1:
            configs = {v.name: _texts(v) for v in variants}
            known = dict.fromkeys(key for texts in configs.values() for key in texts)
            values = {
                k: [texts.get(k, ABSENT) for texts in configs.values()] for k in known
            }
            keys = tuple(key for key in known if len(set(values[key])) > 1)
            rows = (
                zip(*(values[key] for key in keys), strict=True)
                if keys
                else ((),) * len(variants)
            )
            settings = dict(zip(configs, rows, strict=True))
            found.append(Group(env, method, tuple(variants), keys, settings))
    return found


def _texts(variant: Variant) -> dict[str, str]:
    """Dotted keys of a variant's config → values as JSON, strings without quotes."""
    config = variant.sidecars[0].get("config") or {}
    flattened = flat({k: v for k, v in config.items() if k not in IGNORED})
    return {
        key: json.dumps(value, ensure_ascii=False).strip('"')
        for key, value in flattened.items()
    }


def sweep_sections(found: list[Group]) -> Iterator[Section]:
    """The best of each group, then every group."""
    header = ("environment", "method", "variants", "best", "its settings", "return")
    rows = [_best_row(group) for group in found]
    yield Section("Best", [Table([*header, "seeds · number"], rows)])
    for group in found:
        used = {spelled(variant.seeds) for variant in group.variants}
        same = f"Seeds {used.pop()}." if len(used) == 1 else "Seeds differ by row."
        text = f"{len(group.variants)} variants. {same}\n"
        yield Section(f"{group.env}: {group.method}", [text, _group_table(group)])


def _best_row(group: Group) -> list[str]:
    best, row = group.best, [group.env, group.method, str(len(group.variants))]
    if best is None:
        return [*row, *[ABSENT] * 4]
    pairs = zip(group.keys, group.settings[best.name], strict=True)
    chosen = ", ".join(f"{key} = {value}" for key, value in pairs) or ABSENT
    return [*row, best.name, chosen, mean_cell(decisive(best)), _seeds(best)]


def _group_table(group: Group) -> Table:
    rows = []
    for variant in group.variants:
        cells = [variant.name, *group.settings[variant.name], _seeds(variant)]
        values = [mean_cell(values) for values in measured(variant).values()]
        if variant is group.best:
            place = 0 if variant.family == "DQN" else 1
            values[place] = f"**{values[place]}**"
        rows.append([*cells, *values])
    header = ["variant", *group.keys, "seeds · number", "late return", "last return"]
    return Table([*header, "success rate"], rows)


def _seeds(variant: Variant) -> str:
    return f"{spelled(variant.seeds)} · {seeds_cell(variant)}"


def sweep_report(runs: Runs, found: list[Group]) -> str:
    """The Markdown document: the best of each group, then every group."""
    parts = [f"# Variants compared, scale {runs.scale}\n", PREAMBLE]
    parts += map(str, sweep_sections(found))
    ours = {(group.env, group.method) for group in found}
    odd = [n.text for n in runs.notes if (n.env, n.method) in ours]
    if odd:
        parts.append("## Notes on these runs\n")
        parts.append("\n".join(f"- {text}" for text in odd) + "\n")
    return "\n".join(parts)


def sweep_table(found: list[Group]) -> pd.DataFrame:
    """One row per variant: settings as JSON text, seeds, returns with intervals."""
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
            for name, values in measured(variant).items():
                column, known = name.replace(" ", "_"), values is not None
                mean, (low, high) = np.nan, bootstrap(values if known else [])
                row |= {column: values.mean() if known else mean}
                row |= {f"{column}_low": low, f"{column}_high": high}
            rows.append(row | {"best": variant is group.best})
    return pd.DataFrame(rows)
