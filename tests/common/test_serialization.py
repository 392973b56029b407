"""What goes into a checkpoint comes out as it was; nothing else comes out of a file."""

import json
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from bcrl.common import serialization
from bcrl.errors import BcrlError
from bcrl.learning.stage import RunState, SeedBatch
from bcrl.q.functions import ZERO, Sum
from bcrl.q.quadratic import Quadratic
from bcrl.q.regressors.base import Fitted, FittedQ, Problem
from bcrl.q.regressors.ours import ForestRegressor
from bcrl.q.regressors.scikit import SklearnForest


def there_and_back(tmp_path, content, given=()):
    path = tmp_path / "packed.npz"
    with open(path, "wb") as file:
        serialization.write(file, {"of": "a test"}, content, given)
    assert serialization.read_about(path) == {"of": "a test"}
    return serialization.read_content(path, given)


def test_values_come_back_with_their_types(tmp_path):
    content = {
        "text": "ϱ",
        3: (None, True, 2**70, -0.0, float("inf"), [1.5, 1e-300]),
        "nothing": {},
    }
    assert repr(there_and_back(tmp_path, content)) == repr(content)
    assert np.isnan(there_and_back(tmp_path, [float("nan")])[0])
    numbers = there_and_back(tmp_path, [np.float64(0.1), np.int64(7), np.bool_(True)])
    assert repr(numbers) == "[0.1, 7, True]"


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.arange(12, dtype=np.int32)[::2],
        np.zeros((0, 4), np.float32),
        np.array([True, False]),
        np.array(3.5),
    ],
)
def test_arrays_come_back_to_the_bit_in_the_same_order_of_memory(tmp_path, array):
    (found,) = there_and_back(tmp_path, [array])
    assert found.dtype == array.dtype and np.array_equal(found, array)
    if array.flags.c_contiguous or array.flags.f_contiguous:
        assert found.flags.c_contiguous == array.flags.c_contiguous
    assert found.flags.writeable


def test_one_object_stays_one_and_what_is_given_is_not_stored(tmp_path):
    q = Quadratic(np.eye(3)[None], np.zeros((1, 3)), np.ones((2, 1)))
    team = SeedBatch((0,), np.zeros((1, 2)))
    both = Sum((q, q))
    past = RunState(1, None, [both, q, team, ZERO])
    found = there_and_back(tmp_path, past, [ZERO, team]).state
    assert found[0].terms[0] is found[0].terms[1] is found[1] is not q
    assert found[2] is team and found[3] is ZERO
    tensor = there_and_back(tmp_path, [torch.arange(3.0)])[0]
    assert torch.equal(tensor, torch.arange(3.0))


@pytest.mark.parametrize("kind", [ForestRegressor, SklearnForest])
def test_a_model_is_stored_as_its_problem_and_fitted_again(tmp_path, kind):
    rng, regressor = np.random.default_rng(0), kind(trees=3)
    x, y = rng.random((200, 2)).astype(np.float32), rng.random(200)
    problem = Problem(x, y, rng.integers(1, 4, 200), x[:50], 7, (1, 2, 0))
    (fit,) = regressor.fit([problem], True, 1)
    team = SeedBatch((7,), np.zeros((1, 2)))
    q = FittedQ([(Fitted.of(problem, fit), None)], regressor, team)
    again = there_and_back(tmp_path, q, [regressor, team])
    assert (
        again.models[0][0].model is None
        and len(again.models[0][0].problem.queries) == 0
    )
    asked = rng.random((1, 30, 2))
    assert np.array_equal(q(asked, 2), again(asked, 2))
    assert (tmp_path / "packed.npz").stat().st_size < 10_000


def test_a_class_of_the_users_does_not_replace_ours_of_the_same_name(tmp_path):
    ours = Sum((ZERO,))

    @serialization.storable
    @dataclass
    class Mine:
        terms: tuple

    Mine.__name__ = "Sum"
    found = there_and_back(tmp_path, [ours, Mine((1, 2))], [ZERO])
    assert type(found[0]) is Sum and found[0] == ours
    assert type(found[1]) is Mine and found[1].terms == (1, 2)


def test_what_is_not_storable_is_refused(tmp_path):
    @dataclass
    class Sum:  # of the same name as ours
        terms: tuple

    for content in (Sum(()), {1, 2}, open, np.array([object()], object), b"bytes"):
        with pytest.raises(TypeError, match="is not storable"):
            there_and_back(tmp_path, [content])


def forged(path, structure, data=b""):
    about = np.frombuffer(b"{}", np.uint8)
    text = np.frombuffer(json.dumps(structure).encode(), np.uint8)
    np.savez(path, about=about, structure=text, data=np.frombuffer(data, np.uint8))


@pytest.mark.parametrize(
    "structure",
    [
        ["object", ["os.system", {"command": "true"}]],
        ["object", ["bcrl.q.functions.Sum", {"terms": ["list", []], "more": 1}]],
        ["object", ["bcrl.q.functions.Sum", []]],
        ["array", [0, "|O", [1], "C"]],
        ["array", [0, "<f8", [1000], "C"]],
        ["array", [-8, "<f8", [1], "C"]],
        ["array", [0, "nonsense", [1], "C"]],
        ["same", 5],
        ["given", 3],
        ["call", "os.system"],
        {"py/object": "os.system"},
        [],
    ],
)
def test_a_forged_structure_is_refused(tmp_path, structure):
    path = tmp_path / "forged.npz"
    forged(path, structure, bytes(8))
    with pytest.raises(BcrlError, match=r"forged.npz can't be read"):
        serialization.read_content(path, [])
