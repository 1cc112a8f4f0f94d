"""`.vdb`: an OpenVDB file with a dense grid of colours and a grid `density` that is 1 wherever the volume is.

Renderers draw nothing without a density, so there always is one; it costs next to nothing, because nodes that the volume
fills are one value each. The colours' grid is called `Cd`, as Houdini has it; Blender looks for `color`. Half-floats or
floats, plain or with each leaf of 8x8x8 voxels deflated. Index (x, y, z) is voxel (x, y, z), and its position is the centre
of it in the grid. Texture, seed, axes, transform and colour encoding are metadata of the grids. The layout: vdb_tree.py.

The file wants the voxels in cubes of 128 along an edge, column after column, slabs come as slices. So they are spooled, each
slab cut into columns, and read back cube by cube. Memory: the slab in the type of the file, then up to four cubes of 12.6 MB
(half) or 25 MB (float), whatever the volume's size; disk: the spool is as large as the colours.
"""

from __future__ import annotations

import hashlib
import os
import uuid
from collections.abc import Iterable, Iterator
from functools import partial
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from solidgrain.bake.color import as_floats
from solidgrain.bake.store import Bytes, Encoded, Finished, Record, Store
from solidgrain.bake.writers import vdb_tree
from solidgrain.bake.writers.base import ROUNDING, FloatArray, Option, Output, Volume, Writer
from solidgrain.bake.writers.vdb_read import read_colors
from solidgrain.bake.writers.vdb_tree import LEAF, LOWER, UPPER, Grid, Triple, blocks
from solidgrain.runtime.errors import UsageError
from solidgrain.runtime.workers import Workers

DENSITY = "density"
COLUMNS = "columns"  # stream: each slab as columns (x, y) of at most 128 by 128, y fastest, each [z, y, x, 3]
LARGEST = 2**31  # voxels along an axis: coordinates are int32
OPTIONS = (
    Option("type", "half", "of the values", ("half", "float")),
    Option("compression", "none", "zlib: smaller files, by a quarter at most", ("none", "zlib")),
    Option("grid", "Cd", "name of the colours; Blender looks for color"),
)


class VdbFile(Writer):
    """Columns are spooled, and written as cubes in the order of the tree."""

    def __init__(self, output: Output, volume: Volume, workers: Workers) -> None:
        super().__init__(output, volume, workers)
        self.color, self.density = grids(output)
        self.box: Triple = (volume.shape[2], volume.shape[1], volume.shape[0])

    def encode(self, z: int, slab: FloatArray) -> Encoded:
        columns = [(start, box) for start, box in blocks((self.box[0], self.box[1], 1), LOWER)]
        values = [np.empty((len(slab), box[1], box[0], 3), self.color.dtype) for _, box in columns]

        def convert(k: int, column: int) -> None:
            (x, y, _), (width, height, _) = columns[column]
            colors = self.colors(np.ascontiguousarray(slab[k, y : y + height, x : x + width]))
            values[column][k] = as_floats(colors, self.color.dtype)

        self.workers.run([partial(convert, k, column) for column in range(len(columns)) for k in range(len(slab))])
        return Encoded({COLUMNS: [column.data for column in values]})

    def assemble(self, store: Store) -> list[Finished]:
        path = store.folder / self.output.path.name
        with open(path, "wb") as file:
            file.write(vdb_tree.file_header(self._uuid(store), grids=2))
            self._write(file, self.color, self._leaves(store))
            self._write(file, self.density, vdb_tree.solid_leaves(self.density, self.box))
            file.flush()
            os.fsync(file.fileno())
        return [Finished(path, self.output.path)]

    def _uuid(self, store: Store) -> str:
        """The file's name for itself: the same for the same content, unlike OpenVDB's random one."""
        digest = hashlib.sha256(self._head(self.color))
        for record in store.ordered():
            digest.update(record.streams[COLUMNS].sha256.encode("ascii"))
        return str(uuid.uuid5(uuid.NAMESPACE_OID, digest.hexdigest()))

    def _head(self, grid: Grid) -> bytes:
        volume = self.volume
        notes = {**volume.notes, "color_encoding": self.output.colorspace}
        return vdb_tree.grid_head(grid, self.box, volume.spacing, volume.first_sample, notes)

    def _write(self, file: BinaryIO, grid: Grid, leaves: Iterable[Bytes]) -> None:
        """A grid; its descriptor says where it begins, where its leaves begin and where it ends."""
        file.write(vdb_tree.descriptor(grid))
        places = file.tell()
        file.write(bytes(24))
        head = file.tell()
        file.write(self._head(grid))
        file.writelines(vdb_tree.topology(grid, self.box))
        first_leaf = file.tell()
        file.writelines(leaves)
        end = file.tell()
        file.seek(places)
        file.write(np.array([head, first_leaf, end], "<i8").tobytes())
        file.seek(end)

    def _leaves(self, store: Store) -> Iterator[Bytes]:
        """The colours in the order of the tree."""
        records = store.ordered()
        for (x, y, z), upper in blocks(self.box, UPPER):
            for (i, j, k), lower in blocks(upper, LOWER):
                yield from self._lower_leaves(self._cube(store, records, (x + i, y + j, z + k), lower))

    def _lower_leaves(self, cube: npt.NDArray[np.void]) -> Iterator[Bytes]:
        """The leaves of one cube [z, y, x]."""
        starts = range(0, cube.shape[2], LEAF)
        columns: list[list[Bytes]] = [[] for _ in starts]

        def convert(k: int) -> None:
            columns[k] = vdb_tree.color_leaves(self.color, cube[:, :, starts[k] : starts[k] + LEAF])

        self.workers.run([partial(convert, k) for k in range(len(starts))])
        for column in columns:
            yield from column

    def _cube(self, store: Store, records: list[Record], start: Triple, box: Triple) -> npt.NDArray[np.void]:
        """Voxels [z, y, x], from where a lower node begins."""
        (x, y, z), (width, height, depth) = start, box
        slice_bytes = width * height * self.color.voxel_bytes
        before = (x * self.box[1] + width * y) * self.color.voxel_bytes  # columns, per slice of a slab
        parts = []
        for record in records:
            first, stop = max(z, record.z), min(z + depth, record.z + record.slices)
            if first < stop:
                offset = before * record.slices + (first - record.z) * slice_bytes
                parts.append(store.read_span(record.streams[COLUMNS], offset, (stop - first) * slice_bytes))
        return np.frombuffer(b"".join(parts), f"V{self.color.voxel_bytes}").reshape(depth, height, width)

    def probe(self, voxels: npt.NDArray[np.int64]) -> tuple[FloatArray, float] | None:
        return read_colors(self.output.path, self.color, self.box, voxels), ROUNDING[2 if self.color.half else 4]


def grids(output: Output) -> tuple[Grid, Grid]:
    """The colours and the density."""
    half, compressed = output.options["type"] == "half", output.options["compression"] == "zlib"
    return Grid(str(output.options["grid"]), False, half, compressed), Grid(DENSITY, True, half, compressed)


def check(output: Output, volume: Volume) -> None:
    name = str(output.options["grid"])
    if not name.strip() or not name.isprintable() or name == DENSITY:
        raise UsageError(f"--vdb-grid {name!r}: expected a name for the colours other than {DENSITY}, such as Cd or color")
    if max(volume.shape) >= LARGEST:
        raise UsageError(f"--size: {max(volume.shape)} voxels along an axis, .vdb holds {LARGEST - 1}; bake in parts")


def size(output: Output, volume: Volume) -> int:
    color, density = grids(output)
    box = volume.shape[::-1]
    uppers, lowers, leaves = (int(np.prod([-(-extent // edge) for extent in box])) for edge in (UPPER, LOWER, LEAF))
    cut = leaves - int(np.prod([extent // LEAF for extent in box]))  # leaves of the density that are not tiles
    nodes = 2 * (uppers * (32**3 // 4 + 32) + lowers * (16**3 // 4 + 16)) + (leaves + lowers) * density.voxel_bytes
    heads = (leaves + cut) * (vdb_tree.MASK_BYTES + vdb_tree.RECORD_HEAD + 8)
    text = 4 * len(f"{volume.texture}{color.name}".encode())
    return 4096 + text + nodes + heads + volume.voxels * color.voxel_bytes + cut * LEAF**3 * density.voxel_bytes


def scratch(output: Output) -> int:
    return grids(output)[0].voxel_bytes
