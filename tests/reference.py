"""A slow, obvious sampler: GramGAN Eq. 1 and 5 for one point at a time, in float64 and Python integers."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from solidgrain.export.bundle import SamplerWeights
from solidgrain.runtime.lattice import Tiling, untiled


def color(
    weights: SamplerWeights,
    tables: np.ndarray,
    offsets: np.ndarray,
    point: tuple[float, float, float],
    tiling: Tiling | None = None,
) -> np.ndarray:
    """RGB at one point (x, y, z) in exemplar pixels, not clipped."""
    tiling = tiling or untiled(weights.transforms)
    octaves = zip(tables, tiling.transforms, offsets, tiling.lattice, strict=True)
    eta = [noise(table, locate(transform, point, offset), basis) for table, transform, offset, basis in octaves]
    bins = np.array(eta).reshape(4, -1)
    x = None
    for layer, bias in enumerate(weights.biases[:-1]):
        y = bias.astype(float)
        if x is not None:
            y = x @ weights.weights[layer - 1] + y
        if layer < 4:
            y = y + bins[layer] @ weights.noise_weights[layer]
        x = weights.gamma[layer] * np.where(y > 0, y, 0.2 * y) + weights.delta[layer]
    assert x is not None
    return np.asarray(x @ weights.weights[-1] + weights.biases[-1])


def locate(transform: np.ndarray, point: tuple[float, float, float], offset: np.ndarray | None = None) -> list[Fraction]:
    """T p + o without any rounding."""
    start = [0.0, 0.0, 0.0] if offset is None else offset
    return [
        sum((Fraction(float(t)) * Fraction(float(p)) for t, p in zip(row, point, strict=True)), Fraction(float(first)))
        for row, first in zip(transform, start, strict=True)
    ]


def noise(table: np.ndarray, at: list[Fraction], basis: np.ndarray = 64 * np.eye(3)) -> float:  # noqa: B008
    """Trilinear lookup in a table that repeats on a lattice."""
    cells = [math.floor(coordinate) for coordinate in at]
    fractions = [float(coordinate - cell) for coordinate, cell in zip(at, cells, strict=True)]
    value = 0.0
    for corner in np.ndindex(2, 2, 2):
        share = math.prod(f if end else 1 - f for f, end in zip(fractions, corner, strict=True))
        value += share * table.flat[texel([cell + end for cell, end in zip(cells, corner, strict=True)], basis)]
    return value


def texel(cell: list[int], basis: np.ndarray) -> int:
    """The number of a cell's canonical representative, in mixed radix, modulo 64^3 (`solidgrain.runtime.lattice`)."""
    number = 0
    for axis in range(3):
        pivot = int(basis[axis, axis])
        turns = cell[axis] // pivot
        cell = [entry - turns * int(step) for entry, step in zip(cell, basis[:, axis], strict=True)]
        number = number * pivot + cell[axis]
    return number % 64**3
