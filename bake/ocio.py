"""Colour spaces by name: those of the running OpenColorIO configuration, $OCIO or the one built into OpenImageIO.

OpenImageIO reads the configuration once: a change of $OCIO is seen by the next process. Conversions start from linear
Rec.709, which color.py makes of our sRGB-encoded colours exactly; to a linear colour space that leaves a 3x3 matrix. The
other curves are OpenImageIO's and good to 3e-5. Colours outside [0, 1] (of a narrower gamut) are kept.
"""

from __future__ import annotations

import difflib
import hashlib
import os
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from solidgrain.bake.color import LINEAR, SRGB, FloatArray, to_srgb
from solidgrain.runtime.errors import BakeError, UsageError

if TYPE_CHECKING:
    import OpenImageIO as oiio

SOURCES = (LINEAR, SRGB, "sRGB - Texture", "Utility - sRGB - Texture")  # what configurations call the colours we start from
BAND = 2**16  # colours at a time: they stay in the cache
LINEARITY = 1e-6  # of the largest value: a matrix that meets a conversion within it is the conversion


@cache
def configuration() -> oiio.ColorConfig:
    """The running configuration.

    Raises UsageError if $OCIO names a file that is missing or broken: OpenImageIO alone would go on with names of its own.
    """
    import OpenImageIO as oiio

    config = oiio.ColorConfig.default_colorconfig()
    if config.configname() == "built-in":  # what it goes on with; the configuration in the library is called ocio://default
        message = oiio.ColorConfig().geterror().strip().partition("\n")[0]
        raise UsageError(f"{described()}: {message}; correct the file, or unset OCIO for the built-in configuration")
    return config


def described() -> str:
    """Which configuration runs, for people."""
    path = os.environ.get("OCIO")
    return f"$OCIO={path}" if path else "the configuration built into OpenImageIO"


def fingerprint() -> str:
    """What the running configuration is, for plans: a file's name and checksum, or the address of a built-in one.

    Files that a configuration refers to do not count.
    """
    address = str(configuration().configname())
    if address.startswith("ocio://"):
        return address
    return f"{Path(address).name} sha256:{hashlib.sha256(Path(address).read_bytes()).hexdigest()[:16]}"


def canonical(name: str) -> str:
    """The one name of a colour space, an alias or a role: its colour interop identifier, else the configuration's name.

    Raises UsageError for a name that the configuration does not know, that is no colour, or that no way leads to.
    """
    if name in (SRGB, LINEAR):
        return name
    config = configuration()
    found = config.resolve(name)
    index = config.getColorSpaceIndex(found)
    if index < 0:
        raise UsageError(f"--colorspace {name}: {described()} has no such colour space; closest are {_closest(name)}")
    if config.isData(found):
        raise UsageError(f"--colorspace {name}: holds data, not colour, in {described()}; pick a colour space")
    identifier = config.get_color_interop_id(found)
    if identifier and config.getColorSpaceIndex(config.resolve(identifier)) == index:
        found = identifier
    if found not in (SRGB, LINEAR):
        _source(found)
    return str(found)


def _closest(name: str) -> str:
    config = configuration()
    spaces = config.getColorSpaceNames()
    known = {*spaces, *config.getRoles(), *(alias for space in spaces for alias in config.getAliases(space))}
    by_lower = {entry.lower(): entry for entry in sorted(known)}
    return ", ".join(repr(by_lower[close]) for close in difflib.get_close_matches(name.lower(), by_lower, 3, 0.0))


def interop_id(colorspace: str) -> str:
    """The colour interop identifier (ASWF Color Interop Forum) of a canonical name, "" for a space that has none."""
    if colorspace in (SRGB, LINEAR):
        return colorspace
    return str(configuration().get_color_interop_id(colorspace))


def chromaticities(identifier: str) -> tuple[float, ...] | None:
    """xy of red, green, blue and white of a space with an interop identifier, None where it has none or they are unknown."""
    found = configuration().get_chromaticities(identifier)
    return tuple(map(float, found)) if found else None


def from_linear(linear: FloatArray, colorspace: str) -> FloatArray:
    """Linear Rec.709 colours [..., 3] in [0, 1] in a colour space of the configuration, by its canonical name.

    Each colour for itself: neither the array's shape nor another thread changes a bit of it. Raises BakeError if the
    configuration makes NaN of a colour.
    """
    matrix = _matrix(colorspace)
    flat = linear.reshape(-1, 3)
    converted = np.empty(flat.shape, np.float32)
    for start in range(0, len(flat), BAND):
        band = flat[start : start + BAND]
        converted[start : start + BAND] = _converted(band, colorspace) if matrix is None else _multiplied(band, matrix)
    if np.isnan(converted).any():
        raise BakeError(f"--colorspace {colorspace}: {described()} makes NaN of a colour in [0, 1]; pick another colour space")
    return converted.reshape(linear.shape)


def _multiplied(colors: FloatArray, matrix: FloatArray) -> FloatArray:
    """colors @ matrix, with sums in one order whatever the shape (those of BLAS differ)."""
    red, green, blue = (np.ascontiguousarray(colors[:, k]) for k in range(3))
    return np.stack([red * matrix[0, k] + green * matrix[1, k] + blue * matrix[2, k] for k in range(3)], axis=-1)


@cache
def _matrix(colorspace: str) -> FloatArray | None:
    """The matrix [3, 3] from rows of linear Rec.709 to a linear colour space, None where no matrix is the conversion."""
    steps = np.linspace(0, 1, 9, dtype=np.float32)
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    matrix, expected = _converted(np.eye(3, dtype=np.float32), colorspace), _converted(grid, colorspace)
    error = np.abs(_multiplied(grid, matrix) - expected).max()
    return matrix if error <= LINEARITY * max(1.0, float(np.abs(expected).max())) else None


def _converted(linear: FloatArray, colorspace: str) -> FloatArray:
    """Colours [N, 3] as the configuration converts them."""
    source = _source(colorspace)
    converted = _convert(linear if source == LINEAR else to_srgb(linear), source, colorspace)
    if isinstance(converted, str):
        raise BakeError(f"--colorspace {colorspace}: {converted}")
    return converted


@cache
def _source(colorspace: str) -> str:
    """The name from which the configuration finds a way to a colour space. Raises UsageError if it finds none."""
    configuration()  # first, for its errors
    messages = []
    for source in SOURCES:
        converted = _convert(np.zeros((1, 3), np.float32), source, colorspace)
        if not isinstance(converted, str):
            return source
        messages.append(converted)
    raise UsageError(
        f"--colorspace {colorspace}: {described()} has no way to it from Rec.709; "
        f"give it a colour space {LINEAR} or {SRGB}, or the role aces_interchange ({messages[0]})"
    )


def _convert(colors: FloatArray, source: str, target: str) -> FloatArray | str:
    """Colours [N, 3] from one colour space to another; OpenImageIO's message where it cannot."""
    import OpenImageIO as oiio

    image = oiio.ImageBuf(np.ascontiguousarray(colors[None], np.float32))  # a copy; in one thread, since ours call it
    if not oiio.ImageBufAlgo.colorconvert(image, image, source, target, unpremult=False, nthreads=1):
        return str(image.geterror()).strip().partition("\n")[0]
    converted: FloatArray = np.asarray(image.get_pixels(oiio.FLOAT), np.float32)[0]
    return converted
