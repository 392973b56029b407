"""Which part of a config decides numbers, and where two configs differ in it."""

import json
from typing import Any

Plain = dict[str, Any]  # a resolved config: dicts, lists and scalars

#: Top-level keys that change no number, but for another device's rounding.
OUTPUT_KEYS = ("seeds", "workers", "threads", "device", "runs_dir", "tag", "progress")
OUTPUT_KEYS += ("strict", "checkpoint_every", "logger", "keep", "extend")
ABSENT_KEY = "absent"  # stands for the value of a key that one of two configs lacks


def identity(config: Plain) -> Plain:
    """The part of a config that decides numbers."""
    kept = {k: v for k, v in config.items() if k not in OUTPUT_KEYS}
    kept["env"] = {k: v for k, v in kept["env"].items() if k != "paper_seeds"}
    algorithm = kept.get("algorithm", {})
    if "dataset_sha256" in algorithm:  # logged data: where they lie changes nothing
        kept["algorithm"] = {k: v for k, v in algorithm.items() if k != "dataset"}
    # A factor of 1 is none, and older runs don't name it.
    boosting = kept.get("boosting")
    if isinstance(boosting, dict) and boosting.get("alpha") == 1.0:
        kept["boosting"] = {k: v for k, v in boosting.items() if k != "alpha"}
    # A run decides what starts from it by its config, wherever its folder is.
    start = {k: v for k, v in kept.pop("start", {}).items() if v and k != "from"}
    return kept | ({"start": start} if start else {})


def differences(config: Plain, other: Plain) -> dict[str, tuple[Any, Any]]:
    """Dotted keys at which two configs' identities differ, with both values."""
    a, b = flat(identity(config)), flat(identity(other))
    both = {k: (a.get(k, ABSENT_KEY), b.get(k, ABSENT_KEY)) for k in sorted(a | b)}
    return {k: (x, y) for k, (x, y) in both.items() if x != y}


def flat(config: Plain, prefix: str = "") -> Plain:
    """Nested dicts as one, with dotted keys."""
    out: Plain = {}
    for key, value in config.items():
        inner = isinstance(value, dict)
        out |= flat(value, f"{prefix}{key}.") if inner else {f"{prefix}{key}": value}
    return out


def as_text(value: object) -> str:
    """A value as JSON, a string as it is."""
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
