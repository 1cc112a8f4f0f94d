"""Colour encodings, and whole numbers for colours. The sampler speaks the exemplar's encoding, sRGB.

sRGB and linear Rec.709, which every bake needs, are computed here and need no library; all other colour spaces have the names
of the running OpenColorIO configuration (ocio.py).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.errors import UsageError

FloatArray = npt.NDArray[np.float32]

SRGB = "srgb_rec709_scene"
LINEAR = "lin_rec709_scene"
HALF_LARGEST = np.float32(65504)
LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)  # weights of Rec.709's red, green and blue (ITU-R BT.709)


def color_options(colorspace: str, planned: str = "") -> dict[str, str | int]:
    """The options of an output that say its colours: `colorspace`, the canonical name of what a name, an alias or a role means,
    and `colorconfig`, the configuration that defines it ("": none is needed).

    Raises UsageError for what the configuration does not know, and if it is not the one that a plan was made with.
    """
    if colorspace in (SRGB, LINEAR):
        return {"colorspace": colorspace, "colorconfig": ""}
    if not colorspace.isprintable():
        raise UsageError(f"--colorspace {colorspace!r}: expected printable characters")
    from solidgrain.bake.ocio import canonical, described, fingerprint

    name = canonical(colorspace)
    running = "" if name in (SRGB, LINEAR) else fingerprint()
    if planned not in ("", running):
        raise UsageError(
            f"--colorspace {colorspace}: planned with the configuration {planned}, found {running} ({described()}); "
            "set OCIO to the configuration of the plan"
        )
    return {"colorspace": name, "colorconfig": running}


def from_srgb(rgb: FloatArray, colorspace: str) -> FloatArray:
    """sRGB-encoded Rec.709 colours [..., 3] in [0, 1] in another colour space, by its canonical name.

    May leave [0, 1] where the other gamut is narrower. Raises UsageError for a name that the configuration does not know.
    """
    if colorspace == SRGB:
        return rgb
    if colorspace == LINEAR:
        return to_linear(rgb)
    from solidgrain.bake.ocio import from_linear

    return from_linear(to_linear(rgb), colorspace)


def luma(linear: FloatArray) -> FloatArray:
    """Rec.709 luma [...] of linear colours [..., 3], with sums in one order whatever the shape (those of BLAS differ)."""
    weighted: FloatArray = linear[..., 0] * LUMA[0] + linear[..., 1] * LUMA[1] + linear[..., 2] * LUMA[2]
    return weighted


def to_linear(rgb: FloatArray) -> FloatArray:
    """sRGB-encoded values in [0, 1] to linear light (IEC 61966-2-1)."""
    linear: FloatArray = rgb + np.float32(0.055)
    linear /= np.float32(1.055)
    np.power(linear, np.float32(2.4), out=linear)  # in place: a baker's time goes into such passes
    np.copyto(linear, rgb / np.float32(12.92), where=rgb <= np.float32(0.04045))
    return linear


def to_srgb(linear: FloatArray) -> FloatArray:
    """Linear light to sRGB-encoded values in [0, 1], the inverse of `to_linear`. What lies outside is clipped."""
    clipped = linear.clip(0, 1)
    high = np.float32(1.055) * clipped ** np.float32(1 / 2.4) - np.float32(0.055)
    encoded: FloatArray = np.where(clipped <= np.float32(0.0031308), clipped * np.float32(12.92), high)
    return encoded


def to_half(values: FloatArray) -> npt.NDArray[np.float16]:
    """`values.astype(np.float16)`, bit for bit, in half the time where all of them are normal numbers of that type.

    Adding just under half of the last place that stays, and one more where that place is odd, rounds to the nearest even.
    What the type has no number for becomes its largest, not infinity.
    """
    if values.size == 0 or values.min() < 2.0**-14 or not values.max() < HALF_LARGEST:
        return values.clip(-HALF_LARGEST, HALF_LARGEST).astype(np.float16)
    bits = np.ascontiguousarray(values).view(np.uint32)
    rounded = bits + (np.uint32(0xFFF) + ((bits >> np.uint32(13)) & np.uint32(1)))
    shifted = (rounded >> np.uint32(13)) - np.uint32((127 - 15) << 10)
    return shifted.astype(np.uint16).view(np.float16)


def as_floats(values: FloatArray, dtype: npt.DTypeLike) -> npt.NDArray[np.floating[Any]]:
    """Colours as half or single floats, contiguous."""
    return to_half(values) if np.dtype(dtype).itemsize == 2 else np.ascontiguousarray(values, dtype)


def quantize(rgb: FloatArray, dtype: npt.DTypeLike, noise: FloatArray | None = None) -> npt.NDArray[np.generic]:
    """[0, 1] to 0 .. the largest of an unsigned type, to the nearest, after triangular `noise` in steps of one is added.

    Within half a step of an end, triangular noise would be cut off and brighten black and darken white; uniform noise in
    (-1/2, 1/2), the same noise through its distribution function, fits there. So the mean is true everywhere, and 0 and 1 stay.
    """
    largest = np.float32(np.iinfo(np.dtype(dtype)).max)
    scaled = rgb.clip(0, 1) * largest
    if noise is not None:
        at_end = np.abs(scaled - largest / 2) > largest / 2 - np.float32(0.5)
        scaled += np.where(at_end, noise * (1 - np.abs(noise) / 2), noise)
    return (scaled.clip(0, largest) + np.float32(0.5)).astype(dtype)


def triangular(shape: tuple[int, ...], z: int) -> FloatArray:
    """Dither for slices z, z + 1, ... [z, y, x, channel]: triangular noise in (-1, 1) that depends on the voxel alone.

    The difference of two uniform numbers: the halves of a 64-bit hash (the finaliser of SplitMix64, Steele et al. 2014) of the
    coordinates. It is a bijection of 22 bits of z, 20 of y, 20 of x and 2 of the channel: no two voxels share one.
    """
    slices, rows, columns, channels = (np.arange(count, dtype=np.uint64) for count in shape)
    key = (slices + np.uint64(z))[:, None, None, None] << np.uint64(42) | rows[:, None, None] << np.uint64(22)
    key = key | columns[:, None] << np.uint64(2) | channels
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
        key ^= key >> np.uint64(shift)
        key *= np.uint64(factor)
    halves = (key >> np.uint64(40), (key & np.uint64(0xFFFFFFFF)) >> np.uint64(8))  # 24 bits each, exact in float32
    noise: FloatArray = (halves[0].astype(np.float32) - halves[1].astype(np.float32)) * np.float32(2.0**-24)
    return noise
