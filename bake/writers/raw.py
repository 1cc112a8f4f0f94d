"""`.raw`: the voxels and nothing else, [z, y, x, 3] in C order, little-endian; `NAME.raw.json` beside it says what they are.

volume = np.fromfile("a.raw", header["dtype"]).reshape(*header["shape"], header["channels"])
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from solidgrain.bake.store import Bytes, Encoded, Finished, Store
from solidgrain.bake.writers.base import FloatArray, Option, Output, SequenceWriter, Volume, data
from solidgrain.runtime.files import replacing

TYPES = {"uint8": "u1", "uint16": "<u2", "half": "<f2", "float": "<f4"}
OPTIONS = (Option("type", "uint8", "of the colours", tuple(TYPES)),)
VERSION = 1  # of the JSON file


class RawFile(SequenceWriter):
    """The slabs as they come, and a second file that describes them."""

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(TYPES[str(self.output.options["type"])])

    def encode(self, z: int, slab: FloatArray) -> Encoded:
        def convert(k: int) -> Bytes:
            return self.stored(slab[k : k + 1], z + k, self.dtype).data

        return data(*self.workers.map(convert, len(slab)))

    def assemble(self, store: Store) -> list[Finished]:
        return [*super().assemble(store), write_sidecar(store, self._values(), sidecar_path(self.output))]

    def _values(self) -> dict[str, Any]:
        return {
            "format": "solidgrain raw volume",
            "version": VERSION,
            "shape": self.volume.shape,
            "channels": 3,
            "dtype": self.dtype.name,
            "byte_order": "little",
            "order": "zyxc, C order: x is the fastest axis but for the channels r, g, b",
            **provenance(self.output, self.volume),
        }

    def probe(self, voxels: npt.NDArray[np.int64]) -> tuple[FloatArray, float]:
        stored = np.memmap(self.output.path, self.dtype, "r", shape=(*self.volume.shape, 3))
        x, y, z = voxels.T
        return self.read_back(stored[z, y, x])


def provenance(output: Output, volume: Volume) -> dict[str, Any]:
    """What a JSON file beside a volume says of its colours, its place and its origin. Vectors are (x, y, z)."""
    return {
        "colorspace": output.colorspace,
        "origin": volume.origin,
        "spacing": volume.spacing,
        "axes": volume.axes,
        "transform": volume.transform,
        "tile": volume.tile,
        "level": volume.level,
        "texture": volume.texture,
        "seed": volume.seed,
        "model": volume.sampler_sha256,
    }


def write_sidecar(store: Store, values: dict[str, Any], final: Path) -> Finished:
    """The JSON file beside a volume."""
    staged = store.folder / "sidecar.json"
    with replacing(staged) as file:
        file.write(json.dumps(values, indent=1).encode() + b"\n")
    return Finished(staged, final)


def sidecar_path(output: Output) -> Path:
    """`a.raw` -> `a.raw.json`."""
    return output.path.with_name(f"{output.path.name}.json")


def files(output: Output, volume: Volume) -> list[Path]:
    return [output.path, sidecar_path(output)]


def size(output: Output, volume: Volume) -> int:
    return volume.voxels * 3 * np.dtype(TYPES[str(output.options["type"])]).itemsize + 4096
