"""Tables of text, the aggregate over seeds, and variants of a method compared."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import yaml

from bcrl.common.identity import as_text, flat, identity
from bcrl.common.text import ABSENT, estimate
from bcrl.report.variants import Note, Runs, Variant
from bcrl.results.layout import INDEX, spelled
from bcrl.results.outcomes import WINDOW
from bcrl.results.statistics import FEWEST_SEEDS, bootstrap, standard_error

_PATH = Path(__file__).with_name("templates") / "texts.yaml"
_TEXT = _PATH.read_text("utf-8").format(fewest=FEWEST_SEEDS, window=WINDOW)
_DATA = yaml.safe_load(_TEXT)
PARAGRAPHS: dict[str, str] = _DATA["paragraphs"]  # of the documents and the page
GLOSSARY: dict[str, str] = _DATA["glossary"]  # by term
TASKS: dict[str, str] = _DATA["tasks"]  # what differs between tasks, by environment


class TextTable(NamedTuple):
    """Rows from a column's header to its cell; as a string it is Markdown."""

    rows: Sequence[Mapping[str, str]]

    def __str__(self) -> str:
        first, *_ = rows = self.rows
        lines = [[*first], ["---"] * len(first), *(row.values() for row in rows)]
        cells = [[cell.replace("|", "\\|") for cell in line] for line in lines]
        return "".join(f"| {' | '.join(line)} |\n" for line in cells)


class Section(NamedTuple):
    """Paragraphs and tables below a title; as a string it is Markdown."""

    title: str
    parts: Sequence[str | TextTable]

    def __str__(self) -> str:
        return "\n".join([f"## {self.title}\n", *map(str, self.parts)])


def notes_section(notes: Iterable[Note]) -> list[Section]:
    """A section that lists the notes; none if there are none."""
    listed = "".join(f"- {note.text}\n" for note in notes)
    return [Section("Notes on the runs", [listed])] if listed else []


def seeds_cell(complete: int, failed: int) -> str:
    """`100`, or `97 (3 failed)` if some diverged."""
    return f"{complete} ({failed} failed)" if failed else f"{complete}"


def aggregate(runs: Runs, family: str = "FQI") -> pd.DataFrame:
    """Mean and standard error (ddof = 1) over seeds, empty where not finite: a row for
    each variant, tagged ones included, iteration or step, and metric."""
    *_, counter = INDEX[family]
    blocks = []
    for variant in (v for v in runs.variants if v.family == family):
        index = {"scale": runs.scale, "env": variant.env, "variant": variant.name}
        index |= {"stage": variant.stage, "task": variant.task, counter: variant.index}
        for metric, values in variant.metrics.items():
            block = index | {"metric": metric, "seeds": len(variant.seeds)}
            block["mean"] = values.mean(axis=0)
            block["standard_error"] = standard_error(values)
            blocks.append(pd.DataFrame(block))
    return pd.concat(blocks, ignore_index=True)


def finals(runs: Runs, family: str = "FQI") -> pd.DataFrame:
    """What each seed ends with in the target: a row per variant and seed, a column per
    metric (docs/reference/metrics.md), empty where a variant lacks it."""
    blocks = []
    for variant in (v for v in runs.variants if v.family == family):
        index = {"env": variant.env, "variant": variant.name, "seed": variant.seeds}
        own = {metric: variant.final(metric) for metric in variant.metrics}
        blocks.append(pd.DataFrame(index | own))
    return pd.concat(blocks, ignore_index=True)


def sweep_table(runs: Runs) -> pd.DataFrame:
    """One row per variant of the methods that have more than one: settings as JSON,
    seeds, late and last return and success rate (nan if FQI lacks it), intervals."""
    together: dict[tuple[str, str], list[Variant]] = {}
    for variant in runs.variants:
        together.setdefault((variant.env, variant.method), []).append(variant)
    rows = []
    for variants in (group for group in together.values() if len(group) > 1):
        configs = [flat(identity(v.config) | {"scale": {}}) for v in variants]
        texts = pd.DataFrame([{k: as_text(v) for k, v in c.items()} for c in configs])
        differing = texts.loc[:, texts.nunique(dropna=False) > 1].fillna(ABSENT)
        chosen = differing.T.to_dict().values()
        for variant, settings in zip(variants, chosen, strict=True):
            row: dict[str, object] = {"env": variant.env, "method": variant.method}
            row |= {"variant": variant.name, "settings": as_text(settings)}
            n, failed = len(variant.seeds), len(variant.failed)
            row |= {"seeds": spelled(variant.seeds), "complete": n, "failed": failed}
            for name, values in _measured(variant).items():
                low, high = bootstrap(values)
                row |= {name: values.mean(), f"{name}_low": low, f"{name}_high": high}
            rows.append(row)
    table = pd.DataFrame(rows)
    if rows:
        decisive = table["late_return"].fillna(table["last_return"])
        groups = decisive.groupby([table["env"], table["method"]])
        table["best"] = groups.rank(ascending=False, method="first") == 1
    return table


def _measured(variant: Variant) -> dict[str, np.ndarray]:
    """Late and last return and success rate, (S,) each; nan for what FQI lacks."""
    names, nothing = ("return", "solved"), np.array([[np.nan]])
    last, success = (variant.metrics.get(name, nothing)[:, -1] for name in names)
    late = nothing[:, -1]
    if variant.family == "DQN":
        late, success = variant.late("return"), variant.late("success_rate")
    return {"late_return": late, "last_return": last, "success_rate": success}


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
