"""A folder of photographs: what a texture space is trained on, and what it is never shown (Sec. 3.2)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from solidgrain.runtime.errors import ExemplarError
from solidgrain.train.exemplar import FRAMED, FloatArray, edge_step, flip_by_chance, uniform_below
from solidgrain.train.photograph import SUFFIXES, read_photograph
from solidgrain.train.settings import Settings

LEVELS = 65535  # exemplars are kept in 16 bits: half the memory, and no photograph has more
WRAPS = 1.5  # times the step between neighbouring rows that the step across a seam may be


@dataclass(frozen=True)
class Member:
    """One photograph of a collection."""

    name: str  # its file's
    pixels: npt.NDArray[np.uint16]  # [H, W, 3], sRGB-encoded; read from disk where it is needed
    wraps: tuple[bool, bool]  # whether it continues across its edges, down and across
    colorspace: str = ""  # what its colours were read as

    @property
    def exemplar(self) -> FloatArray:
        """All of it, [H, W, 3] in [0, 1]."""
        return np.asarray(self.pixels, np.float32) / np.float32(LEVELS)

    def crop(self, size: int, generator: torch.Generator) -> Tensor:
        """A random crop [3, size, size], across its edges where it continues there."""
        ranges = []
        for extent, wraps in zip(self.pixels.shape[:2], self.wraps, strict=True):
            start = uniform_below(extent if wraps else extent - size + 1, generator)
            ranges.append(np.arange(start, start + size) % extent)
        crop = np.asarray(self.pixels[np.ix_(*ranges)], np.float32) / LEVELS
        return torch.from_numpy(crop).permute(2, 0, 1).to(generator.device)


def draw_patches(member: Member, size: int, count: int, settings: Settings, generator: torch.Generator) -> Tensor:
    """Random crops of one exemplar, flipped and transposed by chance as those of a single one: [count, 3, size, size]."""
    crops = [flip_by_chance(member.crop(size, generator), settings, generator) for _ in range(count)]
    return torch.stack(crops).contiguous(memory_format=torch.channels_last)


def read_members(folder: Path, smallest: int, skip: bool, on_warning: Callable[[str], None]) -> Iterator[Member]:
    """The photographs of a folder, in the order of their names, one at a time.

    Files that are unreadable or have fewer than `smallest` pixels along an axis are named to `on_warning` and left out if
    `skip` says so. Raises ExemplarError for the first of them otherwise, and for a folder without photographs.
    """
    for path in photographs_in(folder):
        try:
            photograph = read_photograph(path, smallest, "use a larger photograph")
        except ExemplarError as error:
            if not skip:
                raise ExemplarError(f"{error}; or leave such files out with --skip-unreadable") from error
            on_warning(f"{error}; left out")
            continue
        if photograph.warning:
            on_warning(f"{path}: {photograph.warning}")
        yield Member(path.name, in_levels(photograph.pixels), wraps(photograph.pixels), photograph.colorspace)


def in_levels(exemplar: FloatArray) -> npt.NDArray[np.uint16]:
    """An exemplar [H, W, 3] in [0, 1] as members hold it, and as their hashes are of it."""
    return np.round(exemplar * LEVELS).astype(np.uint16)


def photographs_in(folder: Path) -> list[Path]:
    """The files of a folder that look like photographs by their names; hidden ones are no one's photographs."""
    if not folder.is_dir():
        raise ExemplarError(f"{folder}: no such folder; expected a folder of photographs (PNG, JPEG, TIFF, EXR, ...)")
    try:
        paths = sorted(folder.iterdir())
    except OSError as error:
        raise ExemplarError(f"{folder}: cannot be read ({error.strerror})") from error
    found = [path for path in paths if path.suffix.lower() in SUFFIXES and path.name[0] != "." and not path.is_dir()]
    if not found:
        raise ExemplarError(f"{folder}: no photographs in it; expected files ending in {', '.join(sorted(SUFFIXES))}")
    return found


def choose_held_out(names: Sequence[str], wanted: int | Sequence[str], seed: int) -> frozenset[str]:
    """The names of the exemplars that are never trained on: so many, drawn at random, or those that `wanted` lists.

    Raises ExemplarError if a name is not there, or if fewer than two are left to train on.
    """
    if isinstance(wanted, int):
        order = np.random.Generator(np.random.Philox(seed)).permutation(len(names))
        held_out = frozenset(names[place] for place in order[:wanted])
    else:
        held_out = frozenset(wanted)
    if strange := sorted(held_out - set(names)):
        raise ExemplarError(f"--hold-out: there is no readable photograph {strange[0]} in the folder")
    if len(names) - len(held_out) < 2:
        raise ExemplarError(f"{len(names)} photographs, {len(held_out)} of them held out; expected at least 2 to train on")
    return held_out


def mean_covariance(members: Sequence[Member]) -> Tensor:
    """The mean covariance [3, 3] of the members' colours, each at a contrast of one: the axes that they have in common."""
    covariances = []
    for member in members:
        covariance = torch.cov(torch.from_numpy(member.exemplar).reshape(-1, 3).T.double())
        covariances.append(covariance * 3 / covariance.trace().clamp(min=1e-9))
    return torch.stack(covariances).mean(0)


def wraps(exemplar: FloatArray) -> tuple[bool, bool]:
    """Whether an image [H, W, 3] continues across its lower and its right edge: the step there is like any other.

    Opposite edges of a frame are alike, and what is inside does not continue.
    """
    if edge_step(exemplar) > FRAMED:
        return False, False
    return (_continues(exemplar), _continues(exemplar.swapaxes(0, 1)))


def _continues(rows: npt.NDArray[Any]) -> bool:
    across = np.abs(rows[0] - rows[-1]).mean()
    within = np.abs(np.diff(rows, axis=0)).mean()
    return bool(across <= WRAPS * max(float(within), 1 / 255))
