"""`.dds`: a volume texture as Direct3D and game engines load it, uncompressed or in blocks, with or without mip levels.

Format: "Programming Guide for DDS" (Direct3D documentation), `DDS_HEADER` with the extended `DDS_HEADER_DXT10`. Voxels lie
x fastest, then y, then z; alpha is 1. Block formats (BC1, BC7) compress 4x4 pixels of one slice each; the encoder is
the optional package etcpak. Mip levels follow the volume in the same file. The header says sRGB where the output is: the
GPU then decodes to linear light itself.
"""

from __future__ import annotations

import os
import shutil
import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from solidgrain.bake.color import SRGB
from solidgrain.bake.store import COPY, Bytes, Encoded, Finished, Store
from solidgrain.bake.writers.base import DATA, FloatArray, Option, Output, SequenceWriter, Volume, data
from solidgrain.runtime.errors import UsageError


class Pixels(NamedTuple):
    """How voxels are stored: DXGI_FORMAT plain and for sRGB, and the bytes of each voxel or 4x4 block."""

    plain: int
    srgb: int
    unit_bytes: int
    block: int  # voxels along x and y of a unit


TYPES = {
    "rgba8": Pixels(28, 29, 4, 1),  # R8G8B8A8_UNORM, _SRGB
    "rgba16f": Pixels(10, 10, 8, 1),  # R16G16B16A16_FLOAT: there is no other
    "bc1": Pixels(71, 72, 8, 4),  # BC1_UNORM, _SRGB
    "bc7": Pixels(98, 99, 16, 4),  # BC7_UNORM, _SRGB
}
OPTIONS = (Option("type", "rgba8", "of the voxels; bc1 and bc7 are lossy and need the package etcpak", tuple(TYPES)),)
SIDE = 2048  # D3D11_REQ_TEXTURE3D_U_V_OR_W_DIMENSION
HEADER_BYTES = 148
OPAQUE_MODES = 1 << 1 | 1 << 3 | 1 << 5  # of BC7, those that store alpha = 255 exactly; mode 6 would round it to 254

# dwFlags: CAPS | HEIGHT | WIDTH | PIXELFORMAT | DEPTH, and one of PITCH and LINEARSIZE
VOLUME_FLAGS, PITCH, LINEAR_SIZE, MIP_COUNT = 0x1 | 0x2 | 0x4 | 0x1000 | 0x800000, 0x8, 0x80000, 0x20000
CAPS_TEXTURE, CAPS_COMPLEX, CAPS_MIPMAP, CAPS2_VOLUME = 0x1000, 0x8, 0x400000, 0x200000
FOUR_CC, TEXTURE_3D, ALPHA_OPAQUE = 0x4, 4, 3


class DdsFile(SequenceWriter):
    """Header, the slices of the volume, then those of each mip level."""

    @property
    def pixels(self) -> Pixels:
        return TYPES[str(self.output.options["type"])]

    @property
    def reserved(self) -> int:
        return HEADER_BYTES

    def encode(self, z: int, slab: FloatArray) -> Encoded:
        encoder = self._encoder()
        return data(*self.workers.map(lambda k: encoder(self._voxels(slab[k : k + 1], z + k)), len(slab)))

    def _voxels(self, level: FloatArray, z: int) -> npt.NDArray[np.generic]:
        """One slice as RGBA [y, x, 4], padded to whole blocks with its edge."""
        half = self.output.options["type"] == "rgba16f"
        rgb = self.stored(level, z, "<f2" if half else np.uint8)
        below, right = (-extent % self.pixels.block for extent in rgb.shape[1:3])
        rgb = np.pad(rgb[0], ((0, below), (0, right), (0, 0)), mode="edge")
        opaque = np.full((*rgb.shape[:2], 1), 1 if half else 255, rgb.dtype)
        return np.concatenate([rgb, opaque], axis=2)

    def _encoder(self) -> Callable[[npt.NDArray[np.generic]], Bytes]:
        """From RGBA [y, x, 4] to the bytes of the file. (etcpak takes bytes, red first.)"""
        if self.pixels.block == 1:
            return lambda rgba: rgba.data
        import etcpak

        if self.output.options["type"] == "bc1":
            return lambda rgba: etcpak.compress_bc1(rgba.tobytes(), rgba.shape[1], rgba.shape[0])
        settings = etcpak.BC7CompressBlockParams()
        settings.init_linear_weights()
        settings.m_mode_mask = OPAQUE_MODES
        return lambda rgba: etcpak.compress_bc7(rgba.tobytes(), rgba.shape[1], rgba.shape[0], settings)

    def assemble(self, store: Store) -> list[Finished]:
        return self.assemble_levels(store, [])

    def assemble_levels(self, store: Store, levels: Sequence[Store]) -> list[Finished]:
        path = store.joined(DATA)
        with open(path, "r+b") as file:
            file.write(header(self.output, self.volume, 1 + len(levels)))
            file.seek(0, os.SEEK_END)
            for level in levels:
                with open(level.joined(DATA), "rb") as below:
                    below.seek(level.reserved)
                    shutil.copyfileobj(below, file, COPY)
            file.flush()
            os.fsync(file.fileno())
        return [Finished(path, self.output.path)]

    def probe(self, voxels: npt.NDArray[np.int64]) -> tuple[FloatArray, float] | None:
        if self.pixels.block > 1:
            return None
        dtype = "<f2" if self.pixels.unit_bytes == 8 else "u1"
        stored = np.memmap(self.output.path, dtype, "r", HEADER_BYTES, (*self.volume.shape, 4))
        x, y, z = voxels.T
        return self.read_back(stored[z, y, x, :3])


def header(output: Output, volume: Volume, mips: int) -> bytes:
    """The magic, DDS_HEADER (124 bytes) and DDS_HEADER_DXT10 (20 bytes)."""
    pixels, (depth, height, width) = TYPES[str(output.options["type"])], volume.shape
    columns, rows = (-(-extent // pixels.block) for extent in (width, height))
    row_bytes = columns * pixels.unit_bytes
    flags, pitch = (PITCH, row_bytes) if pixels.block == 1 else (LINEAR_SIZE, row_bytes * rows)
    caps = CAPS_TEXTURE | CAPS_COMPLEX  # OpenImageIO opens no volume that is not COMPLEX, mip levels or none
    if mips > 1:
        flags, caps = flags | MIP_COUNT, caps | CAPS_MIPMAP
    sizes = struct.pack("<7I44x", 124, VOLUME_FLAGS | flags, height, width, pitch, depth, mips)
    pixel_format = struct.pack("<2I4s20x", 32, FOUR_CC, b"DX10")
    dxgi = pixels.srgb if output.colorspace == SRGB else pixels.plain
    extended = struct.pack("<5I", dxgi, TEXTURE_3D, 0, 1, ALPHA_OPAQUE)
    return b"DDS " + sizes + pixel_format + struct.pack("<2I12x", caps, CAPS2_VOLUME) + extended


def check(output: Output, volume: Volume) -> None:
    """Refuse volumes that Direct3D cannot hold, and block formats without their encoder (ModuleNotFoundError)."""
    depth, height, width = volume.shape
    if max(volume.shape) > SIDE:
        raise UsageError(f"{output.path}: {width}x{height}x{depth} voxels, a DDS volume has at most {SIDE} along each axis")
    if TYPES[str(output.options["type"])].block == 1:
        return
    if width % 4 or height % 4:
        raise UsageError(
            f"{output.path}: {width}x{height} voxels in a slice, {output.options['type']} needs multiples of 4; "
            "change --size or use --dds-type rgba8"
        )
    import etcpak  # noqa: F401


def size(output: Output, volume: Volume) -> int:
    pixels, (depth, height, width) = TYPES[str(output.options["type"])], volume.shape
    return HEADER_BYTES + depth * -(-height // pixels.block) * -(-width // pixels.block) * pixels.unit_bytes
