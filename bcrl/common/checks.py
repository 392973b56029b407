"""Checks of plain values, whose errors name key, value and what is allowed."""

import dataclasses
import math
from collections.abc import Collection, Mapping
from contextlib import suppress
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from bcrl.errors import ConfigError, did_you_mean

#: The words for a type in a message.
NOUNS = {int: "an integer", float: "a number", str: "text", bool: "true or false"}


def one_of(key: str, value: object, allowed: Collection[str]) -> None:
    """Raise ConfigError unless `value` is one of `allowed`."""
    if value not in allowed:
        raise ConfigError(key, value, did_you_mean(str(value), allowed))


def construct(section: str, cls: type, values: Mapping[str, Any]) -> Any:
    """`cls(**values)` with every key known and every value of its annotated type.

    A list is taken for a tuple. Raises ConfigError naming `section.key` otherwise.
    """
    fields, taken = {f.name: f for f in dataclasses.fields(cls)}, {}
    hints: dict[str, Any] = {}
    with suppress(Exception):  # a user's file may import types for type checkers only
        hints = get_type_hints(cls)
    for key, value in values.items():
        place = f"{section}.{key}"
        if key not in fields:
            raise ConfigError(place, value, f"unknown key; {did_you_mean(key, fields)}")
        hint = hints.get(key, Any)
        try:
            taken[key] = _taken(value, hint)
        except TypeError:
            if get_origin(hint) is Literal:
                why = did_you_mean(str(value), map(str, get_args(hint)))
            else:
                name = hint.__name__ if isinstance(hint, type) else hint
                kind = f"of type {str(name).replace('typing.', '')}"
                why = f"must be {NOUNS.get(hint, kind)}"
            raise ConfigError(place, value, why) from None
    for key, field_ in fields.items():
        lacks = field_.default is field_.default_factory is dataclasses.MISSING
        if lacks and key not in values:
            raise ConfigError(f"{section}.{key}", None, "is required")
    return cls(**taken)


def _taken(value: Any, hint: Any) -> Any:
    """A plain value as a field of type `hint` takes it; TypeError if it doesn't fit."""
    kind, of = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        for each in of:
            with suppress(TypeError):
                return _taken(value, each)
    elif kind is Literal:
        if any(type(value) is type(each) and value == each for each in of):
            return value
    elif kind is float:
        if type(value) in (int, float) and math.isfinite(value):
            return value
    elif kind in (Any, object) or not isinstance(kind, type):
        return value  # nothing that could be checked
    elif type(value) is list and (kind is tuple or issubclass(list, kind)):
        one = len(of) == 1 or of[1:] == (...,)  # type for all entries
        hints = of[:1] * len(value) if one else of or [Any] * len(value)
        if len(hints) == len(value):
            made = list(map(_taken, value, hints))
            return tuple(made) if kind is tuple else made
    elif type(value) is dict and issubclass(kind, Mapping):
        of = of or (Any, Any)
        return {_taken(k, of[0]): _taken(v, of[1]) for k, v in value.items()}
    elif type(value) is kind:
        return value
    raise TypeError
