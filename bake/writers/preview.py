"""The preview: a PNG with the three middle slices and the block itself, turned, as one looks at it from above.

Left to right: z, y and x middle slice (the second and third with z upwards), then the block with its faces x = last, y = 0 and
z = last. Axes that tile are shown twice, so that a seam would be seen. Only those six planes are kept while the volume streams
by, thinned to 512 samples an axis.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from solidgrain.bake.color import SRGB, quantize
from solidgrain.bake.store import Encoded, Finished, Store
from solidgrain.bake.writers.base import FloatArray, Output, Volume, Writer
from solidgrain.runtime.errors import BakeError
from solidgrain.runtime.files import sync
from solidgrain.runtime.workers import Workers

PANEL = 384  # pixels along each side of a panel
GAP = 12
FINEST = 512  # samples of a plane along an axis
SAMPLES = 3  # of the block per pixel, along each axis
VIEW = np.array([1.0, -1.35, 0.95])  # from the block towards the eye
SHADE = {0: 0.86, 1: 0.68, 2: 1.0}  # brightness of the faces across x, y and z
BACKGROUND = 0.12


@dataclass(frozen=True)
class Plane:
    """One plane of the volume: the voxel index it lies at, along one axis (0 x, 1 y, 2 z)."""

    axis: int
    index: int

    def across(self, extents: Sequence[float]) -> tuple[float, float]:
        """Of the extents along x, y and z, those of the plane's rows and columns."""
        columns, rows = (extent for axis, extent in enumerate(extents) if axis != self.axis)
        return rows, columns


class PreviewFile(Writer):
    """Keeps six planes of the volume, a stream for each, and draws when the last slab has come."""

    def __init__(self, output: Output, volume: Volume, workers: Workers) -> None:
        super().__init__(output, volume, workers)
        extents = volume.shape[::-1]
        self.steps = [-(-extent // FINEST) for extent in extents]
        self.middles = [Plane(axis, extents[axis] // 2) for axis in (2, 1, 0)]
        self.faces = [Plane(0, extents[0] - 1), Plane(1, 0), Plane(2, extents[2] - 1)]

    def encode(self, z: int, slab: FloatArray) -> Encoded:
        planes = {*self.middles, *self.faces}
        return Encoded(
            {f"axis{plane.axis}-{plane.index}": [np.ascontiguousarray(self._cut(plane, z, slab)).data] for plane in planes}
        )

    def _cut(self, plane: Plane, z: int, slab: FloatArray) -> FloatArray:
        """The rows of a plane that lie in a slab: [z, x] or [z, y], or, across z, all of it or nothing."""
        thin_x, thin_y, thin_z = self.steps
        if plane.axis == 2:
            return slab[plane.index - z, ::thin_y, ::thin_x] if z <= plane.index < z + len(slab) else slab[:0, :0]
        thinned = slab[[k for k in range(len(slab)) if (z + k) % thin_z == 0]]
        return thinned[:, plane.index, ::thin_x] if plane.axis == 1 else thinned[:, ::thin_y, plane.index]

    def assemble(self, store: Store) -> list[Finished]:
        planes = {plane: self._repeated(plane, self._plane(plane, store)) for plane in [*self.middles, *self.faces]}
        extents = self._extents()
        upright = {plane: planes[plane] if plane.axis == 2 else planes[plane][::-1] for plane in self.middles}
        slices = [fit(picture, plane.across(extents)) for plane, picture in upright.items()]
        block = draw_block([planes[plane] for plane in self.faces], extents)
        gap = np.full((PANEL, GAP, 3), BACKGROUND, np.float32)
        panels = [part for picture in [*slices, block] for part in (picture, gap)][:-1]
        staged = store.folder / "preview.png"
        self._write(staged, quantize(np.concatenate(panels, axis=1), np.uint8))
        return [Finished(staged, self.output.path)]

    def _plane(self, plane: Plane, store: Store) -> FloatArray:
        columns, rows, levels = (-(-extent // step) for extent, step in zip(self.volume.shape[::-1], self.steps, strict=True))
        shape = [(levels, rows), (levels, columns), (rows, columns)][plane.axis]
        path = store.joined(f"axis{plane.axis}-{plane.index}")
        return np.fromfile(path, np.float32).reshape(*shape, 3)

    def _repeated(self, plane: Plane, picture: FloatArray) -> FloatArray:
        """A plane twice along each axis that tiles: a seam would show in the middle."""
        rows, columns = ("zyx"[axis] for axis in range(3) if axis != 2 - plane.axis)
        return np.tile(picture, (1 + (rows in self.volume.tile), 1 + (columns in self.volume.tile), 1))

    def _extents(self) -> list[float]:
        """Exemplar pixels along x, y and z, repeats included."""
        volume = self.volume
        lengths = [count * step for count, step in zip(volume.shape[::-1], volume.spacing, strict=True)]
        return [length * (1 + (axis in volume.tile)) for axis, length in zip("xyz", lengths, strict=True)]

    def _write(self, path: Path, picture: npt.NDArray[np.generic]) -> None:
        """OpenImageIO reports success on a full disk: only reading the file back tells."""
        import OpenImageIO as oiio

        image = oiio.ImageBuf(np.ascontiguousarray(picture))
        image.specmod().attribute("oiio:ColorSpace", SRGB)
        image.specmod().attribute("Software", "solidgrain")
        image.specmod().attribute("DateTime", "")  # no time stamp: equal volumes are equal bytes
        written = image.write(os.fspath(path))
        reader = oiio.ImageInput.open(os.fspath(path)) if written else None
        again = reader.read_image(oiio.UINT8) if reader else None
        if again is None or not np.array_equal(again, picture):
            raise BakeError(f"{self.output.path}: cannot write the preview; free space or bake elsewhere")
        sync(path)


def fit(plane: FloatArray, extents: tuple[float, float]) -> FloatArray:
    """A plane scaled into a panel, nearest sample, centred; its proportions are `extents` (rows, columns),
    of which either axis may have been thinned."""
    scale = PANEL / max(extents)
    rows, columns = (
        np.minimum((np.arange(max(1, round(extent * scale))) / scale * (samples / extent)).astype(int), samples - 1)
        for extent, samples in zip(extents, plane.shape, strict=False)
    )
    scaled = plane[rows][:, columns]
    panel = np.full((PANEL, PANEL, 3), BACKGROUND, np.float32)
    top, left = (PANEL - len(rows)) // 2, (PANEL - len(columns)) // 2
    panel[top : top + len(rows), left : left + len(columns)] = scaled
    return panel


def draw_block(faces: Sequence[FloatArray], extents: Sequence[float]) -> FloatArray:
    """The block in parallel projection, z up, its three visible faces sampled from `faces` (x = last, y = 0, z = last)."""
    half = np.array(extents, float) / (2 * max(extents))
    toward = VIEW / np.linalg.norm(VIEW)
    right = np.cross([0, 0, 1], toward)
    right /= np.linalg.norm(right)
    up = np.cross(toward, right)
    ticks = ((np.arange(PANEL * SAMPLES) + 0.5) / (PANEL * SAMPLES) - 0.5) * 1.75  # the unit cube's diagonal, and a little
    across, above = np.meshgrid(ticks, -ticks)
    start = across[..., None] * right + above[..., None] * up + 2 * toward
    enter = (np.sign(toward) * half - start) / -toward  # distance along the ray at which it enters each pair of planes
    leave = (-np.sign(toward) * half - start) / -toward
    near, far, entered = enter.max(-1), leave.min(-1), enter.argmax(-1)
    position = (start - near[..., None] * toward) / (2 * half) + 0.5  # 0 .. 1 along each axis
    picture = np.full((*near.shape, 3), BACKGROUND, np.float32)
    for axis, face in enumerate(faces):
        seen = (near < far) & (entered == axis)
        column_axis, row_axis = [other for other in (0, 1, 2) if other != axis]
        rows, columns = (
            _index(position[seen][:, k], count) for k, count in zip((row_axis, column_axis), face.shape, strict=False)
        )
        picture[seen] = face[rows, columns] * SHADE[axis]
    block: FloatArray = picture.reshape(PANEL, SAMPLES, PANEL, SAMPLES, 3).mean((1, 3), dtype=np.float32)
    return block


def _index(position: npt.NDArray[np.float64], count: int) -> npt.NDArray[np.int64]:
    return np.clip((position * count).astype(np.int64), 0, count - 1)


def size(output: Output, volume: Volume) -> int:
    return 4 * PANEL * (PANEL + GAP) * 3 + 65536
