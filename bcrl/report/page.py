"""The report as one HTML page that needs nothing but itself."""

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from bcrl import __version__
from bcrl.report.claims.document import claims_sections, notes_of
from bcrl.report.curve_data import curve_data
from bcrl.report.notes import incomplete
from bcrl.report.origins import configurations, costs, seed_origins
from bcrl.report.tables import TEXTS, Section, TextTable, duration
from bcrl.report.variants import Runs, env_title

Pair = tuple[str, str]  # environment and family
Picture = tuple[Path, str]  # an image file and what it shows


def page(
    runs: Runs,
    tag: str | None,
    figures: Mapping[Pair, Sequence[Picture]],
    fallback: Mapping[Pair, Sequence[Picture]],
    agents: Sequence[Picture],
    sweeps: Sequence[Section],
) -> str:
    """The page of one scale's runs. `figures` are the paper's; `fallback` is for
    browsers that can't show the interactive curves; `agents` move."""
    notes, claims = notes_of(runs, tag), claims_sections(runs, tag)
    return _TEMPLATES.get_template("page.html").render(
        version=__version__,
        runs=runs,
        tag=tag,
        notes=notes,
        incomplete=incomplete(notes),
        facts=_facts(runs, claims),
        figures=figures,
        fallback=fallback,
        claims=claims,
        agents=agents,
        sweeps=sweeps,
        costs=costs(runs),
        configs=configurations(runs),
        provenance=seed_origins(runs),
        texts=TEXTS,
        curves=[curve_data(runs, env, family, tag) for env, family in runs.pairs],
    )


def _facts(runs: Runs, claims: Mapping[Pair, Section]) -> dict[str, object]:
    """What the page's head says in numbers."""
    parts = [part for section in claims.values() for part in section.parts]
    tables = [part for part in parts if isinstance(part, TextTable)]
    found = [row.get("verdict") for table in tables for row in table.rows]
    verdicts = list(filter(None, found))
    facts = {
        "environments": len({env for env, _ in runs.pairs}),
        "variants": len(runs.variants),
        "complete seeds": sum(len(v.seeds) for v in runs.variants),
        "CPU time": duration(sum(v.cpu_seconds for v in runs.variants)),
    }
    if verdicts:
        holds, fails = verdicts.count("holds"), verdicts.count("does not hold")
        counted = f"{holds} · {fails} · {len(verdicts) - holds - fails}"
        facts["claims that hold · do not · undecided"] = counted
    return facts


def _url(image: Path) -> str:
    """The whole file as a URL."""
    data = base64.b64encode(image.read_bytes()).decode()
    return f"data:image/{image.suffix[1:]};base64,{data}"


def _prose(text: str) -> Markup:
    """Escaped text, with the emphasis and code that the Markdown documents use."""
    html = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", str(escape(text)))
    html = re.sub(r"\*(\w[^*]*?)\*", r"<em>\1</em>", html)
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", html))


def _sha256(text: str) -> str:
    """A style's or script's hash, by which a content security policy allows it."""
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


_TEMPLATES = Environment(  # escapes whatever is no `Markup`
    loader=PackageLoader("bcrl.report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_STRICT = {"separators": (",", ":"), "allow_nan": False, "ensure_ascii": False}
_TEMPLATES.policies["json.dumps_kwargs"] = _STRICT
_TEMPLATES.filters |= {"prose": _prose, "url": _url, "sha256": _sha256}
_TEMPLATES.filters["env_title"] = env_title
