"""What a training looks like: the exemplar, an axis-aligned slice and an oblique one, side by side."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch

from solidgrain.runtime.errors import TrainingError
from solidgrain.runtime.files import temporary_name
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.noise import draw_tables
from solidgrain.train.sampler import Octaves
from solidgrain.train.settings import Settings
from solidgrain.train.slices import flat_slice, from_quaternions

SIZE = 256  # pixels along each side of a slice


@torch.no_grad()
def render_slices(sampler: Octaves, settings: Settings, device: torch.device) -> FloatArray:
    """Two slices of the same instance, [SIZE, 2 SIZE, 3] in [0, 1]: z = 0, and an oblique plane.

    The noise is the same every time, so that a folder of samples shows the training and nothing else.
    """
    generator = torch.Generator(device).manual_seed(7)
    tables = draw_tables(settings.octaves, settings.resolution, generator)
    oblique = from_quaternions(torch.tensor([[0.5, 0.1, 0.7, 0.5]], device=device))[0]
    flat = flat_slice(SIZE, device)
    slices = [sampler(tables, points[None]).reshape(SIZE, SIZE, 3) for points in (flat, flat @ oblique.T)]
    image: FloatArray = torch.cat(slices, 1).clamp(0, 1).cpu().numpy()
    return image


def write_preview(path: Path, sampler: Octaves, settings: Settings, exemplar: FloatArray, device: torch.device) -> None:
    """The exemplar's middle (or all of it, repeated never, padded with black) and the two slices, as an 8-bit PNG."""
    panel = np.zeros((SIZE, SIZE, 3), np.float32)
    top, left = (max(extent - SIZE, 0) // 2 for extent in exemplar.shape[:2])
    crop = exemplar[top : top + SIZE, left : left + SIZE]
    panel[: crop.shape[0], : crop.shape[1]] = crop
    _write_png(path, np.concatenate([panel, render_slices(sampler, settings, device)], axis=1))


def _write_png(path: Path, image: FloatArray) -> None:
    import OpenImageIO as oiio

    temporary = temporary_name(path)
    buffer = oiio.ImageBuf(np.ascontiguousarray(image))
    written = buffer.write(os.fspath(temporary), oiio.UINT8)
    reader = oiio.ImageInput.open(os.fspath(temporary)) if written else None
    if reader is None or reader.read_image(oiio.UINT8) is None:  # only reading it back shows that the disk was full
        temporary.unlink(missing_ok=True)
        raise TrainingError(f"{path}: cannot write the sample; make space and go on with --resume")
    os.replace(temporary, path)
