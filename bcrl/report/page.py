"""The report as one HTML page that needs nothing but itself."""

from __future__ import annotations

import base64
import hashlib
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from bcrl import __version__
from bcrl.report.claims.document import GLOSSARY, PREAMBLE, claims_sections, notes_of
from bcrl.report.curve_data import curve_data
from bcrl.report.notes import incomplete
from bcrl.report.origins import configurations, costs, seed_origins
from bcrl.report.sweeps import SWEEPS_PREAMBLE, groups, sweep_sections
from bcrl.report.tables import Section, TextTable, duration
from bcrl.report.variants import Runs, env_title

_KINDS = {".png": "image/png", ".gif": "image/gif"}
Pair = tuple[str, str]  # environment and family


class Picture(NamedTuple):
    """An image file and what it shows."""

    path: Path
    caption: str

    @property
    def source(self) -> str:
        """The whole file as a URL."""
        data = base64.b64encode(self.path.read_bytes()).decode()
        return f"data:{_KINDS[self.path.suffix]};base64,{data}"


Pictures = dict[Pair, list[Picture]]


def page(
    runs: Runs,
    tag: str | None,
    figures: Pictures,
    fallback: Pictures,
    agents: Sequence[Picture],
) -> str:
    """The page of one scale's runs.

    `figures` are the paper's; `fallback` is for browsers that can't show the
    interactive curves; `agents` move.
    """
    notes = notes_of(runs, tag)
    claims = claims_sections(runs, tag)
    nothing = Section("", [])
    sections = [
        {
            "id": f"runs-{number}",
            "title": f"{env_title(pair[0])}, {pair[1]}",
            "pictures": figures.get(pair, ()),
            "fallback": fallback.get(pair, ()),
            "claims": claims.get(pair, nothing),
        }
        for number, pair in enumerate(runs.pairs)
    ]
    compared = groups(runs)
    style, script = (_read(f"page.{kind}") for kind in ("css", "js"))
    template = _environment().get_template("page.html")
    return template.render(
        version=__version__,
        title=f"Boosted curriculum RL, scale {runs.scale}"
        + (f" @{tag}" if tag else ""),
        policy=_policy(style, script),
        style=Markup(style),
        script=Markup(script),
        incomplete=incomplete(notes),
        facts=_facts(runs, claims),
        sections=sections,
        agents=agents,
        sweeps=list(sweep_sections(compared)) if compared else [],
        sweeps_preamble=SWEEPS_PREAMBLE,
        costs=costs(runs),
        configs=configurations(runs),
        provenance=seed_origins(runs),
        notes=[note.text for note in notes],
        preamble=PREAMBLE,
        glossary=GLOSSARY,
        curves=[curve_data(runs, env, family, tag) for env, family in runs.pairs],
    )


def _facts(runs: Runs, claims: Mapping[Pair, Section]) -> list[tuple[str, str]]:
    """What the page's head says in numbers."""
    parts = [part for section in claims.values() for part in section.parts]
    tables = [
        p for p in parts if isinstance(p, TextTable) and p.header[-1] == "verdict"
    ]
    kinds = Counter(_verdict(row[-1]) for table in tables for row in table.rows)
    facts = {
        "environments": len({env for env, _ in runs.pairs}),
        "variants": len(runs.variants),
        "complete seeds": sum(len(v.seeds) for v in runs.variants),
        "CPU time": duration(sum(v.cpu_seconds for v in runs.variants)),
    }
    if kinds:
        counted = " · ".join(str(kinds[kind]) for kind in ("holds", "fails", "open"))
        facts["claims that hold · do not · undecided"] = counted
    return [(name, str(value)) for name, value in facts.items()]


def _read(name: str) -> str:
    return Path(__file__).with_name("templates").joinpath(name).read_text("utf-8")


def _policy(style: str, script: str) -> str:
    """A policy by which a browser loads nothing and runs this very script only."""
    hashes = [hashlib.sha256(text.encode()).digest() for text in (style, script)]
    of_style, of_script = (f"'sha256-{base64.b64encode(h).decode()}'" for h in hashes)
    return (
        f"default-src 'none'; img-src data:; style-src {of_style}; "
        f"script-src {of_script}; base-uri 'none'; form-action 'none'"
    )


def _environment() -> Environment:
    """Jinja's, which escapes whatever is no `Markup`."""
    made = Environment(
        loader=PackageLoader("bcrl.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    strict = {"separators": (",", ":"), "allow_nan": False, "ensure_ascii": False}
    made.policies["json.dumps_kwargs"] = strict
    made.filters |= {"prose": _prose, "verdict": _verdict}
    return made


def _prose(text: str) -> Markup:
    """Escaped text, with the emphasis and code that the Markdown documents use."""
    html = str(escape(text))
    for pattern, element in (
        (r"\*\*(.+?)\*\*", "strong"),
        (r"\*(\w[^*]*?)\*", "em"),
        (r"`([^`]+)`", "code"),
    ):
        html = re.sub(pattern, rf"<{element}>\1</{element}>", html)
    return Markup(html)


def _verdict(text: str) -> str:
    """The CSS class of a verdict."""
    return {"holds": "holds", "does not hold": "fails"}.get(text, "open")
