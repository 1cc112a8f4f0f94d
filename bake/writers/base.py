"""What a writer is: it turns slabs into bytes, and the bytes of all slabs into complete files.

A bake may be killed and resumed, and its slabs may be encoded by several processes. So a writer keeps nothing between two
calls: `encode` depends on its slab alone, and `assemble` reads what the store has of all of them.
"""

from __future__ import annotations

import json
import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from solidgrain.bake.color import as_floats, from_srgb, quantize, triangular
from solidgrain.bake.store import Bytes, Encoded, Finished, Store
from solidgrain.runtime.workers import Workers

FloatArray = npt.NDArray[np.float32]
SLAB_BYTES = 48 * 2**20  # of float32 colour; what a bake holds at a time is a small multiple of it
THICKEST_SLAB = 16  # slices
ROUNDING = {2: 2.0**-11, 4: 1e-6}  # by the bytes of a float: half an ulp of a colour below 2, of larger ones in proportion


@dataclass(frozen=True)
class Volume:
    """The grid that is being written, and where its colours come from."""

    shape: tuple[int, int, int]  # voxels (z, y, x)
    origin: tuple[float, float, float]  # (x, y, z), exemplar pixels
    spacing: tuple[float, float, float]  # (x, y, z), exemplar pixels per voxel
    texture: str
    sampler_sha256: str
    seed: int
    tile: str
    axes: str = "+x+y+z"  # which axes of the texture (x, y, z) of this grid are, with their signs
    level: int = 0  # in the mip chain
    transform: tuple[tuple[float, ...], ...] | None = None  # 4x4, from the texture's grid to where it was evaluated

    @property
    def voxels(self) -> int:
        return self.shape[0] * self.shape[1] * self.shape[2]

    @property
    def first_sample(self) -> tuple[float, float, float]:
        """Where voxel (0, 0, 0) is sampled (x, y, z): at its centre."""
        x, y, z = (start + 0.5 * step for start, step in zip(self.origin, self.spacing, strict=True))
        return (x, y, z)

    @property
    def notes(self) -> dict[str, str]:
        """What a file says of where its colours come from, besides its place: with both, `Texture.grid` gives them again."""
        notes = {"texture": self.texture, "model": self.sampler_sha256, "seed": str(self.seed), "axes": self.axes}
        if self.tile:
            notes["tile"] = self.tile
        if self.level:
            notes["level"] = str(self.level)
        return notes | ({"transform": json.dumps(self.transform)} if self.transform else {})


@dataclass(frozen=True)
class Output:
    """One file, or one numbered stack of files, to write."""

    path: Path  # may hold a frame pattern
    kind: str  # suffix in the table, or "preview"
    options: dict[str, str | int] = field(default_factory=dict)

    @property
    def colorspace(self) -> str:
        return str(self.options["colorspace"])


def slab_slices(depth: int, slice_bytes: int) -> int:
    """Slices of `slice_bytes` that are worked on at a time: as many as fit `SLAB_BYTES`, at least one."""
    return max(1, min(THICKEST_SLAB, depth, SLAB_BYTES // slice_bytes))


class Option(NamedTuple):
    """One setting of a format: an entry in an output's options, and a flag `--<format>-<name>` of the command line."""

    name: str
    default: str | int
    help: str
    choices: tuple[str, ...] = ()  # empty: any text, or any whole number if the default is one


class Writer(ABC):
    """One output. Slow work goes to `workers`, the threads that also evaluate the texture."""

    def __init__(self, output: Output, volume: Volume, workers: Workers) -> None:
        self.output, self.volume, self.workers = output, volume, workers

    @property
    def reserved(self) -> int:
        """Bytes that the store keeps free before the first slab's, for a header."""
        return 0

    @abstractmethod
    def encode(self, z: int, slab: FloatArray) -> Encoded:
        """Slices z, z + 1, ..., [<= slab, y, x, 3] in [0, 1], sRGB-encoded, as bytes."""

    @abstractmethod
    def assemble(self, store: Store) -> list[Finished]:
        """Complete files, on the disk, from the bytes of all slabs. May be called again after it was cut short."""

    def assemble_levels(self, store: Store, levels: Sequence[Store]) -> list[Finished]:
        """The same for a format whose file holds the mip levels too (`Format.levels_inside`)."""
        raise NotImplementedError

    def probe(self, voxels: npt.NDArray[np.int64]) -> tuple[FloatArray, float] | None:
        """The colours [P, 3] that the finished files hold at voxels [P, 3] (x, y, z), in the output's colour space, and how
        far the format's rounding may move them: those above 1 that many times as far. None for a format whose error has no
        bound."""
        return None

    def colors(self, rgb: FloatArray) -> FloatArray:
        """sRGB-encoded colours in the colour space of this output."""
        return from_srgb(rgb, self.output.colorspace)

    def stored(self, slab: FloatArray, z: int, dtype: npt.DTypeLike) -> npt.NDArray[np.generic]:
        """Slices z, z + 1, ... in the colour space of this output, as floats or unsigned whole numbers."""
        whole = np.dtype(dtype).kind == "u"
        return np.ascontiguousarray(self.quantized(slab, z, dtype) if whole else as_floats(self.colors(slab), dtype))

    def read_back(self, values: npt.NDArray[Any]) -> tuple[FloatArray, float]:
        """What `stored` made of colours, as colours, and how far it may have moved them, as `probe` says."""
        colors = values.astype(np.float32)
        if values.dtype.kind == "f":
            return colors, ROUNDING[values.dtype.itemsize]
        largest = np.iinfo(values.dtype).max
        steps = 1.5 if self.output.options["dither"] else 0.5
        return colors / np.float32(largest), steps / largest + 1e-6

    def quantized(self, slab: FloatArray, z: int, dtype: npt.DTypeLike) -> npt.NDArray[np.generic]:
        """Slices z, z + 1, ... as whole numbers, 0 .. 255 or 0 .. 65535 for [0, 1], dithered if the output asks for it."""
        dither = bool(self.output.options["dither"])
        return quantize(self.colors(slab), dtype, noise=triangular(slab.shape, z) if dither else None)


class SequenceWriter(Writer):
    """A single file: a header, what the slabs are encoded to, in order, and a trailer."""

    def header(self, store: Store) -> bytes:
        """Exactly `reserved` bytes."""
        return b""

    def trailer(self) -> bytes:
        return b""

    def assemble(self, store: Store) -> list[Finished]:
        path = store.joined(DATA)
        with open(path, "r+b") as file:
            header = self.header(store)
            assert len(header) == self.reserved
            file.write(header)
            file.seek(0, os.SEEK_END)
            file.write(self.trailer())
            file.flush()
            os.fsync(file.fileno())
        return [Finished(path, self.output.path)]


DATA = "data"  # the stream that becomes a sequence writer's file


def data(*parts: Bytes) -> Encoded:
    """Bytes for the one stream of a sequence writer."""
    return Encoded(streams={DATA: list(parts)})


def replay(slabs: Iterable[tuple[int, FloatArray]], writer: Writer, folder: Path) -> list[Finished]:
    """Feed a writer slabs that were not evaluated but read from a store. `folder` is made anew."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    store = Store(folder, writer.volume.shape[0], writer.reserved)
    for z, slab in slabs:
        store.append(z, len(slab), writer.encode(z, slab))
    return writer.assemble(store)
