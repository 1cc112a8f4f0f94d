"""A slow, obvious sampler: GramGAN Eq. 1 and 5 for one point at a time, in float64 and Python integers."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from solidgrain.export.bundle import SamplerWeights


def color(weights: SamplerWeights, tables: np.ndarray, offsets: np.ndarray, point: tuple[float, float, float]) -> np.ndarray:
    """RGB at one point (x, y, z) in exemplar pixels, not clipped, without tiling."""
    octaves = zip(tables, weights.transforms, offsets, strict=True)
    eta = [noise(table, locate(transform, point, offset)) for table, transform, offset in octaves]
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


def noise(table: np.ndarray, at: list[Fraction]) -> float:
    """Trilinear lookup in a table that repeats after 64 texels."""
    cells = [math.floor(coordinate) for coordinate in at]
    fractions = [float(coordinate - cell) for coordinate, cell in zip(at, cells, strict=True)]
    value = 0.0
    for corner in np.ndindex(2, 2, 2):
        share = math.prod(f if end else 1 - f for f, end in zip(fractions, corner, strict=True))
        value += share * table[tuple((cell + end) % 64 for cell, end in zip(cells, corner, strict=True))]
    return value
