"""Exact seamless tiling: periods that the noise itself has, without blending and without mirrored edges.

An octave repeats with the tile if its noise is the same at T c and at T (c + period). Move T a little, so that the period
lands on whole texels: V = round(T diag(period)), T' = V diag(period)^-1. Then let the table be indexed modulo the lattice
that the columns of V generate, instead of modulo 64 Z³: both ends of the tile read the same texels, neighbours included.

A lattice is given by a lower-triangular basis (the Hermite normal form of V): column k has its pivot in row k and zeros
above, so a cell is reduced by one floor division per axis, in order. The product of the pivots counts the cells of one
period; the sampler numbers them, and texel (number modulo 64³) of the table is the cell's noise.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.errors import EvaluationError
from solidgrain.runtime.noise import RESOLUTION

EXACT = 2.0**61  # products of cells and basis entries stay below it

DoubleArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Tiling:
    """The transforms that a (possibly tiled) instance really uses, and the lattices that its noise repeats on."""

    transforms: DoubleArray  # [n, 3, 3], texels per exemplar pixel
    lattice: DoubleArray  # [n, 3, 3], lower-triangular, whole numbers
    distortion: DoubleArray  # [n], |T' - T| / |T|
    period: tuple[float, float, float]  # (x, y, z) in exemplar pixels; 0 along axes that do not tile
    matrix: DoubleArray = field(default_factory=lambda: np.eye(3))  # [3, 3], from a grid's pixels to the texture's

    def check_exact(self, farthest: tuple[float, float, float]) -> None:
        """Raises EvaluationError if cells within `farthest` (x, y, z) pixels cannot be reduced in 64-bit integers."""
        reach = np.array([self.period[k] or abs(farthest[k]) for k in range(3)])
        cells = (np.abs(self.transforms) @ reach).max(1) + 2
        if any(self.period) and (cells * self.lattice.max((1, 2))).max() >= EXACT:
            raise EvaluationError(
                f"tile period {self.period} at up to {farthest} pixels: too large for an exact seam; "
                "use a shorter period, or stay nearer to the origin along the axes that do not tile"
            )

    def wrap(self, coordinates: DoubleArray, axis: int) -> DoubleArray:
        """Coordinates along one axis, brought into the first tile."""
        period = self.period[axis]
        return np.mod(coordinates, period) if period else coordinates


def untiled(transforms: DoubleArray) -> Tiling:
    """No tiling: every octave repeats after 64 texels, as its table does."""
    lattice = np.broadcast_to(RESOLUTION * np.eye(3), transforms.shape).copy()
    return Tiling(transforms, lattice, np.zeros(len(transforms)), (0.0, 0.0, 0.0))


def tiled(transforms: DoubleArray, period: tuple[float, float, float], axes: str) -> Tiling:
    """Tile the named axes (any subset of "xyz") with a period (x, y, z) in exemplar pixels.

    Raises EvaluationError for an unknown axis, or a period that is not positive or too large.
    """
    if not axes:
        return untiled(transforms)
    unknown = sorted(set(axes) - set("xyz"))
    if unknown or len(set(axes)) != len(axes):
        raise EvaluationError(f"tile {axes!r}: expected each of x, y, z at most once")
    chosen = sorted("xyz".index(axis) for axis in axes)
    if any(not period[k] > 0 for k in chosen):
        raise EvaluationError(f"tile period {period}: expected more than 0 along {axes}")
    moved, lattice = transforms.copy(), np.empty_like(transforms)
    spans = np.array([period[k] for k in chosen])
    if np.abs(transforms[:, :, chosen] * spans).max() >= EXACT:
        raise EvaluationError(f"tile period {period}: too large for an exact seam; use a shorter one")
    for octave, transform in enumerate(transforms):
        whole = _nearest_of_full_rank(transform[:, chosen] * spans)
        moved[octave][:, chosen] = whole / spans
        lattice[octave] = lattice_basis(whole)
    distortion = np.linalg.norm(moved - transforms, axis=(1, 2)) / np.linalg.norm(transforms, axis=(1, 2))
    used = tuple(period[k] if k in chosen else 0.0 for k in range(3))
    return Tiling(moved, lattice, distortion, (used[0], used[1], used[2]))


def _nearest_of_full_rank(columns: DoubleArray) -> IntArray:
    """The whole-numbered matrix nearest to `columns` [3, k] whose k columns are independent.

    Rounding gives it for all but the lowest octaves, which vary so slowly that the tile spans less than a texel of them;
    those are nudged by at most one texel per entry.
    """
    rounded = np.rint(columns).astype(np.int64)
    if _independent(rounded[None])[0]:
        return rounded
    nudges = np.array(list(itertools.product((-1, 0, 1), repeat=columns.size))).reshape(-1, *columns.shape)
    candidates = rounded + nudges
    candidates = candidates[_independent(candidates)]
    nearest: IntArray = candidates[np.argmin(((candidates - columns) ** 2).sum((1, 2)))]
    return nearest


def _independent(matrices: IntArray) -> npt.NDArray[np.bool_]:
    """Whether the columns of each matrix [B, 3, k] are linearly independent (their Gram determinant is a whole number)."""
    exact = matrices.astype(np.float64)
    gram = exact.transpose(0, 2, 1) @ exact
    independent: npt.NDArray[np.bool_] = np.linalg.det(gram) > 0.5
    return independent


def lattice_basis(columns: IntArray) -> DoubleArray:
    """A lower-triangular basis [3, 3] of the lattice that the columns [3, k] generate.

    Column-style Hermite normal form by Euclid's algorithm, in Python integers. Rows without a pivot, when k < 3, get a
    period of their own, as long as the table has texels for, and 64 at least.
    """
    left = [[int(entry) for entry in column] for column in columns.T]
    basis = [[0, 0, 0] for _ in range(3)]  # columns, in Python integers: intermediate entries outgrow 64 bits
    for row in range(3):
        while len(pivots := [column for column in left if column[row]]) > 1:
            smallest = min(pivots, key=lambda column: abs(column[row]))
            for column in pivots:
                if column is not smallest:
                    turns = column[row] // smallest[row]
                    column[:] = [a - turns * b for a, b in zip(column, smallest, strict=True)]
        if pivots:
            pivot = pivots[0]
            left = [column for column in left if column is not pivot]
            basis[row] = pivot if pivot[row] > 0 else [-entry for entry in pivot]
    free = [row for row in range(3) if basis[row][row] == 0]
    cells = math.prod(basis[row][row] for row in range(3) if row not in free)
    for row in free:
        basis[row][row] = max(RESOLUTION, int((RESOLUTION**3 / cells) ** (1 / len(free))))
    for row in (1, 2):  # entries left of a pivot become smaller than it
        for column in basis[:row]:
            turns = column[row] // basis[row][row]
            column[:] = [a - turns * b for a, b in zip(column, basis[row], strict=True)]
    return np.array(basis, np.float64).T
