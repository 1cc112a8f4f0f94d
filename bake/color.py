"""Colour encodings, and whole numbers for colours. The sampler speaks the exemplar's encoding, sRGB.

Colour spaces have the names of the running OpenColorIO configuration ($OCIO, or the one built into OpenImageIO). The two
that every bake needs are computed here and need no library.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.errors import UsageError

FloatArray = npt.NDArray[np.float32]

SRGB = "srgb_rec709_scene"
LINEAR = "lin_rec709_scene"


def from_srgb(rgb: FloatArray, colorspace: str) -> FloatArray:
    """sRGB-encoded Rec.709 colours [..., 3] in [0, 1] in another colour space."""
    if colorspace == SRGB:
        return rgb
    if colorspace == LINEAR:
        return to_linear(rgb)
    raise UsageError(f"--colorspace {colorspace}: unknown")


def to_linear(rgb: FloatArray) -> FloatArray:
    """sRGB-encoded values in [0, 1] to linear light (IEC 61966-2-1)."""
    low = rgb / np.float32(12.92)
    high = ((rgb + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    linear: FloatArray = np.where(rgb <= np.float32(0.04045), low, high)
    return linear


def to_srgb(linear: FloatArray) -> FloatArray:
    """Linear light to sRGB-encoded values in [0, 1], the inverse of `to_linear`. What lies outside is clipped."""
    clipped = linear.clip(0, 1)
    high = np.float32(1.055) * clipped ** np.float32(1 / 2.4) - np.float32(0.055)
    encoded: FloatArray = np.where(clipped <= np.float32(0.0031308), clipped * np.float32(12.92), high)
    return encoded


def quantize(rgb: FloatArray, dtype: npt.DTypeLike, noise: FloatArray | None = None) -> npt.NDArray[np.generic]:
    """[0, 1] to 0 .. the largest of an unsigned type, to the nearest, after `noise` in steps of one is added."""
    largest = np.float32(np.iinfo(np.dtype(dtype)).max)
    scaled = rgb.clip(0, 1) * largest
    if noise is not None:
        scaled += noise
    return (scaled.clip(0, largest) + np.float32(0.5)).astype(dtype)


def triangular(shape: tuple[int, ...], z: int) -> FloatArray:
    """Dither for slices z, z + 1, ... [z, y, x, channel]: triangular noise in (-1, 1) that depends on the voxel alone.

    A 32-bit integer hash (the finaliser of MurmurHash3) of the coordinates gives two independent uniform halves.
    """
    slices, rows, columns, channels = (np.arange(count, dtype=np.uint32) for count in shape)
    key = (slices + np.uint32(z))[:, None, None, None] * np.uint32(0x9E3779B1)
    key = (key ^ rows[:, None, None]) * np.uint32(0x85EBCA77)
    key = (key ^ columns[:, None]) * np.uint32(0xC2B2AE3D)
    key = (key ^ channels) * np.uint32(0x27D4EB2F)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35), (16, 1)):
        key = (key ^ (key >> np.uint32(shift))) * np.uint32(factor)
    noise: FloatArray = ((key & np.uint32(0xFFFF)).astype(np.float32) - (key >> np.uint32(16)).astype(np.float32)) / np.float32(
        65536
    )
    return noise
