"""The OpenVDB file format, as far as boxes of voxels need it: the header, a grid's head, and the nodes of its tree.

Format version 224, which OpenVDB 10 writes. No specification exists; the sources are OpenVDB's own code
(io/Archive.cc, io/GridDescriptor.cc, io/Compression.h, math/Maps.h, tree/RootNode.h, InternalNode.h, LeafNode.h) and "VDB: A
Deep Dive" (jangafx.com/insights/vdb-a-deep-dive). Little-endian throughout.

Conventions: a root has upper nodes of 4096 voxels along an edge, those have lower nodes of 128, those have leaves of 8. The
children of a node lie in the file with z fastest and x slowest, and so do the voxels of a leaf: the other way round than in
our arrays [z, y, x]. Extents and starts are voxels (x, y, z). All topology comes before all values of leaves. Values that are
not active are the background, 0, and are not stored.
"""

from __future__ import annotations

import itertools
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from solidgrain.bake.store import Bytes

UPPER, LOWER, LEAF = 4096, 128, 8  # voxels along the edge of a node
MASK_BYTES = LEAF**3 // 8
RECORD_HEAD = MASK_BYTES + 1  # bytes of a leaf before its values
LEVEL = 1  # of zlib: 6 saves less than 1 % more
MAGIC, VERSION, LIBRARY = 0x56444220, 224, (10, 0)
ZIP, ACTIVE_VALUES = 1, 2  # bits of a grid's compression
INACTIVE_IS_BACKGROUND = b"\0"  # how a node treats values that are not active

Triple = tuple[int, int, int]


@dataclass(frozen=True)
class Grid:
    """What the values of a grid look like."""

    name: str
    solid: bool  # 1 everywhere: nodes that the volume fills become tiles. Otherwise colours
    half: bool
    compressed: bool

    @property
    def type(self) -> str:
        return f"Tree_{'float' if self.solid else 'vec3s'}_5_4_3" + ("_HalfFloat" if self.half else "")

    @property
    def channels(self) -> int:
        return 1 if self.solid else 3

    @property
    def dtype(self) -> np.dtype[np.floating]:
        return np.dtype("<f2" if self.half else "<f4")

    @property
    def voxel_bytes(self) -> int:
        return self.channels * self.dtype.itemsize

    @property
    def compression(self) -> int:
        return ACTIVE_VALUES | ZIP if self.compressed else ACTIVE_VALUES

    def is_tile(self, box: Triple, edge: int) -> bool:
        """Whether a node that holds a box of voxels is one value."""
        return self.solid and min(box) == edge

    def stored(self, values: Bytes) -> bytes:
        """A node's active values as they lie in the file (io/Compression.h: `zipToStream`)."""
        if not self.compressed or (self.half and not values):
            return bytes(values)
        packed = zlib.compress(values, LEVEL)
        if len(packed) < len(values):
            return struct.pack("<q", len(packed)) + packed
        return struct.pack("<q", -len(values)) + values


def blocks(box: Triple, edge: int) -> Iterator[tuple[Triple, Triple]]:
    """The nodes that a box of voxels is cut into, in the order of the file: where each begins, and the voxels that it holds."""
    for x, y, z in itertools.product(*(range(0, extent, edge) for extent in box)):
        yield (x, y, z), (min(edge, box[0] - x), min(edge, box[1] - y), min(edge, box[2] - z))


def file_header(uuid: str, grids: int) -> bytes:
    """All that comes before the first grid. Grids tell where they end, which is what the 1 stands for."""
    assert len(uuid) == 36
    head = struct.pack("<q3IB", MAGIC, VERSION, *LIBRARY, 1) + uuid.encode("ascii")
    return head + _metadata({}) + struct.pack("<i", grids)


def descriptor(grid: Grid) -> bytes:
    """What a grid is called; where it lies follows, as three int64."""
    return _string(grid.name) + _string(grid.type) + _string("")


def grid_head(grid: Grid, box: Triple, spacing: tuple[float, ...], first: tuple[float, ...], notes: Mapping[str, str]) -> bytes:
    """A grid up to its tree: metadata, and where its voxels are. `first` is the centre of voxel (0, 0, 0)."""
    values: dict[str, str | bool | int | Triple] = {
        **notes,
        "class": "fog volume",
        "creator": "solidgrain",
        "file_bbox_min": (0, 0, 0),
        "file_bbox_max": (box[0] - 1, box[1] - 1, box[2] - 1),
        "file_compression": "zip + active values" if grid.compressed else "active values",
        "file_voxel_count": box[0] * box[1] * box[2],
        "is_saved_as_half_float": grid.half,
        "name": grid.name,
    }
    return struct.pack("<I", grid.compression) + _metadata(values) + _transform(spacing, first)


def _transform(spacing: tuple[float, ...], first: tuple[float, ...]) -> bytes:
    """Translation, scale, voxel size, and what the library would otherwise compute again: 1/s, 1/s^2, 1/(2 s)."""
    uniform = len(set(spacing)) == 1
    rows = [first, spacing, [abs(step) for step in spacing]]
    rows += [[1 / step for step in spacing], [1 / step**2 for step in spacing], [0.5 / step for step in spacing]]
    return _string("UniformScaleTranslateMap" if uniform else "ScaleTranslateMap") + np.array(rows, "<f8").tobytes()


def _metadata(values: Mapping[str, str | bool | int | Triple]) -> bytes:
    return struct.pack("<I", len(values)) + b"".join(_string(name) + _value(values[name]) for name in sorted(values))


def _value(value: str | bool | int | Triple) -> bytes:
    """A value with its type and size. A text's own length is that size."""
    if isinstance(value, str):
        return _string("string") + _string(value)
    if isinstance(value, bool):
        return _string("bool") + struct.pack("<I?", 1, value)
    if isinstance(value, int):
        return _string("int64") + struct.pack("<Iq", 8, value)
    return _string("vec3i") + struct.pack("<I3i", 12, *value)


def _string(text: str) -> bytes:
    content = text.encode("utf-8")
    return struct.pack("<I", len(content)) + content


def topology(grid: Grid, box: Triple) -> Iterator[bytes]:
    """Which nodes there are, all the way down to the masks of the leaves."""
    uppers = list(blocks(box, UPPER))
    background = bytes(4 * grid.channels)  # not halved
    yield struct.pack("<i", 1) + background + struct.pack("<2I", 0, len(uppers))  # one buffer, no tiles in the root
    for start, upper in uppers:
        yield struct.pack("<3i", *start) + _node(grid, upper, UPPER, LOWER)
        for _, lower in blocks(upper, LOWER):
            if not grid.is_tile(lower, LOWER):
                yield _lower_topology(grid, lower)


@lru_cache(maxsize=16)  # the lower nodes of a box have eight shapes at most
def _lower_topology(grid: Grid, box: Triple) -> bytes:
    """A lower node and the masks of its leaves."""
    leaves = (leaf_mask(leaf) for _, leaf in blocks(box, LEAF) if not grid.is_tile(leaf, LEAF))
    return _node(grid, box, LOWER, LEAF) + b"".join(leaves)


def _node(grid: Grid, box: Triple, edge: int, child: int) -> bytes:
    """A node that holds a box of voxels: which slots are children, which are tiles, and the tiles' values."""
    held = _mask(edge // child, [-(-extent // child) for extent in box])
    tiles = _mask(edge // child, [extent // child if grid.solid else 0 for extent in box])
    values = np.ones(np.count_nonzero(tiles), grid.dtype).tobytes()
    return _packed(held & ~tiles) + _packed(tiles) + INACTIVE_IS_BACKGROUND + grid.stored(values)


@lru_cache(maxsize=16)
def leaf_mask(box: Triple) -> bytes:
    """Which voxels of a leaf lie in the volume."""
    return _packed(_mask(LEAF, box))


def _mask(edge: int, filled: Triple | list[int]) -> npt.NDArray[np.bool_]:
    """A cube [x, y, z] of slots, those of a box at its corner set."""
    mask = np.zeros((edge, edge, edge), np.bool_)
    mask[: filled[0], : filled[1], : filled[2]] = True
    return mask


def _packed(mask: npt.NDArray[np.bool_]) -> bytes:
    """64-bit words, the first slot in the lowest bit."""
    return np.packbits(mask, bitorder="little").tobytes()


def solid_leaves(grid: Grid, box: Triple) -> Iterator[bytes]:
    """The values of a solid grid: those of the leaves at the volume's far faces, which it does not fill."""
    for _, upper in blocks(box, UPPER):
        for _, lower in blocks(upper, LOWER):
            if not grid.is_tile(lower, LOWER):
                yield _solid_lower(grid, lower)


@lru_cache(maxsize=16)
def _solid_lower(grid: Grid, box: Triple) -> bytes:
    return b"".join(_solid_leaf(grid, leaf) for _, leaf in blocks(box, LEAF) if not grid.is_tile(leaf, LEAF))


@lru_cache(maxsize=16)
def _solid_leaf(grid: Grid, box: Triple) -> bytes:
    values = np.ones(box, grid.dtype).tobytes()
    return leaf_mask(box) + INACTIVE_IS_BACKGROUND + grid.stored(values)


def color_leaves(grid: Grid, voxels: npt.NDArray[np.void]) -> list[Bytes]:
    """The values of the leaves of a lower node that share their x, from voxels [z, y, x <= 8] of `voxel_bytes` each."""
    rows: list[Bytes] = []
    for y, along_y, height in _runs(voxels.shape[1]):
        runs = [
            _leaf_rows(grid, voxels[z : z + along_z * depth, y : y + along_y * height], along_z, along_y)
            for z, along_z, depth in _runs(voxels.shape[0])
        ]
        rows += [run[k] for k in range(along_y) for run in runs]
    return rows


def _runs(extent: int) -> Iterator[tuple[int, int, int]]:
    """Leaves along an axis: the whole ones, then one that is cut. Where they begin, how many, their voxels along the axis."""
    whole, rest = divmod(extent, LEAF)
    if whole:
        yield 0, whole, LEAF
    if rest:
        yield whole * LEAF, 1, rest


def _leaf_rows(grid: Grid, voxels: npt.NDArray[np.void], along_z: int, along_y: int) -> list[Bytes]:
    """Leaves of one shape, a row along z for each of them along y."""
    depth, height, width = voxels.shape[0] // along_z, voxels.shape[1] // along_y, voxels.shape[2]
    leaves = voxels.reshape(along_z, depth, along_y, height, width).transpose(2, 0, 4, 3, 1)
    values = np.ascontiguousarray(leaves).reshape(along_y, along_z, -1).view(np.uint8)
    head = leaf_mask((width, height, depth)) + INACTIVE_IS_BACKGROUND
    if grid.compressed:
        return [b"".join(head + grid.stored(leaf.data) for leaf in row) for row in values]
    records = np.empty((along_y, along_z, RECORD_HEAD + values.shape[2]), np.uint8)
    records[..., :RECORD_HEAD] = np.frombuffer(head, np.uint8)
    records[..., RECORD_HEAD:] = values
    return [row.data for row in records]
