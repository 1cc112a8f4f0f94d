"""A slow, obvious sampler: GramGAN Eq. 1 and 5 for one point at a time, in float64 and Python integers."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from solidgrain.export.bundle import SamplerWeights, SpaceWeights
from solidgrain.runtime.blend_file import BlendData
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


def blended_color(
    weights: SamplerWeights | SpaceWeights,
    blend: BlendData,
    tables: np.ndarray,
    offsets: np.ndarray,
    point: tuple[float, float, float],
    weight: float,
    tiling: Tiling | None = None,
) -> np.ndarray:
    """RGB at one point on the way from one texture to another (`solidgrain.export.blend_graph`), not clipped."""
    eta = mixed_noise(blend.transforms if tiling is None else tiling.transforms, tables, offsets, point, weight, tiling)
    bins = eta.reshape(4, -1)
    both = (1 - weight) * blend.noise_weights[0].astype(float) + weight * blend.noise_weights[1]
    gamma, delta = (between_knots(knots, weight) for knots in (blend.gamma, blend.delta))
    x = None
    for layer, bias in enumerate(weights.biases[:-1]):
        y = bias.astype(float)
        if x is not None:
            y = x @ weights.weights[layer - 1] + y
        if layer < 4:
            y = y + bins[layer] @ both[layer]
        x = gamma[layer] * np.where(y > 0, y, 0.2 * y) + delta[layer]
    assert x is not None
    return np.asarray(x @ weights.weights[-1] + weights.biases[-1])


def between_knots(knots: np.ndarray, weight: float) -> np.ndarray:
    """Linear between the two knots around a weight."""
    last = len(knots) - 1
    below = min(int(weight * last), last - 1)
    share = weight * last - below
    return np.asarray((1 - share) * knots[below].astype(float) + share * knots[below + 1])


def mixed_noise(
    transforms: np.ndarray,
    tables: np.ndarray,
    offsets: np.ndarray,
    point: tuple[float, float, float],
    weight: float,
    tiling: Tiling | None = None,
) -> np.ndarray:
    """eta [n] of two textures' transforms [2n, 3, 3], with the variance that either has alone."""
    octaves, eta = len(transforms) // 2, []
    for i, (table, offset) in enumerate(zip(tables, offsets, strict=True)):
        places = [locate(transforms[row], point, offset) for row in (i, octaves + i)]
        bases = [64 * np.eye(3) if tiling is None else tiling.lattice[row] for row in (i, octaves + i)]
        of_a, of_b = (noise(table, place, basis) for place, basis in zip(places, bases, strict=True))
        if tiling is None:
            own, common = [1.0, 1.0], correlation([float(a - b) for a, b in zip(*places, strict=True)])
        else:
            read = [shares(place, basis) for place, basis in zip(places, bases, strict=True)]
            own, common = [shared(one, one) for one in read], shared(*read)
        plain = (1 - weight) * own[0] + weight * own[1]
        mixed = (1 - weight) ** 2 * own[0] + weight**2 * own[1] + 2 * weight * (1 - weight) * common
        eta.append(((1 - weight) * of_a + weight * of_b) / math.sqrt(mixed / plain))
    return np.array(eta)


def correlation(distance: list[float]) -> float:
    """Of two trilinear reads of white noise that repeats after 64 texels: the cubic B-spline over its value at 0."""
    found = 1.0
    for d in distance:
        a = abs((d + 32) % 64 - 32)
        b = 2 / 3 - a**2 + a**3 / 2 if a < 1 else (2 - a) ** 3 / 6 if a < 2 else 0.0
        found *= b / (2 / 3)
    return found


def shares(at: list[Fraction], basis: np.ndarray) -> dict[int, float]:
    """How much of each texel there is in a trilinear lookup."""
    cells = [math.floor(coordinate) for coordinate in at]
    fractions = [float(coordinate - cell) for coordinate, cell in zip(at, cells, strict=True)]
    found: dict[int, float] = {}
    for corner in np.ndindex(2, 2, 2):
        number = texel([cell + end for cell, end in zip(cells, corner, strict=True)], basis)
        share = math.prod(f if end else 1 - f for f, end in zip(fractions, corner, strict=True))
        found[number] = found.get(number, 0.0) + share
    return found


def shared(one: dict[int, float], other: dict[int, float]) -> float:
    """The covariance of two lookups of white noise."""
    return sum(share * other.get(number, 0.0) for number, share in one.items())
