"""Where results come from: what they cost, by which configuration, code and machine."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bcrl.common.identity import differences, flat, identity
from bcrl.report.tables import ABSENT, TextTable, duration, number
from bcrl.report.variants import Runs, env_title
from bcrl.results.layout import seed_path, spelled


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
    text = (
        "CPU time is a seed's share of the group it trained in; memory is the largest "
        "of a process, which may have trained others before."
    )
    return [text, TextTable([dict(zip(header, row, strict=True)) for row in rows])]


def configurations(runs: Runs) -> list[dict[str, Any]]:
    """Each variant's settings, and where they differ from its environment's first. Its
    `lines` are key, value, and the first's value if it differs."""
    groups = []
    for env, family in runs.pairs:
        reference, *_ = ours = runs.of(env, family)
        title = f"{env_title(env)}, {family}"
        group = {"title": title, "reference": reference.name, "variants": []}
        for variant in ours:
            config, other = (v.sidecars[0]["config"] for v in (variant, reference))
            settings, differing = flat(identity(config)), differences(config, other)
            settings |= {key: mine for key, (mine, _) in differing.items()}
            lines = [
                (k, _text(v), _text(differing[k][1]) if k in differing else None)
                for k, v in settings.items()
            ]
            commands = dict.fromkeys(s.get("command") for s in variant.sidecars)
            differ = f", {len(differing)} differ" if differing else ""
            about = {"name": variant.name, "summary": f"{len(lines)} settings{differ}"}
            about |= {"command": "\n".join(filter(None, commands)), "lines": lines}
            group["variants"].append(about)
        groups.append(group)
    return groups


def _text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


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
        stamps = [path.stat().st_mtime for path in paths]
        first, last = (
            f"{datetime.fromtimestamp(stamp, UTC):%Y-%m-%d %H:%M}"
            for stamp in (min(stamps), max(stamps))
        )
        row = {"seeds": ", ".join(who), "revision": revision, "versions": versions}
        when = f"{first} – {last} UTC"
        rows.append(row | {"machine": machine, "finished (files' dates)": when})
    return [TextTable(rows)]


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
