"""Searches: variants of one method beside each other, with what they differ in."""

import json

import numpy as np
import pandas as pd

from bcrl.common.identity import OUTPUT_KEYS, flat
from bcrl.report.statistics import bootstrap
from bcrl.report.tables import ABSENT, Section, TextTable, estimate, seeds_cell
from bcrl.report.variants import Runs, Variant
from bcrl.results.layout import spelled

#: The mean that ranks variants, by family.
_DECISIVE = {"FQI": "last_return", "DQN": "late_return"}
_IGNORED = (*OUTPUT_KEYS, "scale")  # top-level keys of a config that all may differ in


def sweep_table(runs: Runs) -> pd.DataFrame:
    """One row per variant of the methods that have more than one; perhaps empty.
    Settings as JSON text, seeds, then late and last return and success rate (nan for
    what FQI lacks): their means over seeds and the ends of their intervals."""
    together: dict[tuple[str, str], list[Variant]] = {}
    for variant in runs.variants:
        together.setdefault((variant.env, variant.method), []).append(variant)
    rows, decisive = [], []
    for variants in (group for group in together.values() if len(group) > 1):
        texts = pd.DataFrame([_texts(variant) for variant in variants])
        differing = texts.loc[:, texts.nunique(dropna=False) > 1].fillna(ABSENT)
        chosen = differing.T.to_dict().values()
        for variant, settings in zip(variants, chosen, strict=True):
            row: dict[str, object] = {
                "env": variant.env,
                "method": variant.method,
                "variant": variant.name,
                "settings": json.dumps(settings, ensure_ascii=False),
                "seeds": spelled(variant.seeds),
                "complete": len(variant.seeds),
                "failed": len(variant.failed),
            }
            for name, values in _measured(variant).items():
                low, high = bootstrap(values)
                row |= {name: values.mean(), f"{name}_low": low, f"{name}_high": high}
            rows.append(row)
            decisive.append(row[_DECISIVE[variant.family]])
    table = pd.DataFrame(rows)
    if rows:
        groups = pd.Series(decisive).groupby([table["env"], table["method"]])
        table["best"] = groups.rank(ascending=False, method="first") == 1
    return table


def _texts(variant: Variant) -> dict[str, str]:
    """Dotted keys of a variant's config → values as JSON, strings without quotes."""
    config = variant.sidecars[0]["config"]
    kept = flat({k: v for k, v in config.items() if k not in _IGNORED})
    return {k: json.dumps(v, ensure_ascii=False).strip('"') for k, v in kept.items()}


def _measured(variant: Variant) -> dict[str, np.ndarray]:
    """Late and last return and success rate, (S,) each; nan for what FQI lacks."""
    dqn, nothing = variant.family == "DQN", np.array([np.nan])
    success = variant.metrics.get("solved", nothing[None])[:, -1]
    last = variant.metrics.get("return", nothing[None])[:, -1]
    return {
        "late_return": variant.late("return") if dqn else nothing,
        "last_return": last,
        "success_rate": variant.late("success_rate") if dqn else success,
    }


def sweep_sections(table: pd.DataFrame) -> list[Section]:
    """Per method: how many variants, which is best, and a table of all."""
    found = []
    groups = table.groupby(["env", "method"], sort=False) if len(table) else ()
    for (env, method), group in groups:
        same = group["seeds"].nunique() == 1
        used = f"Seeds {group['seeds'].iloc[0]}." if same else "Seeds differ by row."
        text, rows = f"{len(group)} variants. {used}", []
        for row in group.to_dict("records"):
            settings = json.loads(row["settings"])
            seeds = f"{row['seeds']} · {seeds_cell(row['complete'], row['failed'])}"
            cells = {"variant": row["variant"], **settings, "seeds · number": seeds}
            for name in ("late_return", "last_return", "success_rate"):
                interval = row[f"{name}_low"], row[f"{name}_high"]
                cells[name.replace("_", " ")] = estimate(row[name], interval)
            if row["best"]:
                fqi = np.isnan(row["late_return"])
                decisive = "last return" if fqi else "late return"
                cells[decisive] = f"**{cells[decisive]}**"
                chosen = ", ".join(f"{key} = {v}" for key, v in settings.items())
                text += f" Best: {row['variant']}{f' ({chosen})' if chosen else ''}."
            rows.append(cells)
        found.append(Section(f"{env}: {method}", [f"{text}\n", TextTable(rows)]))
    return found
