"""Turned volumes: files whose x, y and z are not the texture's.

Six signed letters name them, "+x-y+z": the file's x is the texture's x, its y runs against the texture's y. Slabs come along
the texture's z, the file wants them along its own, so the voxels are spooled first: each slab with the file's slice axis
outermost, so that a slice is read back in one piece per slab.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from solidgrain.bake.store import Encoded, Finished, Store
from solidgrain.bake.writers.base import FloatArray, Output, Volume, Writer, replay, slab_slices
from solidgrain.runtime.workers import Workers

UPRIGHT = "+x+y+z"
SPOOL_BYTES = 12  # per voxel


def oriented(volume: Volume, axes: str) -> Volume:
    """The volume as a file with such axes sees it. Against an axis, coordinates count from the far end: y' = -y."""
    order = [("xyz".index(axis), sign) for sign, axis in zip(axes[::2], axes[1::2], strict=True)]
    extents = volume.shape[::-1]

    def start(k: int, sign: str) -> float:
        return volume.origin[k] if sign == "+" else -(volume.origin[k] + extents[k] * volume.spacing[k])

    x, y, z = (extents[k] for k, _ in order)
    tile = "".join(name for name, (k, _) in zip("xyz", order, strict=True) if "xyz"[k] in volume.tile)
    origin, spacing = [start(k, sign) for k, sign in order], [volume.spacing[k] for k, _ in order]
    return replace(
        volume,
        shape=(z, y, x),
        origin=(origin[0], origin[1], origin[2]),
        spacing=(spacing[0], spacing[1], spacing[2]),
        tile=tile,
        axes=axes,
    )


def slab_bytes(volume: Volume) -> int:
    """What a turned volume is put together from at a time."""
    depth, height, width = volume.shape
    return slab_slices(depth, height * width * 12) * height * width * 12


class OrientedWriter(Writer):
    """Another writer, fed with the turned volume once all slabs are there."""

    def __init__(
        self, output: Output, volume: Volume, workers: Workers, axes: str, opener: Callable[[Output, Volume, Workers], Writer]
    ) -> None:
        super().__init__(output, volume, workers)
        self.signs = axes[::2]
        self.order = [2 - "xyz".index(axis) for axis in axes[1::2]][::-1]  # the file's z, y, x among the texture's z, y, x
        self.inner = opener(output, oriented(volume, axes), workers)

    def encode(self, z: int, slab: FloatArray) -> Encoded:
        turned = slab.transpose(self.order[0], *[axis for axis in range(3) if axis != self.order[0]], 3)
        return Encoded({"voxels": [np.ascontiguousarray(turned).data]})

    def assemble(self, store: Store) -> list[Finished]:
        return replay(self._slabs(store), self.inner, store.folder / "oriented")

    def _slabs(self, store: Store) -> Iterator[tuple[int, FloatArray]]:
        depth, height, width = self.inner.volume.shape
        thickness = slab_slices(depth, height * width * 12)
        for z in range(0, depth, thickness):
            count = min(thickness, depth - z)
            first = z if self.signs[2] == "+" else depth - z - count
            slab = self._turned(self._planes(store, first, count))
            yield z, slab

    def _planes(self, store: Store, first: int, count: int) -> FloatArray:
        """Planes first .. first + count - 1 across the file's slice axis, [plane, the other two as in the texture, 3]."""
        extents = self.volume.shape
        if self.order[0] == 0:
            content = store.read("voxels", first, count, extents[1] * extents[2] * 12)
            return np.frombuffer(content, np.float32).reshape(count, *extents[1:], 3)
        across = extents[2] if self.order[0] == 1 else extents[1]
        planes = np.empty((count, extents[0], across, 3), np.float32)
        for record in store.ordered():
            plane_bytes = record.slices * across * 12
            part = store.read_span(record.streams["voxels"], first * plane_bytes, count * plane_bytes)
            planes[:, record.z : record.z + record.slices] = np.frombuffer(part, np.float32).reshape(
                count, record.slices, across, 3
            )
        return planes

    def _turned(self, planes: FloatArray) -> FloatArray:
        """The planes' axes in the file's order and direction."""
        others = [axis for axis in range(3) if axis != self.order[0]]
        if others != self.order[1:]:
            planes = planes.swapaxes(1, 2)
        directions = [slice(None, None, 1 if sign == "+" else -1) for sign in self.signs[::-1]]
        return np.ascontiguousarray(planes[directions[0], directions[1], directions[2]])

    def probe(self, voxels: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> tuple[FloatArray, float] | None:
        """Voxels of the texture's grid, found in the file's."""
        columns = []
        for k, sign in enumerate(self.signs):
            axis = 2 - self.order[2 - k]
            index = voxels[:, axis]
            columns.append(index if sign == "+" else self.volume.shape[::-1][axis] - 1 - index)
        return self.inner.probe(np.stack(columns, axis=1))
