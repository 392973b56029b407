"""Random streams depend on seed, purpose and path, and on nothing else."""

import numpy as np

from bcrl.common.seeding import PURPOSES, stream


def test_a_stream_depends_on_seed_purpose_and_path_alone():
    paths = ((), (0,), (0, 0))
    keys = [(seed, p, *path) for seed in (0, 1) for p in PURPOSES for path in paths]
    draws = {key: tuple(stream(*key).random(4)) for key in keys}
    assert len(set(draws.values())) == len(keys)
    assert np.array_equal(stream(*keys[3]).random(4), draws[keys[3]])
