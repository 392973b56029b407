"""The report as one HTML page that needs nothing but itself."""

from __future__ import annotations

import base64
import hashlib
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from bcrl import __version__
from bcrl.report.curve_data import curve_data
from bcrl.report.document import PREAMBLE, claims_sections, duration, notes_of
from bcrl.report.figures import env_title
from bcrl.report.notes import incomplete
from bcrl.report.origins import configurations, costs, provenance
from bcrl.report.sweeps import PREAMBLE as SWEEPS
from bcrl.report.sweeps import groups, sweep_sections
from bcrl.report.tables import Section, Table
from bcrl.report.variants import Runs

KINDS = {".png": "image/png", ".gif": "image/gif"}
Pair = tuple[str, str]  # environment and family


class Picture(NamedTuple):
    """An image file and what it shows."""

    path: Path
    caption: str

    @property
    def source(self) -> str:
        """The whole file as a URL."""
        data = base64.b64encode(self.path.read_bytes()).decode()
        return f"data:{KINDS[self.path.suffix]};base64,{data}"


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
    sections = [
        {
            "id": f"runs-{number}",
            "title": f"{env_title(env)}, {family}",
            "pictures": figures.get((env, family), ()),
            "fallback": fallback.get((env, family), ()),
            "parts": claims[env, family].parts if (env, family) in claims else [],
            "parts_title": f"Claims: {claims[env, family].title}"
            if (env, family) in claims
            else "",
        }
        for number, (env, family) in enumerate(runs.pairs)
    ]
    compared = groups(runs)
    contents = [("agents", "Learned agents")] if agents else []
    contents += [("compared", "Variants compared")] if compared else []
    contents += [("costs", "Costs"), ("configs", "Configurations")]
    contents += [("provenance", "Provenance"), ("notes", "Notes")]
    style, script = _template("page.css"), _template("page.js")
    return (
        _environment()
        .get_template("page.html")
        .render(
            version=__version__,
            title=f"Boosted curriculum RL, scale {runs.scale}"
            + (f" @{tag}" if tag else ""),
            policy=_policy(style, script),
            style=Markup(style),
            script=Markup(script),
            incomplete=incomplete(notes),
            facts=_facts(runs, claims),
            sections=sections,
            contents=contents,
            agents=agents,
            sweeps=list(sweep_sections(compared)) if compared else [],
            sweeps_preamble=SWEEPS,
            costs=costs(runs),
            configs=configurations(runs),
            provenance=provenance(runs),
            notes=[note.text for note in notes],
            preamble=PREAMBLE,
            curves=[curve_data(runs, env, family, tag) for env, family in runs.pairs],
        )
    )


def _facts(runs: Runs, claims: Mapping[Pair, Section]) -> list[tuple[str, str]]:
    """What the page's head says in numbers."""
    verdicts = [
        row[-1]
        for section in claims.values()
        for part in section.parts
        if isinstance(part, Table) and part.header[-1] == "verdict"
        for row in part.rows
    ]
    facts = [
        ("environments", str(len({env for env, _ in runs.pairs}))),
        ("variants", str(len(runs.variants))),
        ("complete seeds", str(sum(len(v.seeds) for v in runs.variants))),
        ("CPU time", duration(sum(v.total("cpu_seconds") for v in runs.variants))),
    ]
    if verdicts:
        kinds = Counter(map(_verdict, verdicts))
        counted = " · ".join(str(kinds[kind]) for kind in ("holds", "fails", "open"))
        facts.append(("claims that hold · do not · undecided", counted))
    return facts


def _template(name: str) -> str:
    return Path(__file__).with_name("templates").joinpath(name).read_text("utf-8")


def _policy(style: str, script: str) -> str:
    """A policy by which a browser loads nothing and runs this very script only."""

    def hashed(text: str) -> str:
        digest = hashlib.sha256(text.encode()).digest()
        return f"'sha256-{base64.b64encode(digest).decode()}'"

    return (
        f"default-src 'none'; img-src data:; style-src {hashed(style)}; "
        f"script-src {hashed(script)}; base-uri 'none'; form-action 'none'"
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
    made.policies["json.dumps_kwargs"] = {
        "separators": (",", ":"),
        "allow_nan": False,
        "ensure_ascii": False,
    }
    made.filters |= {"prose": _prose, "verdict": _verdict}
    return made


def _prose(text: str) -> Markup:
    """Escaped text, with the emphasis and code that the Markdown documents use."""
    html: Any = escape(text)
    for pattern, element in (
        (r"\*\*(.+?)\*\*", "strong"),
        (r"\*(\w[^*]*?)\*", "em"),
        (r"`([^`]+)`", "code"),
    ):
        html = re.sub(pattern, rf"<{element}>\1</{element}>", str(html))
    return Markup(html)


def _verdict(text: str) -> str:
    """The CSS class of a verdict."""
    return {"holds": "holds", "does not hold": "fails"}.get(text, "open")
