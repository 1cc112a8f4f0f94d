"""Voxels of a finished `.vdb`, for `verify`. Of the tree only the leaves' values are read: a dense box says where they are."""

from __future__ import annotations

import mmap
import struct
import zlib
from pathlib import Path

import numpy as np
import numpy.typing as npt

from solidgrain.bake.writers.vdb_tree import LEAF, LOWER, MAGIC, RECORD_HEAD, UPPER, VERSION, Grid, Triple
from solidgrain.runtime.errors import BakeError

FloatArray = npt.NDArray[np.float32]
IndexArray = npt.NDArray[np.int64]


def read_colors(path: Path, grid: Grid, box: Triple, voxels: IndexArray) -> FloatArray:
    """The values [P, 3] of a grid that fills a box, at voxels [P, 3] (x, y, z). Raises BakeError."""
    try:
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            first_leaf = _find_leaves(content, grid)
            leaf = _rank(voxels // LEAF, tuple(-(-extent // LEAF) for extent in box), (UPPER // LEAF, LOWER // LEAF))
            voxel = _rank(voxels, box, (UPPER, LOWER, LEAF))
            if grid.compressed:
                return _unpacked(
                    content, grid, first_leaf, leaf, voxel - _rank(voxels // LEAF * LEAF, box, (UPPER, LOWER, LEAF))
                )
            return _plain(content, grid, first_leaf + (leaf + 1) * RECORD_HEAD + voxel * grid.voxel_bytes)
    except (OSError, ValueError, IndexError, struct.error, zlib.error) as error:
        raise BakeError(f"{path}: expected an OpenVDB file with a grid {grid.name!r} ({error}); bake again") from error


def _rank(cells: IndexArray, extents: tuple[int, ...], edges: tuple[int, ...]) -> IndexArray:
    """How many cells of a box lie in the file before each one [P, 3]: cubes of `edges`, in each the cubes of the next."""
    rank, left = np.zeros(len(cells), np.int64), np.broadcast_to(np.array(extents, np.int64), cells.shape)
    for edge in (*edges, 1):
        start = cells // edge * edge
        inside = np.minimum(edge, left - start)
        rank += start[:, 0] * left[:, 1] * left[:, 2]
        rank += inside[:, 0] * (start[:, 1] * left[:, 2] + inside[:, 1] * start[:, 2])
        cells, left = cells - start, inside
    return rank


def _plain(content: mmap.mmap, grid: Grid, offsets: IndexArray) -> FloatArray:
    size = grid.voxel_bytes
    values = b"".join(content[offset : offset + size] for offset in offsets.tolist())
    return np.frombuffer(values, grid.dtype).reshape(-1, 3).astype(np.float32)


def _unpacked(content: mmap.mmap, grid: Grid, position: int, leaf: IndexArray, inside: IndexArray) -> FloatArray:
    """The voxels at places `inside` leaves. Where a leaf begins only the sizes of those before it tell."""
    values, wanted = np.empty((len(leaf), 3), np.float32), np.unique(leaf)
    for rank in range(int(wanted[-1]) + 1):
        (size,) = struct.unpack_from("<q", content, position + RECORD_HEAD)
        begin = position + RECORD_HEAD + 8
        position = begin + abs(size)
        if rank == wanted[0]:
            stored, wanted = content[begin:position], wanted[1:]
            unpacked = np.frombuffer(zlib.decompress(stored) if size > 0 else stored, grid.dtype).reshape(-1, 3)
            values[leaf == rank] = unpacked[inside[leaf == rank]]
    return values


def _find_leaves(content: mmap.mmap, grid: Grid) -> int:
    """Where the values of a grid's leaves begin. Raises ValueError."""
    magic, version = struct.unpack_from("<qI", content, 0)
    if (magic, version) != (MAGIC, VERSION):
        raise ValueError(f"found version {version}")
    position = _skip_metadata(content, struct.calcsize("<q3IB") + 36)
    (count,) = struct.unpack_from("<i", content, position)
    position += 4
    for _ in range(count):
        name, position = _string(content, position)
        kind, position = _string(content, position)
        _, position = _string(content, position)
        _, first_leaf, end = struct.unpack_from("<3q", content, position)
        if (name, kind) == (grid.name, grid.type):
            return int(first_leaf)
        position = end
    raise ValueError("found none of that name and type")


def _skip_metadata(content: mmap.mmap, position: int) -> int:
    (count,) = struct.unpack_from("<I", content, position)
    position += 4
    for _ in range(3 * count):  # name, type and value each have a length in front
        _, position = _string(content, position)
    return position


def _string(content: mmap.mmap, position: int) -> tuple[str, int]:
    (size,) = struct.unpack_from("<I", content, position)
    return content[position + 4 : position + 4 + size].decode("utf-8"), position + 4 + size
