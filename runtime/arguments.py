"""What callers say of a grid: whole numbers, vectors, placements.

Each is checked, and an EvaluationError says what was expected.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.errors import EvaluationError

DoubleArray = npt.NDArray[np.float64]
Vector = tuple[float, float, float]
Numbers = Sequence[float] | npt.NDArray[np.number[Any]]
Whole = Sequence[int] | npt.NDArray[np.integer[Any]]

FINEST = 1e-9  # exemplar pixels: of a spacing or a transform
FARTHEST = 2.0**36  # exemplar pixels: float64 coordinates still tell the places within a texel apart there
LARGEST = 2**40  # voxels along an axis, threads, slices: what no machine has


def parse_extents(name: str, values: Whole) -> tuple[int, ...]:
    return parse_whole(name, values, count=3, least=1)


def parse_whole(name: str, values: Whole, count: int, least: int) -> tuple[int, ...]:
    try:
        numbers = tuple(operator.index(value) for value in values)
    except TypeError:
        numbers = ()
    if len(numbers) != count or min(numbers) < least or max(numbers) > LARGEST:
        plural = "s" * (count > 1)
        found = values[0] if count == 1 else values
        raise EvaluationError(f"{name} {found}: expected {count} whole number{plural} from {least} to {LARGEST}")
    return numbers


def parse_vector(name: str, values: Numbers) -> Vector:
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise EvaluationError(f"{name} {values}: expected three finite numbers (x, y, z)")
    return (numbers[0], numbers[1], numbers[2])


def parse_affine(transform: npt.ArrayLike | None) -> DoubleArray:
    """A placement [4, 4] in float64, the identity for None."""
    try:
        matrix = np.eye(4) if transform is None else np.array(transform, np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.array_equal(matrix[3], (0, 0, 0, 1)):
        raise EvaluationError("transform: expected 4x4 finite numbers with the last row 0, 0, 0, 1")
    scales = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if scales[2] <= max(FINEST, 1e-9 * scales[0]) or scales[0] > FARTHEST:
        raise EvaluationError("transform: its 3x3 part has no inverse or extreme scales, expected one that keeps space solid")
    return matrix


def parse_spacing(spacing: float | Numbers) -> Vector:
    try:
        alone = np.ndim(spacing) == 0
    except ValueError:  # neither a number nor three
        alone = False
    step = parse_vector("spacing", (spacing,) * 3 if alone else spacing)  # type: ignore[arg-type]
    if min(step) < FINEST or max(step) > FARTHEST:
        raise EvaluationError(f"spacing {step}: expected {FINEST:g} to {FARTHEST:g} exemplar pixels per voxel")
    return step
