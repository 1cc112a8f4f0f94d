"""The exemplar: reading a photograph, measuring it, and cutting patches from it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from solidgrain.runtime.errors import ExemplarError
from solidgrain.train.settings import Settings

if TYPE_CHECKING:
    import OpenImageIO as oiio

FloatArray = npt.NDArray[np.float32]

LARGEST = 64 * 2**20  # pixels; 768 MB as float32 RGB, far more than one texture can learn from
NONSTATIONARY = 0.3  # above it, one texture cannot describe the image (docs/training.md)


class Photograph(NamedTuple):
    """What was read of a file."""

    pixels: FloatArray  # sRGB-encoded, [H, W, 3] in [0, 1]
    colorspace: str  # what the file's colours were read as
    warning: str  # what the file declares of its colours that could not be honoured, or ""


def read_exemplar(path: str | os.PathLike[str], smallest: int) -> FloatArray:
    """The pixels of `read_photograph`."""
    return read_photograph(path, smallest).pixels


def read_photograph(path: str | os.PathLike[str], smallest: int) -> Photograph:
    """A photograph as sRGB-encoded RGB, [H, W, 3] float32 in [0, 1].

    Anything that OpenImageIO reads: 8 and 16 bit, float, grey (repeated), alpha (dropped), CMYK (converted by its reader).
    Colours of another space that the file declares (encoding.py) are converted to sRGB and clipped. Raises ExemplarError when
    the file is missing, unreadable, incomplete, smaller than `smallest` pixels along an axis or larger than `LARGEST` pixels.
    """
    import OpenImageIO as oiio

    from solidgrain.train.encoding import encode

    path = Path(path)
    if not path.is_file():
        raise ExemplarError(f"{path}: no such file; expected a photograph (PNG, JPEG, TIFF, EXR, ...)")
    if path.stat().st_size == 0:
        raise ExemplarError(f"{path}: the file is empty; expected a photograph (PNG, JPEG, TIFF, EXR, ...)")
    straight = oiio.ImageSpec()
    straight.attribute("oiio:UnassociatedAlpha", 1)  # colours as they are in the file, not multiplied by alpha
    opened = oiio.ImageInput.open(os.fspath(path), straight)
    if opened is None:
        raise ExemplarError(f"{path}: not readable as an image ({_first_line(oiio.geterror())})")
    try:
        spec = opened.spec()
        _check_size(path, spec, smallest)
        pixels = opened.read_image(oiio.FLOAT)
        error = opened.geterror()
    finally:
        opened.close()
    if pixels is None or error:
        raise ExemplarError(f"{path}: the image data is damaged or cut short ({_first_line(error)}); export it again")
    rgb = np.asarray(pixels, np.float32)[..., :3] if pixels.shape[-1] >= 3 else np.repeat(pixels[..., :1], 3, axis=-1)
    if not np.isfinite(rgb).all():
        raise ExemplarError(f"{path}: holds NaN or infinite pixels; expected finite colours")
    encoded = encode(rgb, spec)
    pixels = np.ascontiguousarray(encoded.rgb.clip(0.0, 1.0), np.float32)
    return Photograph(pixels, encoded.colorspace, encoded.warning)


def _check_size(path: Path, spec: oiio.ImageSpec, smallest: int) -> None:
    width, height = spec.width, spec.height
    if min(width, height) < smallest:
        raise ExemplarError(
            f"{path}: {width}x{height} pixels, expected at least {smallest}x{smallest} (one training patch); "
            "use a larger photograph or a smaller --patch"
        )
    if width * height > LARGEST:
        raise ExemplarError(f"{path}: {width}x{height} pixels, expected at most {LARGEST >> 20} megapixels; crop or resize it")


def draw_patches(exemplar: Tensor, settings: Settings, generator: torch.Generator) -> Tensor:
    """Random crops of the exemplar [3, H, W], each flipped left-right and up-down by chance: [B, 3, patch, patch].

    An isotropic material looks the same turned by 90°, so its crops are also transposed by chance.
    """
    size, patches = settings.patch, []
    for _ in range(settings.batch):
        top, left = (uniform_below(extent - size + 1, generator) for extent in exemplar.shape[1:])
        patches.append(flip_by_chance(exemplar[:, top : top + size, left : left + size], settings, generator))
    return torch.stack(patches).contiguous(memory_format=torch.channels_last)


def flip_by_chance(crop: Tensor, settings: Settings, generator: torch.Generator) -> Tensor:
    """A crop [3, H, W], mirrored along each axis by chance, and transposed where the material has no grain."""
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


class Grain(NamedTuple):
    axis: Literal["x", "y"]  # the image axis along which structures are longer
    ratio: float  # their length across it over their length along it, at most 1


def measure_grain(exemplar: FloatArray) -> Grain:
    """The exemplar's grain, from the distances at which its autocorrelation falls to one half."""
    grey = exemplar.mean(-1)
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


def _first_line(message: str) -> str:
    return message.strip().splitlines()[0] if message.strip() else "no further detail"
