"""`.vti`: VTK ImageData, RGB as point data at the voxel centres, in one appended raw block that streams.

Format: VTK File Formats, "XML File Formats", serial ImageData with appended raw data, plain or in zlib blocks of one slab
each. `header_type="UInt64"`, because UInt32 fails at 4 GiB. The array is called `rgb`: uint8 for viewers, sRGB-encoded, or
uint16 or float32 on request, the same encoding finer. The encoding, texture and seed are field data.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

from solidgrain.bake.store import Bytes, Encoded, Store
from solidgrain.bake.writers.base import DATA, FloatArray, Option, Output, SequenceWriter, Volume

TYPES = {"uint8": ("UInt8", 1), "uint16": ("UInt16", 2), "float32": ("Float32", 4)}
SIZES = "sizes"  # stream: compressed bytes of each slice
LEVEL = 1  # of zlib: on grainy colours the higher ones take half as long again and save nothing
OPTIONS = (
    Option("type", "uint8", "of the colours", tuple(TYPES)),
    Option("compression", "none", "zlib: smaller files", ("none", "zlib")),
)


class VtiFile(SequenceWriter):
    """The header's length is known beforehand; the table of compressed sizes in it is not, until all slabs have come."""

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(str(self.output.options["type"])).newbyteorder("<")

    @property
    def compressed(self) -> bool:
        return self.output.options["compression"] == "zlib"

    @property
    def reserved(self) -> int:
        blocks = self.volume.shape[0]  # one per slice
        return len(self._xml()) + 8 * (3 + blocks if self.compressed else 1)

    def encode(self, z: int, slab: FloatArray) -> Encoded:
        def convert(k: int) -> Bytes:
            level = self.stored(slab[k : k + 1], z + k, self.dtype).data
            return zlib.compress(level, LEVEL) if self.compressed else level

        levels = self.workers.map(convert, len(slab))
        if not self.compressed:
            return Encoded({DATA: levels})
        return Encoded({DATA: levels, SIZES: [np.array([memoryview(level).nbytes for level in levels], "<u8").data]})

    def header(self, store: Store) -> bytes:
        depth = self.volume.shape[0]
        if not self.compressed:
            return self._xml() + struct.pack("<Q", depth * self._slice_bytes)
        # blocks, bytes of a block, bytes of a last block that is shorter (0: none is), compressed bytes of each
        return self._xml() + struct.pack("<3Q", depth, self._slice_bytes, 0) + store.read(SIZES, 0, depth, 8)

    def trailer(self) -> bytes:
        return b"\n  </AppendedData>\n</VTKFile>\n"

    def probe(self, voxels: npt.NDArray[np.int64]) -> tuple[FloatArray, float]:
        depth, height, width = self.volume.shape
        values = np.empty((len(voxels), 3), self.dtype)
        with open(self.output.path, "rb") as file:
            file.seek(self.reserved - 8 * depth if self.compressed else 0)
            sizes = np.frombuffer(file.read(8 * depth), "<u8") if self.compressed else np.full(depth, self._slice_bytes)
            starts = self.reserved + np.concatenate([[0], np.cumsum(sizes)])
            for z in np.unique(voxels[:, 2]):
                file.seek(int(starts[z]))
                content = file.read(int(sizes[z]))
                level = np.frombuffer(zlib.decompress(content) if self.compressed else content, self.dtype)
                here = voxels[:, 2] == z
                values[here] = level.reshape(height, width, 3)[voxels[here, 1], voxels[here, 0]]
        return self.read_back(values)

    @property
    def _slice_bytes(self) -> int:
        _, height, width = self.volume.shape
        return width * height * 3 * self._sample_bytes

    @property
    def _sample_bytes(self) -> int:
        return TYPES[str(self.output.options["type"])][1]

    def _xml(self) -> bytes:
        volume, (depth, height, width) = self.volume, self.volume.shape
        extent = f"0 {width - 1} 0 {height - 1} 0 {depth - 1}"
        origin = " ".join(repr(value) for value in volume.first_sample)
        spacing = " ".join(repr(value) for value in volume.spacing)
        fields = {"color_encoding": self.output.colorspace, **volume.notes}
        vtk_type = TYPES[str(self.output.options["type"])][0]
        compressor = ' compressor="vtkZLibDataCompressor"' if self.compressed else ""
        return f"""<?xml version="1.0"?>
<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64"{compressor}>
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
    _""".encode("ascii")


def size(output: Output, volume: Volume) -> int:
    return 4096 + volume.shape[0] * 40 + volume.voxels * 3 * TYPES[str(output.options["type"])][1]


def _string_array(name: str, value: str) -> str:
    """A VTK string array holds the bytes of each string, zero-terminated, as numbers."""
    codes = " ".join(str(byte) for byte in [*value.encode("utf-8"), 0])
    return f'      <Array type="String" Name="{name}" NumberOfTuples="1" format="ascii">{codes}</Array>'
