"""Sweeps: variants of a method that differ in one or two chosen keys only."""

import itertools
import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bcrl.common.identity import as_text, flat, identity
from bcrl.errors import BcrlError, did_you_mean
from bcrl.report.variants import Methods, Variant, listed

SweptValues = tuple[Any, ...]  # a value per swept key
_LONGEST = 30  # characters of a value in a sweep's label


@dataclass(frozen=True)
class Sweep:
    """Variants of one method that differ in the swept keys only, by their values.
    `label`: the method, and other settings that tell this sweep from another."""

    label: str
    keys: tuple[str, ...]
    variants: Mapping[SweptValues, Variant]

    @property
    def methods(self) -> Methods:
        """The variants by their values as text, `32` or `32, 1e-3`."""
        return {", ".join(map(text_of, each)): v for each, v in self.variants.items()}

    def records(self, metric: str) -> bool:
        """Whether all variants record a metric."""
        return all(metric in variant.metrics for variant in self.variants.values())

    def steps(self, place: int) -> list[Any]:
        """The values of a key, in order."""
        return sorted_values({values[place] for values in self.variants})


def sweeps_of(variants: Sequence[Variant], keys: Sequence[str]) -> list[Sweep]:
    """What differs in `keys` only, per method and other settings. BcrlError if nothing
    does, with the keys in which the variants differ."""
    groups: dict[tuple[str, str], dict[SweptValues, Variant]] = {}
    for variant in variants:
        mine = flat(identity(variant.config))
        if not all(key in mine for key in keys):
            continue
        rest = {key: value for key, value in mine.items() if key not in keys}
        group = groups.setdefault(
            (variant.method, json.dumps(rest, sort_keys=True)), {}
        )
        values = tuple(_hashable(mine[key]) for key in keys)
        if values in group:
            both = f"{group[values].folder} and {variant.folder}"
            raise BcrlError(f"{both} have the same settings: name one of them only")
        group[values] = variant
    found = {k: group for k, group in groups.items() if _varies(group, len(keys))}
    if not found:
        raise BcrlError(_nothing(variants, keys))
    sweeps = [
        Sweep(name, tuple(keys), {each: group[each] for each in sorted_values(group)})
        for name, group in zip(_labels(list(found)), found.values(), strict=True)
    ]
    return sorted(sweeps, key=lambda sweep: _natural(sweep.label))


def _varies(group: Mapping[SweptValues, Variant], keys: int) -> bool:
    """Whether each key has several values."""
    return all(len({values[place] for values in group}) > 1 for place in range(keys))


def _nothing(variants: Sequence[Variant], keys: Sequence[str]) -> str:
    """Why there is no sweep of these keys."""
    settings = [(v.method, flat(identity(v.config))) for v in variants]
    known = {key for _, mine in settings for key in mine}
    values: dict[tuple[str, str], set[str]] = {}
    for method, mine in settings:
        for key in known:
            values.setdefault((key, method), set()).add(as_text(mine.get(key)))
    differing = sorted({key for (key, _), found in values.items() if len(found) > 1})
    for key in keys:
        if key not in known:
            return f"--sweep {key}: no variant has it; {did_you_mean(key, differing)}"
    also = f"; they differ in {listed(differing)}" if differing else ""
    text = f"--sweep {' '.join(keys)}: no two variants of a method differ in it alone"
    return f"{text}{also}. Sweep one or two of these keys"


def _labels(groups: Sequence[tuple[str, str]]) -> list[str]:
    """Each group's method, with the settings that differ from others of the method:
    long values cut, equal labels numbered."""
    found: list[str] = []
    for method, rest in groups:
        mine = json.loads(rest)
        others = [json.loads(text) for name, text in groups if name == method]
        keys = {key for other in others for key in other}
        differing = {
            k for k in keys if any(o.get(k) != others[0].get(k) for o in others)
        }
        names = _short(differing)
        texts = {names[k]: text_of(v) for k, v in mine.items() if k in differing}
        told = (
            f"{k}={v[:_LONGEST]}{'…' * (len(v) > _LONGEST)}" for k, v in texts.items()
        )
        found.append(another(", ".join([method, *told]), found))
    return found


def another(text: str, taken: Collection[str]) -> str:
    """The text, with a number if it is taken: `a-2`, `a-3`."""
    numbered = (f"{text}-{n}" for n in itertools.count(2))
    return next(t for t in itertools.chain([text], numbered) if t not in taken)


def _short(keys: Collection[str]) -> dict[str, str]:
    """Each key's shortest end that no other key has: `loss`, but `boosting.name`."""
    found = {}
    for key in keys:
        parts = key.split(".")
        ends = [".".join(parts[-n:]) for n in range(1, len(parts))]
        own = (e for e in ends if sum(f".{k}".endswith(f".{e}") for k in keys) == 1)
        found[key] = next(own, key)
    return found


def _natural(label: str) -> list[int | str]:
    """What orders labels so that 5 comes before 10."""
    parts = re.split(r"(\d+)", label)
    return [int(part) if part.isdecimal() else part for part in parts]


def _hashable(value: Any) -> Any:
    """A value that can be compared and looked up: lists as text."""
    return value if isinstance(value, (int, float, str)) else as_text(value)


def text_of(value: Any) -> str:
    """A value as a label, another for each: `0.001`, `1000000`, `none`."""
    return str(value).removesuffix(".0") if is_numeric([value]) else as_text(value)


def is_numeric(values: Sequence[Any]) -> bool:
    """Whether all are numbers; true and false are not."""
    return all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)


def sorted_values(values: Any) -> list[Any]:
    """By size where the values are numbers, else by their text."""

    def key(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(map(key, value))
        return (0, value, "") if is_numeric([value]) else (1, 0, str(value))

    return sorted(values, key=key)
