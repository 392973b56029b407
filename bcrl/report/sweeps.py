"""Searches: variants of one method beside each other, with what they differ in."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bcrl.common.identity import OUTPUT_KEYS
from bcrl.report.curves import WINDOW, last, late
from bcrl.report.linear_claims import seeds_cell
from bcrl.report.notes import ranges
from bcrl.report.statistics import bootstrap
from bcrl.report.tables import Section, Table, estimate
from bcrl.report.variants import Runs, Variant

IGNORED = (*OUTPUT_KEYS, "scale")  # top-level keys of a config that all may differ in
ABSENT = "–"  # a variant's config lacks the key

PREAMBLE = f"""\
Variants of one method that differ in their configuration, compared over the seeds
named in their rows. *Late*: a seed's mean over the evaluations of its last {WINDOW}
environment steps; *last*: the last evaluation or iteration. Brackets are 95 %
percentile bootstrap intervals over seeds; the best mean of a group is **bold**: late
for the DQN family, last for FQI. The best of many is flattered by chance: judge it on
other seeds.
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
        means = [np.mean(deciding(variant)) for variant in self.variants]
        finite = [value if np.isfinite(value) else -np.inf for value in means]
        best = int(np.argmax(finite))
        return self.variants[best] if np.isfinite(means[best]) else None


def deciding(variant: Variant) -> NDArray[np.float64]:
    """What variants are ranked by: late return, for FQI the last, (S,)."""
    if "return" not in variant.metrics:
        return np.full(len(variant.seeds), np.nan)
    return (last if variant.family == "FQI" else late)(variant, "return")


def success(variant: Variant) -> NDArray[np.float64]:
    """Share of episodes that end at the goal: late, for FQI the last, (S,)."""
    if variant.family == "DQN":
        return late(variant, "success_rate")
    if "solved" in variant.metrics:
        return last(variant, "solved")
    return np.full(len(variant.seeds), np.nan)


def flatten(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Dotted keys and values as JSON text; lists are values."""
    for key, value in config.items():
        if not prefix and key in IGNORED:
            continue
        if isinstance(value, Mapping) and value:
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", json.dumps(value, ensure_ascii=False)


def groups(runs: Runs) -> list[Group]:
    """Methods with more than one variant, in the order of environment and method."""
    together: dict[tuple[str, str], list[Variant]] = {}
    for variant in runs.variants:
        together.setdefault((variant.env, variant.method), []).append(variant)
    found = []
    for (env, method), variants in together.items():
        if len(variants) < 2:
            continue
        configs = {
            v.name: dict(flatten(v.sidecars[0].get("config") or {})) for v in variants
        }
        known = dict.fromkeys(key for config in configs.values() for key in config)
        keys = tuple(
            key
            for key in known
            if len({config.get(key) for config in configs.values()}) > 1
        )
        settings = {
            name: tuple(config.get(key, ABSENT).strip('"') for key in keys)
            for name, config in configs.items()
        }
        found.append(Group(env, method, tuple(variants), keys, settings))
    return found


def _cell(values: NDArray[np.float64] | None) -> str:
    if values is None:
        return ABSENT
    return estimate(float(values.mean()), bootstrap(values))


def _returns(variant: Variant) -> tuple[str, str]:
    """Late and last return with intervals; FQI has no late one."""
    if "return" not in variant.metrics:
        return ABSENT, ABSENT
    late_return = None if variant.family == "FQI" else late(variant, "return")
    return _cell(late_return), _cell(last(variant, "return"))


def _seeds(variant: Variant) -> str:
    return f"{ranges(variant.seeds)} · {seeds_cell(variant)}"


def _best_table(found: list[Group]) -> Table:
    rows = []
    for group in found:
        best = group.best
        row = [group.env, group.method, str(len(group.variants))]
        if best is None:
            rows.append([*row, ABSENT, ABSENT, ABSENT, ABSENT])
            continue
        pairs = zip(group.keys, group.settings[best.name], strict=True)
        chosen = ", ".join(f"{key} = {value}" for key, value in pairs) or ABSENT
        rows.append([*row, best.name, chosen, _cell(deciding(best)), _seeds(best)])
    header = ("environment", "method", "variants", "best", "its settings", "return")
    return Table([*header, "seeds · number"], rows)


def _group_table(group: Group) -> Table:
    header = ["variant", *group.keys, "seeds · number", "late return", "last return"]
    rows = []
    for variant in group.variants:
        cells = [variant.name, *group.settings[variant.name], _seeds(variant)]
        returns = list(_returns(variant))
        if variant is group.best:
            decides = 1 if variant.family == "FQI" else 0
            returns[decides] = f"**{returns[decides]}**"
        rows.append([*cells, *returns, _cell(success(variant))])
    return Table([*header, "success rate"], rows)


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


def sweep_sections(found: list[Group]) -> Iterator[Section]:
    """The best of each group, then every group."""
    yield Section("Best", [_best_table(found)])
    for group in found:
        used = {ranges(variant.seeds) for variant in group.variants}
        same = f"Seeds {used.pop()}." if len(used) == 1 else "Seeds differ by row."
        text = f"{len(group.variants)} variants. {same}\n"
        yield Section(f"{group.env}: {group.method}", [text, _group_table(group)])


def sweep_table(found: list[Group]) -> pd.DataFrame:
    """One row a variant: settings as JSON text, seeds, returns with intervals."""
    rows = []
    for group in found:
        for variant in group.variants:
            settings = zip(group.keys, group.settings[variant.name], strict=True)
            row: dict[str, object] = {
                "env": group.env,
                "method": group.method,
                "variant": variant.name,
                "settings": json.dumps(dict(settings), ensure_ascii=False),
                "seeds": ranges(variant.seeds),
                "complete": len(variant.seeds),
                "failed": len(variant.failed),
            }
            nothing = np.full(len(variant.seeds), np.nan)
            dqn, has_return = variant.family == "DQN", "return" in variant.metrics
            measured = {
                "late_return": late(variant, "return") if dqn else nothing,
                "last_return": last(variant, "return") if has_return else nothing,
                "success_rate": success(variant),
            }
            for name, values in measured.items():
                low, high = bootstrap(values)
                row |= {name: values.mean(), f"{name}_low": low, f"{name}_high": high}
            rows.append(row | {"best": variant is group.best})
    return pd.DataFrame(rows)
