"""Values of a YAML section against the types that a component's fields name."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Optional

import pytest

from bcrl.common.checks import construct
from bcrl.errors import ConfigError


@dataclass(frozen=True)
class Part:
    rate: float | None = None
    old: Optional[int] = 3  # noqa: UP045
    kind: Literal["mean", "max", 2] = "mean"
    widths: list[int] = field(default_factory=list)
    pair: tuple[int, float] = (1, 2.0)
    many: tuple[str, ...] = ()
    sizes: Sequence[float] = ()
    nested: Mapping[str, list[int] | None] = field(default_factory=dict)
    anything: Any = None
    flag: bool = False


#: By key: values that are taken, values that are not, and how the type is spelled.
CASES = {
    "rate": ([None, 0.5, 1], ["fast", True, float("inf"), [1.0]], "float | None"),
    "old": ([None, 4], [1.5, "4", True], "must be"),
    "kind": (["mean", "max", 2], ["median", True, 2.0, None], "known: 2, max, mean"),
    "widths": ([[], [1, 2]], [[1.5], 3, None, [[1]]], "must be of type list[int]"),
    "pair": ([(1, 2)], [[1], [1, 2, 3], [1.5, 2.0], "ab"], "must be"),
    "many": ([("a",)], ["abc", [1]], "must be"),
    "sizes": ([[1, 2.5]], [["a"], {}], "must be"),
    "nested": ([{"a": [1], "b": None}], [{"a": [None]}, {"a": 1}, []], "must be"),
    "anything": ([{"x": [None]}], [], ""),
    "flag": ([True], [1, "true"], "must be true or false"),
}


@pytest.mark.parametrize("key", CASES)
def test_a_value_has_its_fields_type_or_is_rejected(key):
    good, bad, spelled = CASES[key]
    for value in good:
        typed = list(value) if isinstance(value, tuple) else value  # YAML has no tuples
        found = getattr(construct("part", Part, {key: typed}), key)
        assert found == value and type(found) is type(value)
    for value in bad:
        with pytest.raises(ConfigError) as rejected:
            construct("part", Part, {key: value})
        error = rejected.value
        assert (error.key, error.value) == (f"part.{key}", value)
        assert spelled in str(error)
