"""Masks: how far each point of space is from one texture to another, as a volume of weights with a place.

Voxel (z, y, x) of the volume is at origin + (k + 0.5) spacing along each axis, in the textures' exemplar pixels; 0 is the first
texture and 1 the second. Between voxels the weight is trilinear, beyond the outermost ones it stays what it is there. A ramp
along an axis is a mask of two voxels.

The weight of a point depends on the point and on nothing else, to the bit: it is made of elementwise float64 operations, in
an order that no chunk changes. Where all voxels around are 0, or all are 1, it is exactly that.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.arguments import DoubleArray, Vector
from solidgrain.runtime.errors import EvaluationError

LARGEST = {"uint8": 255.0, "uint16": 65535.0, "float32": 1.0}  # the value that is weight 1, by type
FINEST = 1e-6  # exemplar pixels: of its voxels
MOST = 2**17  # voxels of a mask that are worth a look for whether a region is all one texture

IntArray = npt.NDArray[np.int64]
Repeats = tuple[bool, bool, bool]  # along which axes (x, y, z), for example, the volume is read again and again


@dataclass(frozen=True, eq=False)
class Mask:
    """A volume of weights [z, y, x], uint8, uint16 or float32 in [0, 1], and its place (x, y, z) in exemplar pixels."""

    values: npt.NDArray[Any]
    origin: Vector = (0.0, 0.0, 0.0)
    spacing: Vector = (1.0, 1.0, 1.0)

    @property
    def count(self) -> tuple[int, int, int]:
        """Voxels along x, y, z."""
        depth, rows, columns = self.values.shape
        return (columns, rows, depth)

    @property
    def extent(self) -> Vector:
        """Exemplar pixels along x, y, z: what it repeats after, where it repeats."""
        x, y, z = (count * step for count, step in zip(self.count, self.spacing, strict=True))
        return (x, y, z)

    @property
    def sha256(self) -> str:
        digest = hashlib.sha256(f"{self.values.dtype} {self.values.shape} {self.origin} {self.spacing}".encode())
        for plane in self.values:
            digest.update(np.ascontiguousarray(plane).data)
        return digest.hexdigest()

    @cached_property
    def constant(self) -> Repeats:
        """Along which axes (x, y, z) the weight does not change."""
        x, y, z = (_all_equal(np.moveaxis(self.values, axis, 0)) for axis in (2, 1, 0))
        return (x, y, z)

    def weights(self, points: DoubleArray, repeats: Repeats = (False, False, False)) -> npt.NDArray[np.float32]:
        """The weights [P] at points [P, 3] (x, y, z)."""
        (x, next_x, along_x), (y, next_y, along_y), (z, next_z, along_z) = (
            self._neighbours(points[:, axis], axis, repeats[axis]) for axis in range(3)
        )
        columns, rows, _ = self.count
        flat = self.values.reshape(-1)

        def row(plane: IntArray, line: IntArray) -> DoubleArray:
            start = (plane * rows + line) * columns
            return _between(flat[start + x].astype(np.float64), flat[start + next_x], along_x)

        low = _between(row(z, y), row(z, next_y), along_y)
        high = _between(row(next_z, y), row(next_z, next_y), along_y)
        weights = _between(low, high, along_z) / LARGEST[self.values.dtype.name]
        return np.clip(weights, 0, 1).astype(np.float32)

    def _neighbours(self, coordinates: DoubleArray, axis: int, repeats: bool) -> tuple[IntArray, IntArray, DoubleArray]:
        """The voxels along an axis before and after each coordinate, and how far it is from one to the other."""
        count = self.count[axis]
        place = self._voxel(coordinates, axis)
        if repeats:
            place = place - count * np.floor(place / count)
            before = np.floor(place)
            return _whole(before) % count, (_whole(before) + 1) % count, place - before
        place = np.clip(place, 0, count - 1)
        before = np.minimum(np.floor(place), max(count - 2, 0))
        return _whole(before), np.minimum(_whole(before) + 1, count - 1), place - before

    def _voxel(self, coordinates: DoubleArray, axis: int) -> DoubleArray:
        """Coordinates along an axis, counted in voxels: k is the middle of voxel k."""
        voxel: DoubleArray = (coordinates - self.origin[axis]) / self.spacing[axis] - 0.5
        return voxel

    def constant_within(self, low: DoubleArray, high: DoubleArray, repeats: Repeats) -> int | None:
        """0 or 1 if that is the weight of every point of the box from `low` to `high` (x, y, z), None if it is not so sure."""
        ranges = [self._reached(low[axis], high[axis], axis, repeats[axis]) for axis in (2, 1, 0)]
        if np.prod([len(one) for one in ranges]) > MOST:
            return None
        inside = self.values[np.ix_(*ranges)]
        least, most = float(inside.min()), float(inside.max())
        if most == 0:
            return 0
        return 1 if least == LARGEST[self.values.dtype.name] else None

    def _reached(self, low: float, high: float, axis: int, repeats: bool) -> IntArray:
        """The voxels along an axis that weights between two coordinates are made of."""
        count = self.count[axis]
        first, last = np.floor(self._voxel(np.array([low, high]), axis)).tolist()
        if not repeats:
            return np.arange(max(0, min(first, count - 1)), max(0, min(last + 1, count - 1)) + 1, dtype=np.int64)
        first, last = first - 1, last + 2  # one more on each side: the division by `count` rounds
        return np.arange(count) if last - first >= count else np.arange(int(first), int(last) + 1) % count


def make_mask(values: npt.ArrayLike, origin: Vector = (0.0, 0.0, 0.0), spacing: Vector = (1.0, 1.0, 1.0)) -> Mask:
    """A mask of a volume [z, y, x]: floats from 0 to 1, booleans, or uint8 and uint16, of which the largest value is 1.

    A read-only array of a type that is kept is taken as it is, a memory map for one; others are copied. Raises
    EvaluationError.
    """
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise EvaluationError(f"mask: expected a volume [z, y, x] ({error})") from error
    if array.ndim != 3 or not array.size:
        raise EvaluationError(f"mask of shape {array.shape}: expected a volume [z, y, x] with at least one voxel")
    if array.dtype == bool:
        array = array.astype(np.uint8) * np.uint8(255)
    elif array.dtype.kind == "f":
        array = array.astype(np.float32, copy=False)
    if array.dtype.name not in LARGEST:
        raise EvaluationError(f"mask of {array.dtype}: expected floats from 0 to 1, booleans, uint8 or uint16")
    array = np.array(array, array.dtype.name, order="C", copy=True if array.flags.writeable else None)
    if array.dtype.kind == "f":
        extremes = np.array([(plane.min(), plane.max()) for plane in array])  # NaN stays NaN in these, not in Python's own
        least, most = extremes.min(), extremes.max()
        if not (least >= 0 and most <= 1):
            raise EvaluationError(f"mask has values from {least:g} to {most:g}, expected 0 to 1 (0: the first texture)")
    array.flags.writeable = False
    origin, spacing = _floats(origin), _floats(spacing)  # whose texts go into its hash
    if not np.isfinite([*origin, *spacing]).all() or min(spacing) < FINEST:
        raise EvaluationError(
            f"mask at {origin} with voxels of {spacing}: expected a place and sizes of {FINEST:g} or more, in exemplar pixels"
        )
    return Mask(array, origin, spacing)


def make_ramp(axis: str, start: float, stop: float) -> Mask:
    """From the first texture at `start` along an axis (x, y or z) to the second at `stop`: a mask of two voxels.

    Raises EvaluationError.
    """
    if axis not in ("x", "y", "z"):
        raise EvaluationError(f"axis {axis!r}: expected x, y or z")
    k, length = "xyz".index(axis), abs(stop - start)
    if not 0 < length < np.inf:
        raise EvaluationError(f"from {start} to {stop}: expected two different places, in exemplar pixels")
    shape, origin, spacing = [1, 1, 1], [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]
    shape[2 - k], spacing[k], origin[k] = 2, length, min(start, stop) - 0.5 * length
    values = np.array([0, 1] if start < stop else [1, 0], np.float32).reshape(shape)
    return make_mask(values, (origin[0], origin[1], origin[2]), (spacing[0], spacing[1], spacing[2]))


def _floats(numbers: Vector) -> Vector:
    x, y, z = map(float, numbers)
    return (x, y, z)


def _whole(voxels: DoubleArray) -> IntArray:
    return voxels.astype(np.int64)


def _between(low: DoubleArray, high: npt.NDArray[Any], along: DoubleArray) -> DoubleArray:
    value: DoubleArray = low + (high - low) * along
    return value


def _all_equal(planes: npt.NDArray[Any]) -> bool:
    return all(np.array_equal(plane, planes[0]) for plane in planes[1:])
