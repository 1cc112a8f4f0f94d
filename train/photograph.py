"""Reading a photograph: any image file to sRGB-encoded pixels. Needs OpenImageIO, and no torch: encoding needs none either."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.errors import ExemplarError

if TYPE_CHECKING:
    import OpenImageIO as oiio

FloatArray = npt.NDArray[np.float32]

ADVICE = "use a larger photograph, or a smaller --patch or --patch-scale"
LARGEST = 64 * 2**20  # pixels; 768 MB as float32 RGB, far more than one texture can learn from
SUFFIXES = frozenset([".bmp", ".exr", ".hdr", ".jpeg", ".jpg", ".jxl", ".png", ".tga", ".tif", ".tiff", ".webp"])


class Photograph(NamedTuple):
    """What was read of a file."""

    pixels: FloatArray  # sRGB-encoded, [H, W, 3] in [0, 1]
    colorspace: str  # what the file's colours were read as
    warning: str  # what the file declares that could not be honoured, or ""


def read_exemplar(path: str | os.PathLike[str], smallest: int, scale: float = 1.0, advice: str = ADVICE) -> FloatArray:
    """The pixels of `read_photograph`, `scale` of them in one; `smallest` is what is left along an axis."""
    return scaled(read_photograph(path, round(smallest * scale), advice).pixels, scale)


def read_photograph(path: str | os.PathLike[str], smallest: int, advice: str = ADVICE) -> Photograph:
    """A photograph as sRGB-encoded RGB, [H, W, 3] float32 in [0, 1].

    Anything that OpenImageIO reads: 8 and 16 bit, float, grey (repeated), alpha (dropped), CMYK (converted by its reader), the
    coloured layer of an EXR with one; as viewers show it: turned as Exif's Orientation says.
    Colours of another space that the file declares (encoding.py) are converted to sRGB and clipped. Raises ExemplarError when
    the file is missing, unreadable, incomplete, without colours or with several layers of them, smaller than `smallest` pixels
    along an axis (`advice` says what to do then) or larger than `LARGEST` pixels.
    """
    import OpenImageIO as oiio

    from solidgrain.train.encoding import encode

    path = Path(path)
    if not path.is_file():
        raise ExemplarError(f"{path}: no such file; expected a photograph (PNG, JPEG, TIFF, EXR, ...)")
    try:
        os.fspath(path).encode()
    except UnicodeEncodeError as strange:
        raise ExemplarError(f"{path}: the name is not UTF-8, with which OpenImageIO opens no file; rename it") from strange
    if path.stat().st_size == 0:
        raise ExemplarError(f"{path}: the file is empty; expected a photograph (PNG, JPEG, TIFF, EXR, ...)")
    straight = oiio.ImageSpec()
    straight.attribute("oiio:UnassociatedAlpha", 1)  # colours as they are in the file, not multiplied by alpha
    opened = oiio.ImageInput.open(os.fspath(path), straight)
    if opened is None:
        raise ExemplarError(f"{path}: not readable as an image ({_first_line(oiio.geterror())})")
    try:
        spec = opened.spec()
        _check_size(path, spec, smallest, advice)
        colors, alpha = _channels(path, spec.channelnames)
        first, last = (limit((*colors, alpha)) for limit in (min, max))
        pixels = opened.read_image(0, 0, first, last + 1, oiio.FLOAT)
        error = opened.geterror()
    finally:
        opened.close()
    if pixels is None or error:
        raise ExemplarError(f"{path}: the image data is damaged or cut short ({_first_line(error)}); export it again")
    rgb = np.asarray(pixels, np.float32)[..., [channel - first for channel in colors]]
    hidden = alpha not in colors and bool((pixels[..., alpha - first] < 1).any())
    if not np.isfinite(rgb).all():
        raise ExemplarError(f"{path}: holds NaN or infinite pixels; expected finite colours")
    encoded = encode(upright(rgb, spec.get_int_attribute("Orientation", 1)), spec)
    pixels = np.ascontiguousarray(encoded.rgb.clip(0.0, 1.0), np.float32)
    warnings = [encoded.warning, "is transparent in places, whose colours count like the others; crop or fill them" * hidden]
    return Photograph(pixels, encoded.colorspace, "; ".join(filter(None, warnings)))


def _channels(path: Path, names: Sequence[str]) -> tuple[list[int], int]:
    """Where a file has red, green and blue (grey three times), and their alpha, or red again if they have none.

    Colours of no layer count first. OpenImageIO sorts layers by name: the first three channels may be anything.
    """
    layers: dict[str, dict[str, int]] = {}
    for channel, name in enumerate(names):
        layer, _, part = name.rpartition(".")
        layers.setdefault(layer, {})[part.upper()] = channel
    colored = [layer for layer, parts in layers.items() if parts.keys() >= {"R", "G", "B"}]
    if not colored and len(names) <= 2:
        return [0, 0, 0], layers.get("", {}).get("A", 0)
    if len(colored) != 1 and "" not in colored:
        raise ExemplarError(
            f"{path}: channels {', '.join(names)}, expected R, G and B, of one layer at most, or grey; export the colours alone"
        )
    parts = layers["" if "" in colored else colored[0]]
    return [parts[part] for part in "RGB"], parts.get("A", parts["R"])


def upright(pixels: FloatArray, orientation: int) -> FloatArray:
    """A picture [H, W, 3] as it is to be shown, by its Orientation (TIFF 6.0, p. 36, and Exif), which is 1 to 8."""
    if not 2 <= orientation <= 8:  # as it is
        return pixels
    import OpenImageIO as oiio

    stored = oiio.ImageBuf(np.ascontiguousarray(pixels))
    stored.orientation = orientation
    return np.asarray(oiio.ImageBufAlgo.reorient(stored).get_pixels(oiio.FLOAT), np.float32)


def scaled(pixels: FloatArray, scale: float) -> FloatArray:
    """A picture [H, W, 3] with `scale` of its pixels in one, averaged in linear light; sRGB-encoded as before."""
    if scale == 1:
        return np.ascontiguousarray(pixels)
    import OpenImageIO as oiio

    from solidgrain.bake.color import to_linear, to_srgb

    height, width = (max(1, round(extent / scale)) for extent in pixels.shape[:2])
    if width * height > LARGEST:
        raise ExemplarError(
            f"--patch-scale {scale:g}: makes {width}x{height} pixels of the photograph, "
            f"expected at most {LARGEST >> 20} megapixels; raise it"
        )
    whole = oiio.ImageBuf(np.ascontiguousarray(to_linear(pixels)))
    smaller = oiio.ImageBufAlgo.resize(whole, "box", 1.0, oiio.ROI(0, width, 0, height, 0, 1, 0, 3))
    linear = np.asarray(smaller.get_pixels(oiio.FLOAT), np.float32)
    return np.ascontiguousarray(to_srgb(linear).clip(0, 1))


def _check_size(path: Path, spec: oiio.ImageSpec, smallest: int, advice: str) -> None:
    width, height = spec.width, spec.height
    if min(width, height) < smallest:
        raise ExemplarError(f"{path}: {width}x{height} pixels, expected at least {smallest}x{smallest}; {advice}")
    if width * height > LARGEST:
        raise ExemplarError(f"{path}: {width}x{height} pixels, expected at most {LARGEST >> 20} megapixels; crop or resize it")


def _first_line(message: str) -> str:
    return message.strip().splitlines()[0] if message.strip() else "no further detail"
