"""Where results come from: what they cost, by which configuration, code and machine."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bcrl.common.identity import differences, flat, identity
from bcrl.report.tables import ABSENT, TextTable, duration, number
from bcrl.report.variants import Runs, Variant, env_title
from bcrl.results.layout import seed_path, spelled
from bcrl.results.read import command_of


def costs(runs: Runs) -> list[str | TextTable]:
    """CPU time and memory of each variant, and of all of an environment's."""
    rows = []
    for env, family in runs.pairs:
        ours = runs.of(env, family)
        seeds = str(sum(len(variant.seeds) for variant in ours))
        spent = duration(sum(variant.cpu_seconds for variant in ours))
        rows.append([f"**{env_title(env)}, {family}**", seeds, "", f"**{spent}**", ""])
        for variant in ours:
            n, seconds = len(variant.seeds), variant.cpu_seconds
            peak = max(s.get("peak_memory_mib") or 0.0 for s in variant.sidecars)
            cells = [variant.name, str(n), number(seconds / n), duration(seconds)]
            rows.append([*cells, f"{peak:.0f}" if peak else ABSENT])
    text = (
        "CPU time is a seed's share of the group it trained in; memory is the largest "
        "of a process, which may have trained others before."
    )
    header = ("variant", "seeds", "CPU s per seed", "CPU time", "peak memory, MiB")
    return [text, TextTable(header, rows)]


def configurations(runs: Runs) -> list[dict[str, Any]]:
    """Each variant's settings, and where they differ from its environment's first."""
    groups = []
    for env, family in runs.pairs:
        reference, *_ = ours = runs.of(env, family)
        variants = [_configuration(variant, reference) for variant in ours]
        group = {"title": f"{env_title(env)}, {family}", "reference": reference.name}
        groups.append(group | {"variants": variants})
    return groups


def _configuration(variant: Variant, reference: Variant) -> dict[str, Any]:
    """One variant's settings as lines: key, value, the reference's if it differs."""
    config, other = (v.sidecars[0]["config"] for v in (variant, reference))
    differing = {k: _text(b) for k, (_, b) in differences(config, other).items()}
    values = {key: _text(value) for key, value in flat(identity(config)).items()}
    values |= {key: "absent" for key in differing if key not in values}
    commands = dict.fromkeys(map(command_of, variant.sidecars))
    differ = f", {len(differing)} differ" if differing else ""
    return {
        "name": variant.name,
        "summary": f"{len(values)} settings{differ}",
        "command": "\n".join(filter(None, commands)),
        "lines": [(key, value, differing.get(key)) for key, value in values.items()],
    }


def _text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def seed_origins(runs: Runs) -> list[str | TextTable]:
    """Which code, libraries and machine made which seeds, and when."""
    made: dict[tuple[str, ...], dict[Path, list[int]]] = {}
    rows = []
    for variant in runs.variants:
        for seed, sidecar in zip(variant.seeds, variant.sidecars, strict=True):
            group = made.setdefault(_origin(sidecar), {})
            group.setdefault(variant.folder, []).append(seed)
    for origin, group in made.items():
        who = [f"{v.parent.name} {v.name} {spelled(s)}" for v, s in group.items()]
        when = [_written(folder, seed) for folder, s in group.items() for seed in s]
        rows.append([", ".join(who), *origin, f"{min(when)} – {max(when)} UTC"])
    header = ("seeds", "revision", "versions", "machine", "finished (files' dates)")
    return [TextTable(header, rows)]


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


def _written(folder: Path, seed: int) -> str:
    """When a seed's JSON was written, which is last, as far as the file knows."""
    stamp = seed_path(folder, seed, "json").stat().st_mtime
    return f"{datetime.fromtimestamp(stamp, UTC):%Y-%m-%d %H:%M}"
