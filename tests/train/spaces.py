"""What the tests of texture spaces share: photographs made by code, and settings for which a step takes no time."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from solidgrain.train.collection import Member, read_members
from solidgrain.train.run import Source
from solidgrain.train.settings import Budget, preset
from solidgrain.train.space_run import SpaceRun, create_space_run

TINY_SPACE = {
    "octaves": 4,
    "width": 16,
    "resolution": 16,
    "latent": 8,
    "patch": 32,
    "batch": 2,
    "checkpoint_every": 4,
    "sample_every": 1000,
    "report_every": 1,
    "precision": "float32",
    "critic_start": "",
    "sampler_start": "",
}
SIZES = ((130, 150), (200, 128), (160, 160), (129, 171))


def picture(height: int, width: int, seed: int, tiles: tuple[bool, bool] = (True, True)) -> np.ndarray:
    """Smooth coloured clouds [height, width, 3] in [0, 1], which continue across the edges that `tiles` says (down, across)."""
    shape = [extent if continues else 2 * extent for extent, continues in zip((height, width), tiles, strict=True)]
    noise = np.random.default_rng(seed).normal(size=(*shape, 3))
    down, across = np.fft.fftfreq(shape[0]), np.fft.rfftfreq(shape[1])
    smooth = np.exp(-2 * (np.pi * 4) ** 2 * (down[:, None] ** 2 + across**2))[..., None]  # a Gaussian of 4 pixels
    clouds = np.fft.irfft2(np.fft.rfft2(noise, axes=(0, 1)) * smooth, s=shape, axes=(0, 1))[:height, :width]
    return np.ascontiguousarray((clouds - clouds.min()) / np.ptp(clouds), np.float32)


def write(path: Path, pixels: np.ndarray, kind: int = oiio.UINT8) -> Path:
    assert oiio.ImageBuf(np.ascontiguousarray(pixels, np.float32)).write(os.fspath(path), kind)
    return path


def photographs(folder: Path, count: int = 4) -> Path:
    """A folder with so many photographs, each of another size."""
    folder.mkdir(parents=True)
    for number, size in enumerate(SIZES[:count]):
        write(folder / f"stone{number}.png", picture(*size, number))
    return folder


def numbered(number: int, height: int, width: int, wraps: tuple[bool, bool] = (False, False)) -> Member:
    """A member whose every pixel says where it is: row, column, number."""
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([rows, columns, np.full_like(rows, number)], -1).astype(np.uint16)
    return Member(f"{number}.png", pixels, wraps)


def new_space(folder: Path, members=4, held_out=0, **changes) -> SpaceRun:
    """A run of a tiny space, from numbered members if so many are asked for, or from what a folder holds."""
    settings = preset("fast space", **{**TINY_SPACE, **changes})
    if isinstance(members, Path):
        members = read_members(members, settings.encoded_patch, False, print)
    elif isinstance(members, int):
        members = [numbered(number, *SIZES[number % len(SIZES)]) for number in range(members)]
    return create_space_run(folder, settings, members, held_out, Source("", "CC0-1.0", "nobody"), Budget())
