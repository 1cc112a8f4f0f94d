"""Texture files, `*.sgt.npz`: everything that the sampler needs besides its shared weights, about 25 KB.

A NumPy archive: `transforms` [n, 3, 3] float64 in texels per exemplar pixel, `gamma` and
`delta` [hidden layers, width], `noise_weights` [4, n/4, width] float32, for textures of a space `latent` [latent] float32, and
`header`, a JSON object with the format version, a name, the sha256 of the sampler that the numbers belong to, and, where it is
not 1, the scale at which a photograph was encoded. Equal textures give equal bytes.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
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
    scale: float = 1.0  # pixels of the encoded photograph for each of its own; no part of its colours either

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
        **({} if texture.scale == 1 else {"scale": texture.scale}),
    }
    latent = {} if texture.latent is None else {"latent": texture.latent}
    write_archive(path, header, {**texture.arrays(), **latent})


def read_texture(path: Path) -> TextureData:
    """Read a texture file. Raises BundleError if it is damaged, of another version, or holds values that are not finite."""
    header, arrays = read_archive(path, FORMAT, FORMAT_VERSION, ARRAYS, OPTIONAL)
    scale = header.get("scale", 1.0)
    if not (isinstance(scale, int | float) and 0 < scale < math.inf):
        raise BundleError(f"{path}: scale {scale!r} is no positive number; the file is damaged, save it again")
    return TextureData(str(header.get("name", "")), str(header.get("sampler_sha256", "")), **arrays, scale=float(scale))


def write_archive(path: Path, header: dict[str, Any], arrays: dict[str, npt.NDArray[Any]]) -> None:
    """Write a header and arrays as a NumPy archive, whole or not at all. Raises BundleError if it cannot be written."""
    try:
        write_arrays(path, {"header": np.array(json.dumps(header)), **arrays})
    except OSError as error:
        raise BundleError(f"{path}: cannot write the texture file ({error.strerror})") from error


def read_archive(
    path: Path,
    form: str,
    version: int,
    needed: Mapping[str, type],
    optional: Mapping[str, type] | None = None,
    others: Sequence[str] = (),
) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """The header and the arrays of a file of one format: `needed` and, if they are there, `optional` ones by their types, and
    `others`, which the caller checks. Raises BundleError as `read_texture` does.
    """
    types = {**needed, **(optional or {})}
    with _damaged(path), open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
        header = dict(json.loads(str(archive["header"])))
        if (header.get("format"), header.get("format_version")) == (form, version):
            names = [*needed, *others, *(name for name in optional or {} if name in archive.files)]
            arrays = {name: archive[name] for name in names}
        else:
            arrays = {}
    if not arrays:
        found = f"{header.get('format')} version {header.get('format_version')}"
        advice = "save it again or update solidgrain" if header.get("format") == form else "it is of another kind"
        raise BundleError(f"{path}: {found}, expected {form} version {version}; {advice}")
    for name, kind in types.items():
        if name in arrays and (arrays[name].dtype != kind or not np.isfinite(arrays[name]).all()):
            raise BundleError(f"{path}: {name} is not finite {np.dtype(kind)}; the file is damaged, save it again")
    return header, arrays


def format_of(path: Path) -> str:
    """The format that a texture file says it has. Raises BundleError if it is none, or damaged."""
    with _damaged(path), open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
        return str(dict(json.loads(str(archive["header"]))).get("format"))


@contextmanager
def _damaged(path: Path) -> Iterator[None]:
    """What NumPy and zipfile raise about a file that is no archive of ours, as one of our errors."""
    try:
        yield
    except OSError as error:
        raise BundleError(f"{path}: cannot read the texture file ({error})") from error
    except DAMAGED_ARCHIVE as error:
        raise BundleError(
            f"{path}: not a texture file, or a damaged one; save it again, or solidgrain encode a photograph"
        ) from error
