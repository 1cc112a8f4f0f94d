"""The noise tables are the same everywhere, for ever, and they are standard normal."""

import hashlib
import statistics

import numpy as np
import pytest

from solidgrain.runtime import EvaluationError
from solidgrain.runtime.noise import _quantiles, noise_offsets, noise_tables


def test_the_same_seed_gives_the_same_stone_on_every_machine_and_version():
    digest = hashlib.sha256(noise_tables(7, 16).astype("<f4").tobytes()).hexdigest()
    assert digest == "2f648b44102ac9defda57dee0a660d32de50109f07ce5638fa2176c067c4fc7a"


def test_offsets_are_the_same_everywhere_and_fill_the_table():
    assert noise_offsets(7, 2).tolist() == [
        [48.932663197801055, 43.119221994280835, 61.73738781909638],
        [46.5031746285585, 60.46215288382692, 1.845735543515417],
    ]
    offsets = noise_offsets(1, 1000)
    assert 0 <= offsets.min() < 1
    assert 63 < offsets.max() < 64


def test_an_octave_does_not_depend_on_how_many_there_are():
    assert np.array_equal(noise_tables(7, 32)[:16], noise_tables(7, 16))


def test_octaves_and_seeds_are_unrelated_standard_normals():
    tables = np.concatenate([noise_tables(0, 4), noise_tables(2**64 - 1, 4)]).reshape(8, -1)
    assert np.abs(tables.mean(1)).max() < 0.01
    assert np.abs(tables.std(1) - 1).max() < 0.01
    assert np.abs(np.corrcoef(tables) - np.eye(8)).max() < 0.01


def test_the_shipped_quantiles_are_those_of_the_normal_distribution():
    exact = [statistics.NormalDist().inv_cdf((k + 0.5) / 65536) for k in range(65536)]
    np.testing.assert_allclose(_quantiles(), exact, rtol=2e-7, atol=1e-9)


@pytest.mark.parametrize("seed", [-1, 2**64])
def test_a_seed_outside_64_bits_is_refused(seed):
    with pytest.raises(EvaluationError, match="seed"):
        noise_tables(seed, 4)
