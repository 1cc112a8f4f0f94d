"""`.exr`: a stack of half-float OpenEXR slices, one per z, linear Rec.709.

Row r of a file is y = r, its top row y = 0; column c is x = c; file number k (from `start`) is z = k - start. Written by the
OpenEXR package: scanline, ZIP. It writes no time stamps, so equal plans give equal bytes. Attributes: `colorInteropID` and
`chromaticities` say the encoding; `solidgrain:*` say which slice of which texture a file is.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from solidgrain.bake.color import to_linear
from solidgrain.bake.frames import frame_paths
from solidgrain.bake.writers.base import FloatArray, Output, Volume, Writer
from solidgrain.runtime.errors import BakeError
from solidgrain.runtime.files import sync, temporary_name
from solidgrain.runtime.workers import Workers

REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # xy of red, green, blue, white (ITU-R BT.709)


class ExrStack(Writer):
    """Slices gather in a hidden folder beside their destination until all of them are whole."""

    def __init__(self, output: Output, volume: Volume, workers: Workers) -> None:
        import OpenEXR

        super().__init__(output, volume, workers)
        OpenEXR.set_global_thread_count(0)  # one slice per thread of ours beats its own pool
        self.paths = files(output, volume)
        self.staging = temporary_name(output.path)
        self.staging.mkdir()

    def write(self, z: int, slab: FloatArray) -> None:
        self.workers.run([partial(self._write_slice, z + k, level) for k, level in enumerate(slab)])
        for path in self.paths[z : z + len(slab)]:  # here, where waiting for the disk keeps no worker from evaluating
            sync(self.staging / path.name)

    def _write_slice(self, z: int, rgb: FloatArray) -> None:
        import OpenEXR

        pixels = to_linear(rgb).astype(np.float16)
        path = self.staging / self.paths[z].name
        try:
            OpenEXR.File(slice_header(self.volume, z), {"RGB": np.ascontiguousarray(pixels)}).write(os.fspath(path))
        except RuntimeError as error:
            raise BakeError(f"{self.paths[z]}: cannot write ({error}); free space or bake elsewhere") from error

    def finish(self) -> None:
        """Nothing: each slice is whole as soon as it is written."""

    def commit(self) -> Sequence[Path]:
        for path in self.paths:
            os.replace(self.staging / path.name, path)
        self.staging.rmdir()
        return self.paths

    def abort(self) -> None:
        shutil.rmtree(self.staging, ignore_errors=True)


def slice_header(volume: Volume, z: int) -> dict[str, Any]:
    """The attributes of one slice."""
    import OpenEXR

    header: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": REC709,
        "colorInteropID": "lin_rec709_scene",
        "solidgrain:texture": volume.texture,
        "solidgrain:model": volume.sampler_sha256,
        "solidgrain:seed": str(volume.seed),  # may exceed an EXR int
        "solidgrain:slice": z,
        "solidgrain:depth": volume.shape[0],
        "solidgrain:origin": np.array(volume.origin, np.float32),
        "solidgrain:spacing": np.array(volume.spacing, np.float32),
        "solidgrain:json": json.dumps({"origin": volume.origin, "spacing": volume.spacing}),  # unrounded
        "solidgrain:axes": "column x, row y downwards from the top, slice z",
    }
    if volume.tile:
        wraps = ["periodic" if axis in volume.tile else "black" for axis in "xy"]
        header |= {"wrapmodes": ",".join(wraps), "solidgrain:tile": volume.tile}
    return header


def files(output: Output, volume: Volume) -> list[Path]:
    return frame_paths(output.path, volume.shape[0], int(output.options.get("start", 1)))


def size(output: Output, volume: Volume) -> int:
    return volume.voxels * 6 + volume.shape[0] * 4096
