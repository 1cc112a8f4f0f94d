"""Slices of a finished texture, for measuring and for looking at: squares of any orientation, through `sample` alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from solidgrain.train.exemplar import FloatArray
from solidgrain.train.slices import UNIT, Planes, flat_slice

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


def axis_rotation(number: int, planes: Planes) -> Tensor:
    """Planes along the axes, in turn: all three of them, or the two that hold the grain's axis."""
    rotations = planes.along_axes()
    return rotations[number % len(rotations)]


def oblique_rotation(generator: torch.Generator, planes: Planes) -> Tensor:
    """Any of the planes."""
    return planes.turned(1, generator)[0]


def as_image(pixels: FloatArray) -> Tensor:
    """[H, W, 3] -> [1, 3, H, W]."""
    return torch.from_numpy(pixels).permute(2, 0, 1)[None]
