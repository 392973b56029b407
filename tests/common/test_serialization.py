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


@pytest.fixture
def there_and_back(tmp_path):
    """Stores content in a file of ten kilobytes at most and reads it again."""

    def store(content, given=()):
        path = tmp_path / "packed.npz"
        with open(path, "wb") as file:
            serialization.write_content(file, {"of": "a test"}, content, given)
        assert serialization.read_about(path) == {"of": "a test"}
        assert path.stat().st_size < 10_000
        return serialization.read_content(path, given)

    return store


def test_values_come_back_with_their_types(there_and_back):
    numbers = (None, True, 2**70, -0.0, float("inf"), [1.5, 1e-300, float("nan")])
    content = {"text": "ϱ", 3: numbers, "nothing": {}}
    assert repr(there_and_back(content)) == repr(content)
    numbers = there_and_back([np.float64(0.1), np.int64(7), np.bool_(True)])
    assert repr(numbers) == "[0.1, 7, True]"


def test_arrays_come_back_to_the_bit_in_the_same_order_of_memory(there_and_back):
    numbers = np.arange(6.0).reshape(2, 3)
    arrays = [numbers, np.asfortranarray(numbers), np.zeros((0, 4), np.float32)]
    arrays += [np.array([True, False]), np.array(3.5), np.arange(9, dtype="i4")[::2]]
    for array, found in zip(arrays, there_and_back(arrays), strict=True):
        assert found.dtype == array.dtype and np.array_equal(found, array)
        assert np.isfortran(found) == np.isfortran(array) and found.flags.writeable
    tensor = there_and_back([torch.arange(3.0)])[0]
    assert torch.equal(tensor, torch.arange(3.0))


def test_one_object_stays_one_and_what_is_given_is_not_stored(there_and_back):
    q = Quadratic(np.eye(3)[None], np.zeros((1, 3)), np.ones((2, 1)))
    team = SeedBatch((0,), np.zeros((1, 2)))
    past = RunState(1, None, [Sum((q, q)), q, team, ZERO])
    found = there_and_back(past, [ZERO, team]).state
    assert found[0].terms[0] is found[0].terms[1] is found[1] is not q
    assert found[2] is team and found[3] is ZERO


@pytest.mark.parametrize("kind", [ForestRegressor, SklearnForest])
def test_a_model_is_stored_as_its_problem_and_fitted_again(there_and_back, kind):
    rng, regressor = np.random.default_rng(0), kind(trees=3)
    x, y = rng.random((200, 2)).astype(np.float32), rng.random(200)
    problem = Problem(x, y, rng.integers(1, 4, 200), x[:50], 7, (1, 2, 0))
    (fit,) = regressor.fit([problem], True, 1)
    team = SeedBatch((7,), np.zeros((1, 2)))
    q = FittedQ([(Fitted.of(problem, fit), None)], regressor, team)
    again = there_and_back(q, [regressor, team])
    assert again.models[0][0].model is None
    points = rng.random((1, 30, 2))
    assert np.array_equal(q(points, 2), again(points, 2))


def test_only_storable_classes_are_stored_and_by_their_own_name(there_and_back):
    @dataclass
    class Mine:
        terms: tuple

    Mine.__name__ = Mine.__qualname__ = "Sum"
    for content in (Mine(()), {1, 2}, open, np.array([object()], object), b"bytes"):
        with pytest.raises(TypeError, match="is not storable"):
            there_and_back([content])
    serialization.storable(Mine)  # which does not replace ours
    found = there_and_back([Sum((ZERO,)), Mine((1, 2))], [ZERO])
    assert found == [Sum((ZERO,)), Mine((1, 2))]


FORGED = [
    ["object", ["os.system", {"command": "true"}]],
    ["object", ["bcrl.q.functions.Sum", {"terms": ["list", []], "more": 1}]],
    ["array", [0, "|O", [1], "C"]],
    ["array", [0, "<f8", [1000], "C"]],
    ["array", [-8, "<f8", [1], "C"]],
    ["list", [["array", [0, "<f8", [1], "C"]]] * 2],
    ["same", 5],
    ["call", "os.system"],
]


@pytest.mark.parametrize("structure", FORGED, ids=repr)
def test_a_forged_structure_is_rejected(tmp_path, structure):
    path, text = tmp_path / "forged.npz", json.dumps(structure).encode()
    content = {"about": b"{}", "structure": text, "data": bytes(8)}
    np.savez(path, **{k: np.frombuffer(v, np.uint8) for k, v in content.items()})
    with pytest.raises(BcrlError, match=r"forged.npz can't be read"):
        serialization.read_content(path, [])
