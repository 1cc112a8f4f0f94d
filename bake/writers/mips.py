"""Mip chains: each level is filtered from the one above it, along all three axes, in linear light.

(Evaluating the texture again on a coarser grid would alias: octaves above its Nyquist frequency stay in.) Slices are filtered
along x and y as they come and spooled, a quarter of the volume; along z, and for all further levels, when all of them are
there. Axes that tile wrap around, the others repeat their edge. A level has floor(n / 2) voxels along an axis, as Direct3D
and OpenGL want it; where n is odd, a voxel covers a little more than two.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from solidgrain.bake.color import to_linear, to_srgb
from solidgrain.bake.frames import PATTERN
from solidgrain.bake.store import Encoded, Finished, Store
from solidgrain.bake.writers.base import FloatArray, Output, Volume, Writer, slab_slices
from solidgrain.runtime.workers import Workers

FILTERS = ("box", "kaiser")
KAISER_WIDTH, KAISER_ALPHA = 3.0, 4.0  # half width in voxels of the level, and sharpness (NVIDIA Texture Tools' defaults)
REDUCED = "reduced"  # stream: slices in linear light, filtered along x and y


class Taps(NamedTuple):
    """Which voxels of an axis make each voxel of the level below, and how much of each."""

    source: npt.NDArray[np.int64]  # [m, taps]
    weight: FloatArray  # [m, taps], each row sums to 1


def taps(count: int, kind: str, wrap: bool) -> Taps:
    """The filter from `count` voxels along an axis to max(1, count // 2)."""
    fewer = max(1, count // 2)
    ratio = count / fewer
    reach = ratio / 2 if kind == "box" else KAISER_WIDTH * ratio
    centers = (np.arange(fewer) + 0.5) * ratio
    first = np.floor(centers - reach).astype(np.int64)
    index = first[:, None] + np.arange(int(np.ceil(2 * reach)) + 1)
    if kind == "box":
        overlap = np.minimum(index + 1, centers[:, None] + reach) - np.maximum(index, centers[:, None] - reach)
        weight = overlap.clip(0)
    else:
        weight = _kaiser((index + 0.5 - centers[:, None]) / ratio)
    weight /= weight.sum(1, keepdims=True)
    used = (weight != 0).any(0)
    index = index % count if wrap else index.clip(0, count - 1)
    return Taps(index[:, used], weight[:, used].astype(np.float32))


def _kaiser(distance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """A sinc under a Kaiser window, at distances in voxels of the level."""
    inside = (1 - (distance / KAISER_WIDTH) ** 2).clip(0)
    window = np.i0(KAISER_ALPHA * np.sqrt(inside)) / np.i0(KAISER_ALPHA)
    return np.sinc(distance) * np.where(np.abs(distance) < KAISER_WIDTH, window, 0)


def filtered(values: FloatArray, axis: int, by: Taps) -> FloatArray:
    """An array, smaller along one axis."""
    weight = by.weight.reshape(len(by.weight), -1, *[1] * (values.ndim - axis - 1))
    total = values.take(by.source[:, 0], axis) * weight[:, 0]
    for k in range(1, by.source.shape[1]):
        total += values.take(by.source[:, k], axis) * weight[:, k]
    return total


def level_volume(volume: Volume) -> Volume:
    """The next level's grid: the same block of space, fewer voxels."""
    shape = [max(1, extent // 2) for extent in volume.shape]
    spacing = [step * old / new for step, old, new in zip(volume.spacing, volume.shape[::-1], shape[::-1], strict=True)]
    return replace(
        volume,
        shape=(shape[0], shape[1], shape[2]),
        spacing=(spacing[0], spacing[1], spacing[2]),
        level=volume.level + 1,
    )


def level_volumes(volume: Volume) -> list[Volume]:
    """All levels below a volume, down to one voxel."""
    levels = []
    while max(volume.shape) > 1:
        volume = level_volume(volume)
        levels.append(volume)
    return levels


def level_output(output: Output, level: int) -> Output:
    """`a.vti` -> `a.mip1.vti`, `a.####.exr` -> `a.mip1.####.exr`."""
    name = output.path.name
    frames = PATTERN.search(name) if "start" in output.options else None
    match = frames or re.search(re.escape(output.kind) + "$", name, re.IGNORECASE)
    start = match.start() if match else len(name)
    parts = [name[:start].removesuffix("."), f"mip{level}", name[start:].removeprefix(".")]
    return replace(output, path=output.path.with_name(".".join(part for part in parts if part)))


class MippedWriter(Writer):
    """A writer and the levels below it: in files of their own, or in the same one where the format has room for them."""

    def __init__(
        self,
        output: Output,
        volume: Volume,
        workers: Workers,
        opener: Callable[[Output, Volume, Workers], Writer],
        inside: bool,
    ) -> None:
        super().__init__(output, volume, workers)
        self.opener, self.inside, self.filter = opener, inside, str(output.options["mips"])
        self.base = opener(output, volume, workers)

    @property
    def reserved(self) -> int:
        return self.base.reserved

    def encode(self, z: int, slab: FloatArray) -> Encoded:
        return self._with_reduced(self.base.encode(z, slab), lambda k: to_linear(slab[k]), len(slab), self.volume)

    def _with_reduced(self, encoded: Encoded, linear: Callable[[int], FloatArray], count: int, volume: Volume) -> Encoded:
        """What the level below needs of slices, `linear(k)` in linear light, along with the slices' own bytes."""
        across = [taps(volume.shape[axis], self.filter, "zyx"[axis] in volume.tile) for axis in (1, 2)]
        reduced = self.workers.map(lambda k: filtered(filtered(linear(k), 0, across[0]), 1, across[1]), count)
        return Encoded({**encoded.streams, REDUCED: [level.data for level in reduced]}, encoded.files)

    def assemble(self, store: Store) -> list[Finished]:
        above, finished, levels = (store, self.volume), [], []
        for volume in level_volumes(self.volume):
            output = self.output if self.inside else level_output(self.output, volume.level)
            writer = self.opener(output, volume, self.workers)
            below = self._fill(writer, *above, store.folder / f"mip{volume.level}")
            finished += [] if self.inside else writer.assemble(below)
            levels.append(below)
            above = (below, volume)
        if self.inside:
            return self.base.assemble_levels(store, levels)
        return [*self.base.assemble(store), *finished]

    def _fill(self, writer: Writer, source: Store, above: Volume, folder: Path) -> Store:
        """The store of one level, in a folder of its own, from the reduced slices of the level above."""
        store = Store(folder, writer.volume.shape[0], writer.reserved)
        store.clear()
        folder.mkdir()
        for z, linear in self._levels(source, above, writer.volume):
            encoded = writer.encode(z, to_srgb(linear))
            store.append(z, len(linear), self._with_reduced(encoded, linear.__getitem__, len(linear), writer.volume))
        return store

    def _levels(self, source: Store, above: Volume, volume: Volume) -> Iterator[tuple[int, FloatArray]]:
        """The slices of a level as slabs in linear light: the reduced slices above it, filtered along z."""
        by = taps(above.shape[0], self.filter, "z" in above.tile)
        _, height, width = volume.shape
        kept: dict[int, FloatArray] = {}

        def read(z: int) -> FloatArray:
            content = source.read(REDUCED, z, 1, height * width * 12)
            return np.frombuffer(content, np.float32).reshape(height, width, 3)

        thickness = slab_slices(len(by.source), 2 * height * width * 12)  # beside what they are made of
        for first in range(0, len(by.source), thickness):
            slab, last = [], first + thickness
            for index, weight in zip(by.source[first:last], by.weight[first:last], strict=True):
                kept = {z: kept[z] if z in kept else read(z) for z in map(int, index)}
                slab.append(sum(kept[z] * factor for z, factor in zip(map(int, index), weight, strict=True)))
            yield first, np.stack(slab).astype(np.float32, copy=False)

    def probe(self, voxels: npt.NDArray[np.int64]) -> tuple[FloatArray, float] | None:
        return self.base.probe(voxels)
