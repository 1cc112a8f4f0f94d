"""What a training looks like: the exemplar, an axis-aligned slice and an oblique one, side by side."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from solidgrain.bake.color import quantize
from solidgrain.runtime.errors import TrainingError
from solidgrain.runtime.files import replacing
from solidgrain.train.exemplar import FloatArray, middle
from solidgrain.train.noise import draw_noise
from solidgrain.train.settings import Settings
from solidgrain.train.slices import flat_slice, planes_seen

Model = Callable[..., Tensor]  # noise, points and what else it needs -> colours
Pixels = npt.NDArray[np.uint8]  # [H, W, 3]

SIZE = 256  # pixels along each side of a slice


@torch.no_grad()
def render_slices(model: Model, settings: Settings, device: torch.device, *conditions: Tensor) -> FloatArray:
    """Two slices of the same instance, [SIZE, 2 SIZE, 3] in [0, 1]: z = 0, and an oblique plane, or one about the grain.

    The noise is the same every time, so that a folder of samples shows the training and nothing else.
    """
    generator = torch.Generator(device).manual_seed(7)
    noise = draw_noise(settings.octaves, settings.resolution, generator)
    oblique = planes_seen(settings).example().to(device)
    flat = flat_slice(SIZE, device)
    slices = [model(noise, points[None], *conditions).reshape(SIZE, SIZE, 3) for points in (flat, flat @ oblique.T)]
    image: FloatArray = torch.cat(slices, 1).clamp(0, 1).cpu().numpy()
    return image


def write_preview(
    path: Path,
    model: Model,
    settings: Settings,
    shown: Sequence[tuple[Tensor, tuple[Tensor, ...]]],
    device: torch.device,
) -> None:
    """A row for each exemplar that is shown, as an 8-bit PNG: its middle, padded with black, and its two slices."""
    rows = []
    for exemplar, conditions in shown:
        pixels, panel = exemplar.permute(1, 2, 0).cpu().numpy(), np.zeros((SIZE, SIZE, 3), np.float32)
        crop = middle(pixels, SIZE)
        panel[: crop.shape[0], : crop.shape[1]] = crop
        rows.append(np.concatenate([panel, render_slices(model, settings, device, *conditions)], axis=1))
    _write_png(path, np.concatenate(rows))


def _write_png(path: Path, image: FloatArray) -> None:
    pixels = quantize(image, np.uint8).astype(np.uint8, copy=False)
    try:
        path.parent.mkdir(exist_ok=True)
        with replacing(path) as file:
            file.write(as_png(pixels))
    except OSError as error:
        raise TrainingError(
            f"{path}: cannot write the sample ({error.strerror}); see that it can be, and go on with --resume"
        ) from error


def as_png(pixels: Pixels) -> bytes:
    """An 8-bit RGB image as the bytes of a PNG file (PNG specification, third edition), the same ones every time."""
    height, width = pixels.shape[:2]
    lines = np.zeros((height, 1 + 3 * width), np.uint8)  # each line begins with its filter: 0, none
    lines[:, 1:] = pixels.reshape(height, -1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"sRGB", b"\0"), (b"IDAT", zlib.compress(lines.tobytes(), 9)), (b"IEND", b""))
    framed = [struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(framed)
