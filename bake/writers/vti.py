"""`.vti`: VTK ImageData, RGB as point data at the voxel centres, in one appended raw block that streams.

Format: VTK File Formats, "XML File Formats", serial ImageData with appended raw data. `header_type="UInt64"`, because UInt32
fails at 4 GiB. The array is called `rgb`: uint8 for viewers, sRGB-encoded, or float32 on request, the same encoding unrounded.
The encoding, texture and seed are field data.
"""

from __future__ import annotations

import struct

import numpy as np

from solidgrain.bake.writers.base import FileWriter, FloatArray, Output, Volume, to_uint8
from solidgrain.runtime.errors import BakeError
from solidgrain.runtime.workers import Workers

TYPES = {"uint8": ("UInt8", 1), "float32": ("Float32", 4)}


class VtiFile(FileWriter):
    """The data's length is known beforehand, so header, slabs and trailer follow each other without seeking back."""

    def __init__(self, output: Output, volume: Volume, workers: Workers) -> None:
        super().__init__(output, volume, workers)
        self.dtype = _dtype(output)
        self.file.write(_header(volume, TYPES[self.dtype][0]).encode("ascii"))
        self.file.write(struct.pack("<Q", volume.voxels * 3 * TYPES[self.dtype][1]))

    def write(self, z: int, slab: FloatArray) -> None:
        for level in slab:  # one at a time: a converted slab would be another slab of memory
            data = to_uint8(level) if self.dtype == "uint8" else np.ascontiguousarray(level, "<f4")
            self.file.write(data.data)

    def finish(self) -> None:
        self.file.write(b"\n  </AppendedData>\n</VTKFile>\n")
        super().finish()


def size(output: Output, volume: Volume) -> int:
    return 4096 + volume.voxels * 3 * TYPES[_dtype(output)][1]


def _dtype(output: Output) -> str:
    dtype = str(output.options.get("dtype", "uint8"))
    if dtype not in TYPES:
        raise BakeError(f"{output.path}: type {dtype!r}, expected one of {', '.join(TYPES)}")
    return dtype


def _header(volume: Volume, vtk_type: str) -> str:
    depth, height, width = volume.shape
    extent = f"0 {width - 1} 0 {height - 1} 0 {depth - 1}"
    origin = " ".join(repr(value) for value in volume.first_sample)
    spacing = " ".join(repr(value) for value in volume.spacing)
    fields = {"color_encoding": "srgb_rec709_scene", "texture": volume.texture, "seed": str(volume.seed)}
    return f"""<?xml version="1.0"?>
<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">
  <ImageData WholeExtent="{extent}" Origin="{origin}" Spacing="{spacing}" Direction="1 0 0 0 1 0 0 0 1">
    <FieldData>
{chr(10).join(_string_array(name, value) for name, value in fields.items())}
    </FieldData>
    <Piece Extent="{extent}">
      <PointData Scalars="rgb">
        <DataArray type="{vtk_type}" Name="rgb" NumberOfComponents="3" format="appended" offset="0"/>
      </PointData>
    </Piece>
  </ImageData>
  <AppendedData encoding="raw">
    _"""


def _string_array(name: str, value: str) -> str:
    """A VTK string array holds the bytes of each string, zero-terminated, as numbers."""
    codes = " ".join(str(byte) for byte in [*value.encode("utf-8"), 0])
    return f'      <Array type="String" Name="{name}" NumberOfTuples="1" format="ascii">{codes}</Array>'
