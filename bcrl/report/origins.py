"""Where results come from: what they cost, by which configuration, code and machine."""

from __future__ import annotations

import json
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any

from bcrl.common.identity import differences, flat, identity
from bcrl.report.document import duration
from bcrl.report.figures import env_title
from bcrl.report.notes import ranges
from bcrl.report.seedfiles import command
from bcrl.report.tables import Table, number
from bcrl.report.variants import Runs, Variant


def costs(runs: Runs) -> list[str | Table]:
    """CPU time and memory of each variant, and of all of an environment's."""
    header = ("variant", "seeds", "CPU s a seed", "CPU time", "peak memory, MiB")
    rows = []
    for env, family in runs.pairs:
        ours = runs.of(env, family)
        spent = [variant.total("cpu_seconds") for variant in ours]
        seeds = sum(len(variant.seeds) for variant in ours)
        head = f"**{env_title(env)}, {family}**"
        rows.append([head, str(seeds), "", f"**{duration(sum(spent))}**", ""])
        for variant, seconds in zip(ours, spent, strict=True):
            n = len(variant.seeds)
            peak = max(s.get("peak_memory_mib") or 0.0 for s in variant.sidecars)
            cells = [variant.name, str(n), number(seconds / n), duration(seconds)]
            rows.append([*cells, f"{peak:.0f}" if peak else "–"])
    text = (
        "CPU time is a seed's share of the group it trained in; memory is the largest "
        "of a process, which may have trained others before."
    )
    return [text, Table(header, rows)]


def configurations(runs: Runs) -> list[dict[str, Any]]:
    """Each variant's settings, and where they differ from its environment's first."""
    groups = []
    for env, family in runs.pairs:
        reference, *_ = ours = runs.of(env, family)
        title = f"{env_title(env)}, {family}"
        variants = [_configuration(variant, reference) for variant in ours]
        groups.append(
            {"title": title, "reference": reference.name, "variants": variants}
        )
    return groups


def _configuration(variant: Variant, reference: Variant) -> dict[str, Any]:
    """One variant's settings as lines: key, value, the reference's if it differs."""
    config, other = (v.sidecars[0]["config"] for v in (variant, reference))
    differing = differences(config, other)
    lines = [
        (key, _text(value), _text(differing[key][1]) if key in differing else None)
        for key, value in flat(identity(config)).items()
    ]
    absent = [k for k in differing if k not in flat(identity(config))]
    lines += [(key, "absent", _text(differing[key][1])) for key in absent]
    commands = dict.fromkeys(command(sidecar) for sidecar in variant.sidecars)
    differ = f", {len(differing)} differ" if differing else ""
    return {
        "name": variant.name,
        "summary": f"{len(lines)} settings{differ}",
        "command": "\n".join(filter(None, commands)),
        "lines": lines,
    }


def _text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def provenance(runs: Runs) -> list[str | Table]:
    """Which code, libraries and machine made which seeds, and when."""
    made: dict[tuple[str, ...], list[tuple[Variant, int]]] = {}
    for variant in runs.variants:
        for seed, sidecar in zip(variant.seeds, variant.sidecars, strict=True):
            made.setdefault(_origin(sidecar), []).append((variant, seed))
    rows = []
    for origin, seeds in made.items():
        when = [_written(variant, seed) for variant, seed in seeds]
        rows.append([_who(seeds), *origin, f"{min(when)} – {max(when)} UTC"])
    header = ("seeds", "revision", "versions", "machine", "finished (files' dates)")
    return [Table(header, rows)]


def _origin(sidecar: dict[str, Any]) -> tuple[str, ...]:
    """Revision, versions and machine as text; a dash for what isn't recorded."""
    git, machine = sidecar.get("git") or {}, sidecar.get("machine") or {}
    revision = str(git.get("revision") or "–")[:10]
    changed = " with changes" if git.get("dirty") else ""
    versions = (sidecar.get("versions") or {}).items()
    where = [str(v) for k, v in machine.items() if k != "cores" and v]
    cores = [f"{machine['cores']} cores"] if machine.get("cores") else []
    device = [str(sidecar["device"])] if sidecar.get("device") else []
    return (
        f"`{revision}`{changed}",
        ", ".join(f"{name} {version}" for name, version in versions) or "–",
        " · ".join([*where, *cores, *device]) or "–",
    )


def _who(seeds: Iterable[tuple[Variant, int]]) -> str:
    """`maze BC-FQI 0–2, …`."""
    found: dict[str, list[int]] = {}
    for variant, seed in seeds:
        found.setdefault(f"{variant.env} {variant.name}", []).append(seed)
    return ", ".join(f"{name} {ranges(numbers)}" for name, numbers in found.items())


def _written(variant: Variant, seed: int) -> str:
    """When a seed's JSON was written, which is last, as far as the file knows."""
    stamp = variant.folder.joinpath(f"seed_{seed:04d}.json").stat().st_mtime
    return f"{datetime.fromtimestamp(stamp, UTC):%Y-%m-%d %H:%M}"
