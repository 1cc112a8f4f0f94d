"""The noise tables: a pure function of (seed, octave), the same on every machine and in every version.

Philox counters through `random_raw`, the one stream whose bits NumPy guarantees, become normals by a table of 65 536
quantiles indexed by 16 bits. There is no log, sin or cos in between, whose last bit differs between processors.
"""

from __future__ import annotations

from functools import cache
from importlib import resources

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.errors import EvaluationError

RESOLUTION = 64  # texels along each axis
SEEDS = 2**64

FloatArray = npt.NDArray[np.float32]


def noise_tables(seed: int, octaves: int) -> FloatArray:
    """The tables of one instance, [octaves, 64, 64, 64] float32, standard normal, indexed (x, y, z).

    Octave i is the stream of Philox4x64-10 with the key (seed, i), 16 bits a texel, low bits of each word first. Raises
    EvaluationError unless 0 <= seed < 2^64.
    """
    if not 0 <= seed < SEEDS:
        raise EvaluationError(f"seed {seed}: expected a whole number from 0 to 2^64 - 1")
    texels = RESOLUTION**3
    tables = np.empty((octaves, texels), np.float32)
    for octave in range(octaves):
        stream = np.random.Philox(key=np.array([seed, octave], np.uint64))
        words = stream.random_raw(texels // 4).astype("<u8", copy=False)
        np.take(_quantiles(), words.view("<u2"), out=tables[octave])
    return tables.reshape(octaves, RESOLUTION, RESOLUTION, RESOLUTION)


def noise_offsets(seed: int, octaves: int) -> npt.NDArray[np.float64]:
    """Where the origin lies in each octave's table, [octaves, 3] texels in [0, 64), from the key (seed, 2^32 + i).

    Without them every octave would have a texel exactly at the origin, where noise is strongest (between texels it averages),
    and every bake would start with a blemish in its corner.
    """
    words = [np.random.Philox(key=np.array([seed, 2**32 + octave], np.uint64)).random_raw(3) for octave in range(octaves)]
    return (np.array(words) >> np.uint64(11)).astype(np.float64) * (RESOLUTION * 2.0**-53)


@cache
def _quantiles() -> FloatArray:
    """Quantile (k + 0.5) / 65 536 of the standard normal for k = 0 .. 65 535.

    The file holds the upper half, `statistics.NormalDist().inv_cdf((k + 0.5) / 65536)` rounded to float32; the lower half
    is its mirror image.
    """
    with resources.files("solidgrain.runtime").joinpath("normal_quantiles.npy").open("rb") as file:
        upper: FloatArray = np.load(file, allow_pickle=False)
    return np.concatenate([-upper[::-1], upper])
