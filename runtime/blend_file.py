"""Blends in space, `*.sgt.npz` of another kind: a texture that is one of a space here and another one there.

A NumPy archive: `transforms` [2n, 3, 3] float64, the first texture's and then the second's; `noise_weights` [2, 4, n/4, width]
float32; `gamma` and `delta` [knots, hidden layers, width] float32, the styles at evenly spaced weights from the first texture's
own to the second's; `mask` [z, y, x] uint8, uint16 or float32, `origin` and `spacing` [3] float64, its place (x, y, z); and
`header`, a JSON object with the format version, a name, both textures' names, and the sha256 of the sampler that the numbers
belong to. Equal blends give equal bytes.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.errors import BundleError, EvaluationError
from solidgrain.runtime.mask import Mask, make_mask
from solidgrain.runtime.texture_file import TextureData, read_archive, write_archive

FORMAT, FORMAT_VERSION = "solidgrain-blend", 1
ARRAYS: dict[str, type] = {"transforms": np.float64, "gamma": np.float32, "delta": np.float32, "noise_weights": np.float32}
PLACE: dict[str, type] = {"origin": np.float64, "spacing": np.float64}


@dataclass(frozen=True)
class BlendData:
    """What a blend in space owns: to a bake or a script, a texture as any other."""

    name: str
    sampler_sha256: str
    names: tuple[str, str]  # of both textures
    transforms: npt.NDArray[np.float64]  # [2n, 3, 3]
    gamma: npt.NDArray[np.float32]  # [knots, hidden layers, m]
    delta: npt.NDArray[np.float32]  # [knots, hidden layers, m]
    noise_weights: npt.NDArray[np.float32]  # [2, 4, n/4, m]
    mask: Mask

    @property
    def latent(self) -> None:
        """It lies at no one place of its space."""
        return

    @property
    def ends(self) -> tuple[TextureData, TextureData]:
        """Both textures."""
        octaves = len(self.transforms) // 2
        first, second = (
            TextureData(name, self.sampler_sha256, transforms, self.gamma[k], self.delta[k], self.noise_weights[k])
            for name, transforms, k in zip(
                self.names, (self.transforms[:octaves], self.transforms[octaves:]), (0, -1), strict=True
            )
        )
        return first, second

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """What its colours depend on, besides the mask."""
        return {name: getattr(self, name) for name in ARRAYS}

    @cached_property
    def sha256(self) -> str:
        """Of all values, the mask's and its place's too."""
        digest = hashlib.sha256(f"{FORMAT} {self.sampler_sha256} {self.mask.sha256}".encode())
        for array in self.arrays().values():
            digest.update(f"{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


def blend_of(name: str, knots: list[TextureData], mask: Mask) -> BlendData:
    """The blend by a mask from the first to the last of textures that lie evenly along the line between them."""
    first, last = knots[0], knots[-1]
    return BlendData(
        name,
        first.sampler_sha256,
        (first.name, last.name),
        transforms=np.concatenate([first.transforms, last.transforms]),
        gamma=np.stack([knot.gamma for knot in knots]),
        delta=np.stack([knot.delta for knot in knots]),
        noise_weights=np.stack([first.noise_weights, last.noise_weights]),
        mask=mask,
    )


def write_blend(path: Path, blend: BlendData) -> None:
    """Write a blend's file, whole or not at all. Raises BundleError if it cannot be written."""
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "name": blend.name,
        "first": blend.names[0],
        "second": blend.names[1],
        "sampler_sha256": blend.sampler_sha256,
    }
    place = {"origin": np.array(blend.mask.origin), "spacing": np.array(blend.mask.spacing)}
    write_archive(path, header, {**blend.arrays(), "mask": blend.mask.values, **place})


def read_blend(path: Path) -> BlendData:
    """Read a blend's file. Raises BundleError if it is damaged, of another version, or holds values that make no sense."""
    header, arrays = read_archive(path, FORMAT, FORMAT_VERSION, ARRAYS | PLACE, others=("mask",))
    octaves = len(np.atleast_1d(arrays["transforms"])) // 2
    knots, layers, width = arrays["gamma"].shape if arrays["gamma"].ndim == 3 else (0, 0, 0)
    expected = {
        "transforms": (2 * octaves, 3, 3),
        "gamma": (max(knots, 2), layers, width),
        "delta": (max(knots, 2), layers, width),
        "noise_weights": (2, 4, octaves // 4, width),
        "origin": (3,),
        "spacing": (3,),
    }
    for key, shape in expected.items():
        if arrays[key].shape != shape:
            raise BundleError(
                f"{path}: {key} has shape {arrays[key].shape}, expected {shape}; the file is damaged, save it again"
            )
    try:
        arrays["mask"].flags.writeable = False
        mask = make_mask(arrays["mask"], tuple(arrays["origin"].tolist()), tuple(arrays["spacing"].tolist()))
    except EvaluationError as error:
        raise BundleError(f"{path}: {error}; the file is damaged, save it again") from error
    names = (str(header.get("first", "")), str(header.get("second", "")))
    values = {name: arrays[name] for name in ARRAYS}
    return BlendData(str(header.get("name", "")), str(header.get("sampler_sha256", "")), names, mask=mask, **values)
