"""Texture spaces: any photograph to a texture in one pass, and what lies between two of them (GramGAN Sec. 3.2)."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.arguments import Numbers, Vector
from solidgrain.runtime.blend_file import BlendData, blend_of
from solidgrain.runtime.bundle import ENCODER, MAPPING, Bundle, bundle_folder, open_again, open_bundle
from solidgrain.runtime.errors import BundleError, ExemplarError
from solidgrain.runtime.mask import Mask, make_mask, make_ramp
from solidgrain.runtime.provider import open_session
from solidgrain.runtime.texture import Texture, make_workers, open_texture
from solidgrain.runtime.texture_file import TextureData
from solidgrain.runtime.workers import Workers

if TYPE_CHECKING:
    import onnxruntime

DEFAULT_SPACE = "stone"
KNOTS = 16  # pieces of the line between two codes in which a blend's style is linear

FloatArray = npt.NDArray[np.float32]


def load_space(
    source: str | os.PathLike[str] = DEFAULT_SPACE,
    *,
    provider: str = "auto",
    precision: str = "float32",
    threads: int = 0,
) -> Space:
    """Load a space by embedded name or from a bundle folder.

    `provider`, `precision` and `threads` are those of its textures, as in `load_texture`; the encoder runs on the CPU. Raises
    BundleError, also for a bundle without an encoder, or ProviderError.
    """
    owner = open_bundle(bundle_folder(os.fspath(source)))
    if not owner.is_space:
        raise BundleError(f"{source}: holds one texture and no encoder; expected a space, made from solidgrain train --space")
    space = Space(owner, provider, precision, make_workers(threads))
    space.texture(np.zeros(owner.manifest["latent"]))  # what cannot be had is an error now, not with the first photograph
    return space


def _opened_again(sampler_sha256: str, folder: Path, provider: str, precision: str, threads: int) -> Space:
    """What a copy of a space begins as, in this process or in another one."""
    return Space(open_again(sampler_sha256, folder), provider, precision, make_workers(threads))


class Space:
    """A space of textures: an encoder, a mapping and the sampler that all of its textures share. Made by `load`."""

    def __init__(self, bundle: Bundle, provider: str, precision: str, workers: Workers) -> None:
        self.bundle, self._provider, self._precision, self.workers = bundle, provider, precision, workers
        self._encoder = _graph(bundle, ENCODER, ["exemplar"], ["z"])
        if self._encoder.get_inputs()[0].shape[1:] != [3, self.patch, self.patch]:
            seen = self._encoder.get_inputs()[0].shape
            raise BundleError(
                f"{bundle.folder / ENCODER}: takes {seen}, the manifest says {self.patch}² pixels; export it again"
            )
        self._mapping = _graph(bundle, MAPPING, ["z"], ["transforms", "gamma", "delta", "noise_weights"])

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled, it is its bundle by the folder, as a texture's is."""
        asked = (self._provider, self._precision, self.workers.asked)
        return _opened_again, (self.bundle.sampler_sha256, self.bundle.folder, *asked)

    @property
    def name(self) -> str:
        return self.bundle.name

    @property
    def patch(self) -> int:
        """Pixels along each side of the patch that the encoder sees."""
        return int(self.bundle.manifest["encoded_patch"])

    def encode(self, exemplar: npt.ArrayLike, name: str = "encoded", scale: float = 1.0) -> Texture:
        """The texture of a photograph [H, W, 3], float in [0, 1] or uint8, sRGB-encoded. Raises ExemplarError.

        The encoder sees the `patch`² pixels at its middle: a picture that shows more at a smaller scale must be scaled down
        first, and the texture's pixels are then the smaller picture's. `scale` is by how much it was: the texture remembers
        it, for whoever compares it with the photograph.
        """
        if not isinstance(scale, int | float | np.number) or not 0 < scale < math.inf:
            raise ExemplarError(f"scale {scale!r}: expected a number above 0")
        return self.open(replace(self.mapped(self.code(exemplar), name), scale=float(scale)))

    def code(self, exemplar: npt.ArrayLike) -> FloatArray:
        """z [latent] of a photograph, as in `encode`."""
        pixels = _pixels(exemplar, self.patch)
        top, left = ((extent - self.patch) // 2 for extent in pixels.shape[:2])
        patch = pixels[top : top + self.patch, left : left + self.patch].transpose(2, 0, 1)
        z: FloatArray = self._encoder.run(["z"], {"exemplar": np.ascontiguousarray(patch[None])})[0][0]
        return z

    def texture(self, z: npt.ArrayLike, name: str = "latent") -> Texture:
        """The texture of a latent code z [latent]. Raises BundleError for a code of another length."""
        return self.open(self.mapped(z, name))

    def mapped(self, z: npt.ArrayLike | None, name: str = "latent") -> TextureData:
        """What the texture of a latent code z [latent] owns. Raises BundleError for a code of another length."""
        code = np.asarray(z, np.float32)
        if code.shape != (self.bundle.manifest["latent"],) or not np.isfinite(code).all():
            raise BundleError(
                f"{self.bundle.folder}: a latent code of shape {code.shape}, expected {self.bundle.manifest['latent']} "
                "finite numbers"
            )
        names = ["transforms", "gamma", "delta", "noise_weights"]
        transforms, gamma, delta, noise_weights = (part[0] for part in self._mapping.run(names, {"z": code[None]}))
        sampler = self.bundle.sampler_sha256
        return TextureData(name, sampler, transforms.astype(np.float64), gamma, delta, noise_weights, code)

    def blend(self, first: Texture, second: Texture, at: float, name: str = "") -> Texture:
        """The texture between two of this space, linear in z (Sec. 3.2): the first at 0, the second at 1.

        Textures that were adapted (Sec. 3.3) have left what the mapping says of their z. Their distance from it is blended
        linearly too, so that both ends are the textures themselves. Outside [0, 1] it extrapolates. Raises BundleError for
        textures of another bundle, or without a latent code.
        """
        return self.open(self._between(self.own(first), self.own(second), at, name))

    def blend_along(
        self, first: Texture, second: Texture, axis: str = "x", start: float = 0.0, stop: float = 128.0, name: str = ""
    ) -> Texture:
        """A texture that is the first up to `start` along an axis and the second from `stop` on, in exemplar pixels.

        Raises EvaluationError for another axis or for one place twice, BundleError as `blend` does.
        """
        return self._in_space(first, second, make_ramp(axis, start, stop), name)

    def blend_by(
        self,
        first: Texture,
        second: Texture,
        mask: npt.ArrayLike,
        origin: Numbers = (0.0, 0.0, 0.0),
        spacing: float | Numbers = 1.0,
        name: str = "",
    ) -> Texture:
        """A texture that is the first where a mask [z, y, x] is 0, the second where it is 1, and between them in between.

        The mask holds floats from 0 to 1, booleans, or uint8 or uint16, of which the largest value is 1. Its voxel k is at
        origin + (k + 0.5) spacing (x, y, z), in exemplar pixels; it is read trilinearly, and goes on outside as it is at its
        faces. Raises EvaluationError for what is no mask, BundleError as `blend` does.
        """
        return self._in_space(first, second, make_mask(mask, _triple(origin), _triple(spacing)), name)

    def open(self, data: TextureData | BlendData) -> Texture:
        """A texture of this space, ready to be evaluated. Raises BundleError if it is not of this space."""
        return open_texture(data, self.bundle, self._provider, self._precision, self.workers)

    def own(self, texture: Texture) -> TextureData:
        """What a texture of this space owns, which lies at one place of it. Raises BundleError for one that does not."""
        return self.owned(texture.data)

    def owned(self, data: TextureData | BlendData) -> TextureData:
        """The same of data that may be of any bundle."""
        if data.sampler_sha256 != self.bundle.sampler_sha256:
            raise BundleError(
                f"texture {data.name!r} is of the bundle whose sampler.onnx has sha256 {data.sampler_sha256[:12]}…, "
                f"space {self.name!r} has {self.bundle.sampler_sha256[:12]}…; only textures of one space can be blended"
            )
        if isinstance(data, BlendData):
            raise BundleError(f"texture {data.name!r} is a blend in space; expected a texture that is one everywhere")
        if data.latent is None:
            raise BundleError(f"texture {data.name!r} has no latent code; expected one made by encode, adapt or blend")
        return data

    def _in_space(self, first: Texture, second: Texture, mask: Mask, name: str) -> Texture:
        """Both textures on one noise: the noise is mixed, and styles follow the line between both codes (`blend.onnx`)."""
        ends = self.own(first), self.own(second)
        knots = [self._between(*ends, k / KNOTS) for k in range(KNOTS + 1)]
        return self.open(blend_of(name or f"{first.name}-{second.name}", knots, mask))

    def _between(self, first: TextureData, second: TextureData, at: float, name: str = "") -> TextureData:
        ends = (first, second)
        if at in (0, 1):
            return replace(ends[int(at)], name=name or ends[int(at)].name)
        mapped = [self.mapped(data.latent, "") for data in ends]
        z = (1 - at) * np.asarray(first.latent) + at * np.asarray(second.latent)
        between = self.mapped(z, name or f"{first.name}-{second.name}")
        arrays = {}
        for key, value in between.arrays().items():
            left = [end.arrays()[key] - of_code.arrays()[key] for end, of_code in zip(ends, mapped, strict=True)]
            arrays[key] = (value + (1 - at) * left[0] + at * left[1]).astype(value.dtype)
        return replace(between, **arrays, scale=first.scale ** (1 - at) * second.scale**at)


def _graph(bundle: Bundle, name: str, inputs: list[str], outputs: list[str]) -> onnxruntime.InferenceSession:
    """One of the space's graphs. Raises BundleError if it is not what its name says."""
    session = open_session(bundle.folder / name, "cpu")
    found = [[node.name for node in nodes] for nodes in (session.get_inputs(), session.get_outputs())]
    if found != [inputs, outputs]:
        raise BundleError(f"{bundle.folder / name}: takes {found[0]} and gives {found[1]}, expected {inputs} and {outputs}")
    return session


def _pixels(exemplar: npt.ArrayLike, smallest: int) -> FloatArray:
    """A photograph as float32 in [0, 1]. Raises ExemplarError if it is none, or too small."""
    array = np.asarray(exemplar)
    if array.ndim != 3 or array.shape[2] != 3:
        raise ExemplarError(f"exemplar of shape {array.shape}, expected [H, W, 3]")
    if min(array.shape[:2]) < smallest:
        raise ExemplarError(
            f"exemplar of {array.shape[1]}x{array.shape[0]} pixels, expected at least {smallest}x{smallest}, "
            "which the encoder sees"
        )
    if array.dtype == np.uint8:
        return array.astype(np.float32) / np.float32(255)
    pixels = array.astype(np.float32) if array.dtype.kind == "f" else np.full(1, np.nan, np.float32)
    if not (pixels.min() >= 0 and pixels.max() <= 1):
        raise ExemplarError(f"exemplar of {array.dtype}, expected uint8, or floats from 0 to 1")
    return pixels


def _triple(values: float | Numbers) -> Vector:
    """Three numbers (x, y, z), or one for all of them; NaN for what is neither."""
    try:
        x, y, z = np.broadcast_to(np.asarray(values, np.float64), 3).tolist()
    except (TypeError, ValueError):
        x = y = z = np.nan
    return (x, y, z)
