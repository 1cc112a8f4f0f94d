"""The exemplar: measuring it, and cutting patches from it."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from solidgrain.train.settings import Settings

FloatArray = npt.NDArray[np.float32]

CORRELATED = 2048  # pixels along each side, of which the autocorrelation is taken
NONSTATIONARY = 0.3  # above it, one texture cannot describe the image (docs/training.md)
INWARDS = 10  # steps that an edge's own is held against
FRAMED = 3.0  # `edge_step` above which an image has a frame: photographs of stones without one come to 2.5 at most
OFF = 3  # pixels by which cropping may have moved the middle about which an image was mirrored
ELSEWHERE = (16, 128)  # likewise: other places, which what repeats itself is symmetric about, too
MIRRORED = 0.1  # `mirror_symmetry` above which an image was mirrored to tile (docs/training.md)


def draw_patches(exemplar: Tensor, settings: Settings, generator: torch.Generator) -> Tensor:
    """Random crops of the exemplar [3, H, W], each flipped by chance unless it must stay upright: [B, 3, patch, patch].

    An isotropic material looks the same turned by 90°, so its crops are also transposed by chance.
    """
    size, patches = settings.patch, []
    for _ in range(settings.batch):
        top, left = (uniform_below(extent - size + 1, generator) for extent in exemplar.shape[1:])
        patches.append(flip_by_chance(exemplar[:, top : top + size, left : left + size], settings, generator))
    return torch.stack(patches).contiguous(memory_format=torch.channels_last)


def flip_by_chance(crop: Tensor, settings: Settings, generator: torch.Generator) -> Tensor:
    """A crop [3, H, W], mirrored along each axis by chance, and transposed where the material has no grain.

    Of what must stay upright, as it is.
    """
    if settings.upright:
        return crop
    crop = crop.flip([axis for axis in (1, 2) if uniform_below(2, generator)])
    transposed = settings.transposed and settings.grain == "none" and uniform_below(2, generator)
    return crop.transpose(1, 2) if transposed else crop


def uniform_below(bound: int, generator: torch.Generator) -> int:
    return int(torch.randint(bound, (), generator=generator, device=generator.device))


def nonstationarity(exemplar: FloatArray) -> float:
    """How much the exemplar changes across itself: the deviation of its 4x4 block means over that of its pixels."""
    grey = exemplar.mean(-1)
    rows, columns = (extent // 4 * 4 for extent in grey.shape)
    blocks = grey[:rows, :columns].reshape(4, rows // 4, 4, columns // 4)
    return float(blocks.mean((1, 3)).std() / max(float(grey.std()), 1e-6))


def edge_step(exemplar: FloatArray) -> float:
    """The largest step between neighbouring rows or columns near an edge, over the largest of the steps that follow inwards.

    Frames, and the rims that resizing leaves, have a step that nothing beside it comes near.
    """
    largest = 0.0
    for axis in (0, 1):
        steps = np.abs(np.diff(exemplar, axis=axis)).mean((1 - axis, 2))
        near = exemplar.shape[axis] // 32 + 1
        for ordered in (steps, steps[::-1]):
            following = np.lib.stride_tricks.sliding_window_view(ordered[1:], INWARDS).max(1)[:near]
            largest = max(largest, float((ordered[:near] / np.maximum(following, 1e-3)).max()))
    return largest


def mirror_symmetry(exemplar: FloatArray) -> float:
    """How nearly the exemplar is its own mirror image about one of its middles, up to 1 where it was mirrored to tile."""
    return max(_symmetry(exemplar, axis) for axis in (0, 1))


def unfolded(exemplar: FloatArray, smallest: int) -> FloatArray:
    """One side of an exemplar that was mirrored about its middle, of at least so many pixels; else all of it.

    About both middles it is one corner, and of a side that was mirrored once more one side again.
    """
    for axis in (0, 1):
        while (side := (exemplar.shape[axis] - OFF) // 2) >= smallest and _symmetry(exemplar, axis) > MIRRORED:
            exemplar = exemplar.take(range(side), axis)
    return exemplar


def _symmetry(exemplar: FloatArray, axis: int) -> float:
    """How alike rows of steps along an axis are on both sides of the middle, beyond how alike they are about other places.

    Steps are compared backwards; each row counts as much as any other, or the two ends of a frame would decide. What repeats
    itself is its own mirror image about many places.
    """
    steps = np.diff(np.moveaxis(middle(exemplar, CORRELATED).mean(-1), axis, 0), axis=0)
    steps /= np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-4)
    alike, count = -np.fliplr(steps @ steps.T), len(steps)

    def about(off: int) -> float:
        return float(alike.trace(off)) / (count - abs(off))

    nearest, furthest = min(ELSEWHERE[0], count // 4), min(ELSEWHERE[1], count // 2)
    elsewhere = max(about(sign * off) for off in range(nearest, furthest) for sign in (-1, 1))
    return max(map(about, range(-OFF, OFF + 1))) - elsewhere


def middle(exemplar: FloatArray, largest: int) -> FloatArray:
    """What is in the middle of an exemplar [H, W, 3], of so many pixels along each side at most."""
    top, left = (max(0, extent - largest) // 2 for extent in exemplar.shape[:2])
    return exemplar[top : top + largest, left : left + largest]


class Grain(NamedTuple):
    axis: Literal["x", "y"]  # the image axis along which structures are longer
    ratio: float  # their length across it over their length along it, at most 1


def measure_grain(exemplar: FloatArray) -> Grain:
    """The exemplar's grain, from the distances at which the autocorrelation of its middle falls to one half."""
    grey = middle(exemplar, CORRELATED).mean(-1)
    grey = grey - grey.mean()
    spectrum = np.fft.rfft2(grey, s=[2 * extent for extent in grey.shape])  # zero-padded: no wrap-around
    correlation = np.fft.irfft2(np.abs(spectrum) ** 2)
    along_x = _half_length(correlation[0, : grey.shape[1]])
    along_y = _half_length(correlation[: grey.shape[0], 0])
    ratio = max(min(along_x, along_y) / max(along_x, along_y), 0.05)
    return Grain("x" if along_x >= along_y else "y", ratio)


def _half_length(correlation: npt.NDArray[np.float64]) -> float:
    """The lag at which a correlation first falls below half its value at lag 0, between samples."""
    below = np.flatnonzero(correlation < 0.5 * correlation[0])
    if len(below) == 0:
        return float(len(correlation))
    lag = int(below[0])
    before, after = correlation[lag - 1], correlation[lag]
    return float(lag - 1 + (before - 0.5 * correlation[0]) / (before - after))
