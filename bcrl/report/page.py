"""The report as one HTML page that needs nothing but itself."""

import base64
import hashlib
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from PIL import Image

from bcrl import __version__
from bcrl.common.identity import as_text, differences, flat, identity
from bcrl.common.text import ABSENT, duration, number
from bcrl.report.claims import EXPECTED, FAILS, HOLDS, UNEXPECTED, verdict_counts
from bcrl.report.curve_data import curve_data
from bcrl.report.tables import GLOSSARY, PARAGRAPHS, TASKS, Section, TextTable
from bcrl.report.variants import Pair, Runs, Variant, env_title, incomplete
from bcrl.results.layout import seed_path, spelled
from bcrl.results.tasks import numbered_tasks

Picture = tuple[Path, str]  # an image file and what it shows
#: The page's cards of claims: title → verdict → its word after a number.
_COUNTED = {
    "claims": {HOLDS: "hold", FAILS: "do not hold", "undecided": "undecided"},
    "claims, too few seeds to judge": {
        EXPECTED: "as expected",
        UNEXPECTED: "not as expected",
    },
}


def page(
    runs: Runs,
    tag: str | None,
    figures: Mapping[Pair, Sequence[Picture]],
    agents: Sequence[Picture],
    claims: Mapping[Pair, Section],
    sweeps: Sequence[Section],
    inspections: Sequence[Picture] = (),
) -> str:
    """The page of one scale's runs. `figures` that the paper doesn't have are for
    browsers that run no scripts; `agents` move; `inspections` are of residuals."""
    notes = runs.notes_on(tag)
    given = {"version": __version__, "texts": PARAGRAPHS, "runs": runs, "tag": tag}
    given |= {"glossary": GLOSSARY, "about_tasks": TASKS}
    given |= {"figures": figures, "claims": claims, "agents": agents, "sweeps": sweeps}
    given |= {"inspections": inspections}
    given |= {"notes": notes, "incomplete": incomplete(notes)}
    return _JINJA.get_template("page.html").render(
        given,
        facts=_facts(runs, claims),
        costs=costs(runs),
        configs=configurations(runs),
        provenance=seed_origins(runs),
        tasks={pair: task_values(runs.of(*pair)) for pair in runs.pairs},
        curves=[curve_data(runs, env, family, tag) for env, family in runs.pairs],
    )


def _facts(runs: Runs, claims: Mapping[Pair, Section]) -> dict[str, object]:
    """What the page's head says in numbers."""
    parts = [part for section in claims.values() for part in section.parts]
    rows = [row for part in parts if isinstance(part, TextTable) for row in part.rows]
    counts = verdict_counts(row for row in rows if "verdict" in row)
    facts = {
        "environments": len({env for env, _ in runs.pairs}),
        "variants": len(runs.variants),
        "complete seeds": sum(len(v.seeds) for v in runs.variants),
        "CPU time": duration(sum(v.cpu_seconds for v in runs.variants)),
    }
    for title, words in _COUNTED.items():
        found = {word: counts.pop(verdict, 0) for verdict, word in words.items()}
        if any(found.values()):
            facts[title] = ", ".join(f"{n} {word}" for word, n in found.items() if n)
    if counts:
        facts["claims without data"] = counts.total()
    return facts


def task_values(variants: Iterable[Variant]) -> dict[tuple[tuple[str, str], ...], str]:
    """Each task's number and values as text → the variants that have these tasks."""
    found: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for variant in variants:
        tasks, target = numbered_tasks(variant.config)
        texts = []
        for n, task in enumerate(tasks, start=1):
            # A simulator's attributes and arguments go by their own names.
            own = flat(task.values).items()
            each = [f"{k.rpartition('.')[2]} {as_text(v)}" for k, v in own]
            env = task.constants["name"]
            each = [env] * (env != tasks[target - 1].constants["name"]) + each
            texts.append((f"T{n}{', target' * (n == target)}", ", ".join(each)))
        found.setdefault(tuple(texts), []).append(variant.name)
    given = {tasks: names for tasks, names in found.items() if any(t for _, t in tasks)}
    return {tasks: ", ".join(names) for tasks, names in given.items()}


def costs(runs: Runs) -> list[str | TextTable]:
    """CPU time and memory of each variant, and of all of an environment's."""
    header = ("variant", "seeds", "CPU s per seed", "CPU time", "peak memory, MiB")
    rows = []
    for env, family in runs.pairs:
        ours = runs.of(env, family)
        seeds = str(sum(len(variant.seeds) for variant in ours))
        spent = duration(sum(variant.cpu_seconds for variant in ours))
        rows.append((f"**{env_title(env)}, {family}**", seeds, "", f"**{spent}**", ""))
        for variant in ours:
            n, seconds = len(variant.seeds), variant.cpu_seconds
            peak = max(s.get("peak_memory_mib") or 0.0 for s in variant.sidecars)
            cells = (variant.name, str(n), number(seconds / n), duration(seconds))
            rows.append((*cells, f"{peak:.0f}" if peak else ABSENT))
    table = TextTable([dict(zip(header, row, strict=True)) for row in rows])
    return [PARAGRAPHS["costs"], table]


def configurations(runs: Runs) -> list[dict[str, Any]]:
    """Each variant's settings: key, value, and its environment's first if different."""
    groups = []
    for env, family in runs.pairs:
        reference, *_ = ours = runs.of(env, family)
        title, found = f"{env_title(env)}, {family}", []
        for variant in ours:
            differing = differences(variant.config, reference.config)
            settings = flat(identity(variant.config))
            settings |= {key: mine for key, (mine, _) in differing.items()}
            theirs = {key: as_text(value) for key, (_, value) in differing.items()}
            lines = [(k, as_text(v), theirs.get(k)) for k, v in settings.items()]
            commands = dict.fromkeys(s.get("command") for s in variant.sidecars)
            differ = f", {len(differing)} differ" if differing else ""
            about = {"name": variant.name, "summary": f"{len(lines)} settings{differ}"}
            about |= {"command": "\n".join(filter(None, commands)), "lines": lines}
            found.append(about)
        groups.append({"title": title, "reference": reference.name, "variants": found})
    return groups


def seed_origins(runs: Runs) -> list[str | TextTable]:
    """Which code, libraries and machine made which seeds, and when."""
    made: dict[tuple[str, ...], dict[Path, list[int]]] = {}
    for variant in runs.variants:
        for seed, sidecar in zip(variant.seeds, variant.sidecars, strict=True):
            group = made.setdefault(_origin(sidecar), {})
            group.setdefault(variant.folder, []).append(seed)
    rows = []
    for (revision, versions, machine), group in made.items():
        who = [f"{v.parent.name} {v.name} {spelled(s)}" for v, s in group.items()]
        # A seed's JSON is written last.
        paths = [seed_path(v, seed, "json") for v, s in group.items() for seed in s]
        dates = sorted(datetime.fromtimestamp(p.stat().st_mtime, UTC) for p in paths)
        when = f"{dates[0]:%Y-%m-%d %H:%M} – {dates[-1]:%Y-%m-%d %H:%M} UTC"
        row = {"seeds": ", ".join(who), "revision": revision, "versions": versions}
        rows.append(row | {"machine": machine, "finished (files' dates)": when})
    return [PARAGRAPHS["provenance"], TextTable(rows)]


def _origin(sidecar: dict[str, Any]) -> tuple[str, ...]:
    """Revision, versions and machine as text; a dash for what isn't recorded."""
    git, machine = sidecar.get("git") or {}, dict(sidecar.get("machine") or {})
    revision = str(git.get("revision") or ABSENT)[:10]
    changed = " with changes" if git.get("dirty") else ""
    versions = (sidecar.get("versions") or {}).items()
    cores = machine.pop("cores", None)
    where = [*machine.values(), cores and f"{cores} cores", sidecar.get("device")]
    return (
        f"`{revision}`{changed}",
        ", ".join(f"{name} {version}" for name, version in versions) or ABSENT,
        " · ".join(map(str, filter(None, where))) or ABSENT,
    )


def _url(image: Path) -> str:
    """The whole file as a URL."""
    return _data_url(image.read_bytes(), image.suffix[1:])


def _still(animation: Path) -> str:
    """The first frame as the URL of a PNG."""
    with Image.open(animation) as image, io.BytesIO() as kept:
        image.save(kept, "PNG")
        return _data_url(kept.getvalue(), "png")


def _data_url(image: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"


def _prose(text: str) -> Markup:
    """Escaped text, with the emphasis and code that the Markdown documents use."""
    html = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", str(escape(text)))
    html = re.sub(r"\*(\w[^*]*?)\*", r"<em>\1</em>", html)
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", html))


def _breakable(key: str) -> Markup:
    """Escaped text whose dotted keys can go over several lines."""
    return Markup(re.sub(r"([._])(?=\w)", r"\1<wbr>", str(escape(key))))


def _sha256(text: str) -> str:
    """A style's or script's hash, by which a content security policy allows it."""
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


_BLOCKS = {"undefined": StrictUndefined, "trim_blocks": True, "lstrip_blocks": True}
_JINJA = Environment(loader=PackageLoader("bcrl.report"), autoescape=True, **_BLOCKS)
_STRICT = {"separators": (",", ":"), "allow_nan": False, "ensure_ascii": False}
_JINJA.policies["json.dumps_kwargs"] = _STRICT
_JINJA.filters |= {"prose": _prose, "url": _url, "still": _still, "sha256": _sha256}
_JINJA.filters |= {"breakable": _breakable, "env_title": env_title}
