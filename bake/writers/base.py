"""What a writer is: it takes slabs in order and leaves a complete file behind, or none."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.files import temporary_name
from solidgrain.runtime.workers import Workers

FloatArray = npt.NDArray[np.float32]


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

    @property
    def voxels(self) -> int:
        return self.shape[0] * self.shape[1] * self.shape[2]

    @property
    def first_sample(self) -> tuple[float, float, float]:
        """Where voxel (0, 0, 0) is sampled (x, y, z): at its centre."""
        x, y, z = (start + 0.5 * step for start, step in zip(self.origin, self.spacing, strict=True))
        return (x, y, z)


@dataclass(frozen=True)
class Output:
    """One file, or one numbered stack of files, to write."""

    path: Path  # may hold a frame pattern
    kind: str  # suffix in the table, or "preview"
    options: dict[str, str | int] = field(default_factory=dict)


class Writer(ABC):
    """Takes the slabs of a volume in order. Nothing is visible under its final name before `commit`.

    Slow work goes to `workers`, the threads that also evaluate the texture.
    """

    def __init__(self, output: Output, volume: Volume, workers: Workers) -> None:
        self.output, self.volume, self.workers = output, volume, workers

    @abstractmethod
    def write(self, z: int, slab: FloatArray) -> None:
        """One slab: slices z, z + 1, ..., [<= slab, y, x, 3] in [0, 1], sRGB-encoded."""

    @abstractmethod
    def finish(self) -> None:
        """Complete the files, still under temporary names, down to the disk. All that can fail has failed after this."""

    @abstractmethod
    def commit(self) -> Sequence[Path]:
        """Give the finished files their names."""

    @abstractmethod
    def abort(self) -> None:
        """Remove whatever has been written and not committed. Safe to call at any time, more than once."""


class FileWriter(Writer):
    """A writer of a single file, under a temporary name in the same folder until it is whole."""

    def __init__(self, output: Output, volume: Volume, workers: Workers) -> None:
        super().__init__(output, volume, workers)
        self.temporary = temporary_name(output.path)
        self.file: BinaryIO = open(self.temporary, "wb")  # noqa: SIM115

    def finish(self) -> None:
        self.file.flush()
        os.fsync(self.file.fileno())
        self.file.close()

    def commit(self) -> Sequence[Path]:
        os.replace(self.temporary, self.output.path)
        return [self.output.path]

    def abort(self) -> None:
        with suppress(OSError):  # closing flushes, which fails again on a full disk
            self.file.close()
        self.temporary.unlink(missing_ok=True)


def to_uint8(rgb: FloatArray) -> npt.NDArray[np.uint8]:
    """[0, 1] to 0 .. 255, to the nearest."""
    scaled: npt.NDArray[np.uint8] = (rgb.clip(0, 1) * 255 + 0.5).astype(np.uint8)
    return scaled
