"""Texture files, `*.sgt.npz`: everything that the sampler needs besides its shared weights, about 25 KB.

A NumPy archive: `transforms` [n, 3, 3] float64 in texels per exemplar pixel, `gamma` and
`delta` [hidden layers, width], `noise_weights` [4, n/4, width] float32, for textures of a space `latent` [latent] float32, and
`header`, a JSON object with the format version, a name, and the sha256 of the sampler that the numbers belong to. Equal
textures give equal bytes.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.errors import BundleError
from solidgrain.runtime.files import DAMAGED_ARCHIVE, write_arrays

FORMAT, FORMAT_VERSION = "solidgrain-texture", 1


@dataclass(frozen=True)
class TextureData:
    """What a texture owns (design: "texture")."""

    name: str
    sampler_sha256: str
    transforms: npt.NDArray[np.float64]  # [n, 3, 3]
    gamma: npt.NDArray[np.float32]  # [hidden layers, m]
    delta: npt.NDArray[np.float32]  # [hidden layers, m]
    noise_weights: npt.NDArray[np.float32]  # [4, n/4, m]
    latent: npt.NDArray[np.float32] | None = None  # z, where in its space it lies; no part of its colours

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """What its colours depend on."""
        return {name: getattr(self, name) for name in ARRAYS}

    @property
    def sha256(self) -> str:
        """Of all values: two textures of one bundle differ in it."""
        digest = hashlib.sha256(self.sampler_sha256.encode())
        for array in self.arrays().values():
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


ARRAYS = {"transforms": np.float64, "gamma": np.float32, "delta": np.float32, "noise_weights": np.float32}
OPTIONAL = {"latent": np.float32}


def write_texture(path: Path, texture: TextureData) -> None:
    """Write a texture file, whole or not at all. Raises BundleError if it cannot be written."""
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "name": texture.name,
        "sampler_sha256": texture.sampler_sha256,
    }
    arrays = {"header": np.array(json.dumps(header)), **texture.arrays()}
    if texture.latent is not None:
        arrays["latent"] = texture.latent
    try:
        write_arrays(path, arrays)
    except OSError as error:
        raise BundleError(f"{path}: cannot write the texture file ({error.strerror})") from error


def read_texture(path: Path) -> TextureData:
    """Read a texture file. Raises BundleError if it is damaged, of another version, or holds values that are not finite."""
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            header = dict(json.loads(str(archive["header"])))
            arrays = {name: archive[name] for name in (*ARRAYS, *(set(OPTIONAL) & set(archive.files)))}
            name, sampler_sha256 = str(header.get("name", "")), str(header.get("sampler_sha256", ""))
    except OSError as error:
        raise BundleError(f"{path}: cannot read the texture file ({error})") from error
    except DAMAGED_ARCHIVE as error:
        raise BundleError(f"{path}: not a texture file, or damaged ({type(error).__name__}); save it again") from error
    if header.get("format") != FORMAT or header.get("format_version") != FORMAT_VERSION:
        found = f"{header.get('format')} version {header.get('format_version')}"
        raise BundleError(f"{path}: {found}, expected {FORMAT} version {FORMAT_VERSION}; save it again or update solidgrain")
    for key, dtype in (ARRAYS | OPTIONAL).items():
        if key not in arrays:
            continue
        if arrays[key].dtype != dtype or not np.isfinite(arrays[key]).all():
            raise BundleError(f"{path}: {key} is not finite {np.dtype(dtype)}; the file is damaged, save it again")
    return TextureData(name, sampler_sha256, **arrays)
