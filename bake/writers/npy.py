"""`.npy`: the array that `Texture.grid` returns, [z, y, x, 3] float32, sRGB-encoded (NEP 1)."""

from __future__ import annotations

import numpy as np

from solidgrain.bake.writers.base import FileWriter, FloatArray, Output, Volume
from solidgrain.runtime.workers import Workers


class NpyFile(FileWriter):
    """Header first, then the slabs as they come."""

    def __init__(self, output: Output, volume: Volume, workers: Workers) -> None:
        super().__init__(output, volume, workers)
        header = {"descr": "<f4", "fortran_order": False, "shape": (*volume.shape, 3)}
        np.lib.format.write_array_header_1_0(self.file, header)

    def write(self, z: int, slab: FloatArray) -> None:
        self.file.write(np.ascontiguousarray(slab, "<f4").data)


def size(output: Output, volume: Volume) -> int:
    return 128 + volume.voxels * 12
