"""Values of a YAML section against the types that a component's fields name."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Optional, Union

import pytest

from bcrl.common import plugins
from bcrl.common.checks import construct
from bcrl.errors import ConfigError


@dataclass(frozen=True)
class Part:
    rate: float | None = None
    old: Optional[int] = 3  # noqa: UP045
    either: Union[int, str] = 1  # noqa: UP007
    kind: Literal["mean", "max", 2] = "mean"
    widths: list[int] = field(default_factory=list)
    pair: tuple[int, float] = (1, 2.0)
    many: tuple[str, ...] = ()
    sizes: Sequence[float] = ()
    weights: dict[str, float] = field(default_factory=dict)
    nested: Mapping[str, list[int] | None] = field(default_factory=dict)
    plain: tuple = ()
    anything: Any = None
    flag: bool = False


GOOD = {
    "rate": [None, 0.5, 1],
    "old": [None, 4],
    "either": [7, "seven"],
    "kind": ["mean", "max", 2],
    "widths": [[], [1, 2]],
    "sizes": [[1, 2.5]],
    "weights": [{}, {"a": 1, "b": 0.5}],
    "nested": [{"a": [1], "b": None}],
    "anything": [{"x": [None]}],
    "flag": [True],
}
BAD = {
    "rate": ["fast", True, float("inf"), [1.0]],
    "old": [1.5, "4", True],
    "either": [None, 1.5],
    "kind": ["median", True, 2.0, None],
    "widths": [[1.5], ["a"], 3, None, [[1]]],
    "pair": [[1], [1, 2, 3], [1.5, 2.0], "ab"],
    "many": ["abc", [1]],
    "sizes": [["a"], {}],
    "weights": [{"a": "b"}, {1: 1.0}, []],
    "nested": [{"a": [None]}, {"a": 1}],
    "plain": [3],
    "flag": [1, "true"],
}


@pytest.mark.parametrize("key", GOOD)
def test_a_value_of_the_type_is_taken_as_it_is(key):
    for value in GOOD[key]:
        found = getattr(construct("part", Part, {key: value}), key)
        assert found == value and type(found) is type(value)


def test_a_list_becomes_a_tuple_where_one_is_wanted():
    made = construct("part", Part, {"pair": [1, 2], "many": ["a"], "plain": [1, "b"]})
    assert (made.pair, made.many, made.plain) == ((1, 2), ("a",), (1, "b"))


@pytest.mark.parametrize("key", BAD)
def test_another_value_is_refused_by_key_value_and_type(key):
    for value in BAD[key]:
        with pytest.raises(ConfigError) as told:
            construct("part", Part, {key: value})
        assert (told.value.key, told.value.value) == (f"part.{key}", value)
    assert construct("part", Part, {}) == Part()


def test_types_are_spelled_as_the_user_writes_them():
    for key, spelled in {
        "rate": "must be of type float | None",
        "kind": "known: 2, max, mean",
        "widths": "must be of type list[int]",
        "flag": "must be true or false",
    }.items():
        with pytest.raises(ConfigError) as told:
            construct("part", Part, {key: object()})
        assert str(told.value).endswith(spelled)


def test_types_that_only_a_type_checker_can_find_are_not_checked():
    @dataclass(frozen=True)
    class Lazy:
        value: "Nowhere" = None  # noqa: F821

    assert construct("part", Lazy, {"value": [1]}).value == [1]
    with pytest.raises(ConfigError, match=r"part\.valeu.*value"):
        construct("part", Lazy, {"valeu": 1})


def test_only_files_that_are_there_count_as_sources(tmp_path, monkeypatch):
    (tmp_path / "fails").mkdir()
    (tmp_path / "fails" / "__init__.py").write_text("raise RuntimeError('no luck')\n")
    monkeypatch.syspath_prepend(tmp_path)
    for name, digits in (("math.x", 64), ("fails.inside", 64), ("maze", 0)):
        assert len(plugins.fingerprint({"env": {"name": name}})) == digits
