"""Random streams depend on seed, purpose and path, and on nothing else."""

import numpy as np
import pytest

from bcrl.common.seeding import PURPOSES, stream


def test_a_stream_is_reproducible():
    assert np.array_equal(
        stream(3, "data", 1).random(5), stream(3, "data", 1).random(5)
    )


def test_seed_purpose_and_path_all_matter():
    keys = [
        (s, p, *path) for s in (0, 1) for p in PURPOSES for path in ((), (0,), (0, 0))
    ]
    draws = {tuple(stream(*key).random(4)) for key in keys}
    assert len(draws) == len(keys)


def test_an_unknown_purpose_is_an_error():
    with pytest.raises(ValueError):
        stream(0, "luck")
