"""Slices of a finished texture, for measuring and for looking at: squares of any orientation, through `sample` alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from solidgrain.train.exemplar import FloatArray
from solidgrain.train.slices import UNIT, about_axis, flat_slice, from_quaternions, upright

Sample = Callable[[npt.NDArray[np.float64], int], FloatArray]  # points [P, 3] in exemplar pixels, seed -> rgb [P, 3]
RotationOf = Callable[[int, torch.Generator], Tensor]  # seed, its random stream -> [3, 3]
REACH = 2048  # pixels: slices are taken at random places up to here


def cut(sample: Sample, size: int, rotation: Tensor, seed: int, place: Tensor) -> FloatArray:
    """A slice of size x size points through the instance `seed`, [size, size, 3], rows of the image first.

    rotation [3, 3] turns the plane z = 0 about the slice's first point, which lies at `place` [3] (x, y, z). All in exemplar
    pixels.
    """
    flat = (flat_slice(size, torch.device("cpu")) * UNIT).double()
    points = flat @ rotation.double().T + place.double()
    return sample(points.numpy(), seed).reshape(size, size, 3)


def take_slices(sample: Sample, size: int, count: int, rotation_of: RotationOf) -> Iterator[FloatArray]:
    """Slices [size, size, 3] of so many instances, at random places, rotated as each one's seed and random stream say."""
    for seed in range(count):
        generator = torch.Generator().manual_seed(seed)
        rotation = rotation_of(seed, generator)
        yield cut(sample, size, rotation, seed, random_place(generator))


def random_place(generator: torch.Generator) -> Tensor:
    return REACH * torch.rand(3, generator=generator, dtype=torch.float64)


def axis_rotation(number: int, grain: str) -> Tensor:
    """Planes along the axes, in turn: all three of them, or the two that hold the grain's axis."""
    planes = upright(grain, torch.device("cpu"))
    return planes[number % len(planes)]


def oblique_rotation(generator: torch.Generator, grain: str) -> Tensor:
    """Any orientation, or any about the grain's axis."""
    if grain != "none":
        return about_axis("xyz".index(grain), 2 * torch.pi * torch.rand(1, generator=generator))[0]
    return from_quaternions(F.normalize(torch.randn(1, 4, generator=generator), dim=1))[0]


def as_image(pixels: FloatArray) -> Tensor:
    """[H, W, 3] -> [1, 3, H, W]."""
    return torch.from_numpy(pixels).permute(2, 0, 1)[None]
