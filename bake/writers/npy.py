"""`.npy`: the array that `Texture.grid` returns, [z, y, x, 3] float32, sRGB-encoded (NEP 1)."""

from __future__ import annotations

import io

import numpy as np
import numpy.typing as npt

from solidgrain.bake.store import Encoded, Store
from solidgrain.bake.writers.base import FloatArray, Output, SequenceWriter, Volume, data


class NpyFile(SequenceWriter):
    """Header first, then the slabs as they come."""

    @property
    def reserved(self) -> int:
        return len(_header(self.volume))

    def header(self, store: Store) -> bytes:
        return _header(self.volume)

    def probe(self, voxels: npt.NDArray[np.int64]) -> tuple[FloatArray, float]:
        array = np.load(self.output.path, mmap_mode="r")
        return array[voxels[:, 2], voxels[:, 1], voxels[:, 0]], 1e-6

    def encode(self, z: int, slab: FloatArray) -> Encoded:
        return data(np.ascontiguousarray(self.colors(slab), "<f4").data)


def _header(volume: Volume) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": (*volume.shape, 3)})
    return file.getvalue()


def size(output: Output, volume: Volume) -> int:
    return 128 + volume.voxels * 12
