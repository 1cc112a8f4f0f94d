"""What colour space a photograph declares, and its colours as sRGB-encoded Rec.709, which networks learn.

A cICP chunk counts first (PNG, 3rd edition), then an embedded ICC profile, then the space that OpenImageIO reads from the file
(`oiio:ColorSpace`), then a float file's chromaticities. Float files that declare nothing are linear Rec.709, others sRGB.
Standard spaces are converted by the configuration built into OpenImageIO, whatever $OCIO is; other names by the running one.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import OpenImageIO as oiio

FloatArray = npt.NDArray[np.float32]

SRGB, LINEAR, XYZ = "srgb_rec709_scene", "lin_rec709_scene", "lin_ciexyzd65_scene"
UNSTATED = ("", "data", "unknown", "Rec709")  # these say nothing of colour; the last is in all PPM and PGM files
BUILT_IN, RUNNING = "ocio://default", ""  # OpenColorIO configurations
UNCALIBRATED = (2, 65535)  # Exif colour spaces: Adobe RGB in some cameras' files, "not sRGB" in all
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])  # ICC.1, Annex E
D65 = (0.3127, 0.3290)


class Encoded(NamedTuple):
    """A photograph's colours in sRGB. They may leave [0, 1] where its own space holds colours that sRGB does not."""

    rgb: FloatArray
    colorspace: str  # what they were read as
    warning: str = ""  # what the file declares that could not be honoured


class _UnusableError(Exception):
    """Why a declared colour space cannot be honoured."""


def encode(rgb: FloatArray, spec: oiio.ImageSpec) -> Encoded:
    """Colours [H, W, 3] as a file holds them, in sRGB."""
    assumed = LINEAR if spec.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE) else SRGB
    try:
        return _declared(rgb, spec, assumed)
    except _UnusableError as error:
        return Encoded(_named(rgb, assumed), assumed, f"{error}; its colours are taken as {assumed}")


def _declared(rgb: FloatArray, spec: oiio.ImageSpec, assumed: str) -> Encoded:
    name, cicp, profile = spec.get_string_attribute("oiio:ColorSpace"), spec.getattribute("CICP"), _profile(spec)
    if profile and not (cicp and _standard(cicp)):
        return _by_profile(rgb, profile, spec.get_string_attribute("ICCProfile:profile_description"))
    if cicp and not _standard(cicp):
        raise _UnusableError(f"its cICP chunk {tuple(cicp)} is of no colour space that OpenImageIO knows")
    if name == "g22_rec709_scene" and not cicp and spec.get_float_attribute("oiio:Gamma"):
        name = SRGB  # a gAMA chunk of 1/2.2 alone: what writers of sRGB state (PNG, 3rd edition, sRGB chunk)
    if name == SRGB and spec.getattribute("Exif:ColorSpace") in UNCALIBRATED:
        raise _UnusableError("Exif says that its colours are not sRGB, but it has no ICC profile; export it as sRGB")
    if name not in UNSTATED:
        return Encoded(_named(rgb, name), name)
    if assumed == LINEAR and (primaries := spec.getattribute("chromaticities")):
        return _by_chromaticities(rgb, primaries)
    return Encoded(_named(rgb, assumed), assumed)


def _profile(spec: oiio.ImageSpec) -> bytes:
    profile = spec.getattribute("ICCProfile")
    return b"" if profile is None else bytes(np.asarray(profile, np.uint8))


def _standard(cicp: tuple[int, ...]) -> str:
    """The interop identifier of code points (ITU-T H.273), "" if they have none."""
    return str(oiio.ColorConfig(BUILT_IN).get_color_interop_id(list(cicp)))


def _named(rgb: FloatArray, name: str) -> FloatArray:
    """From a space with a name to sRGB."""
    if name == SRGB:
        return rgb
    if oiio.ColorConfig(BUILT_IN).getColorSpaceIndex(name) >= 0:
        return _convert(rgb, name, SRGB)
    if oiio.ColorConfig(RUNNING).getColorSpaceIndex(name) >= 0:
        return _convert(_convert(rgb, name, LINEAR, RUNNING), LINEAR, SRGB)
    raise _UnusableError(f"it declares the colour space {name!r}, which the OpenColorIO configuration does not know; set OCIO")


def _by_profile(rgb: FloatArray, profile: bytes, description: str) -> Encoded:
    """Through an ICC profile (ICC.1) with a matrix and curves, which OpenColorIO reads; no other kind and no CMYK.

    A profile that leaves colours within a step of 8 bits of where they are is sRGB's: then they stay as they are.
    """
    if (space := profile[16:20].decode("latin-1").strip()) != "RGB":
        raise _UnusableError(f"its ICC profile is of {space} colours, expected RGB; export it as sRGB")
    steps = np.linspace(0, 1, 18, dtype=np.float32)  # every 15th step of 8 bits
    probe = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(1, -1, 3)
    with tempfile.TemporaryDirectory() as folder:  # OpenColorIO reads profiles from files
        path = Path(folder, "profile.icc")
        path.write_bytes(profile)
        if np.abs(_through(path, probe).clip(0, 1) - probe).max() <= 1 / 255:
            return Encoded(rgb, f"{SRGB} (ICC profile {description!r})")
        return Encoded(_through(path, rgb), f"ICC profile {description!r}")


def _through(path: Path, rgb: FloatArray) -> FloatArray:
    """From the device colours of a profile to sRGB: OpenColorIO goes the other way, from CIE XYZ at D65."""
    image = oiio.ImageBuf(np.ascontiguousarray(rgb))
    if not oiio.ImageBufAlgo.ociofiletransform(image, image, str(path), False, inverse=True, colorconfig=BUILT_IN):
        reason = image.geterror().strip().rpartition("\n")[2].rpartition(").  ")[2].rstrip(".")
        raise _UnusableError(f"its ICC profile has no matrix and curves ({reason}); export it as sRGB")
    return _convert(np.asarray(image.get_pixels(oiio.FLOAT), np.float32), XYZ, SRGB)


def _by_chromaticities(rgb: FloatArray, primaries: tuple[float, ...]) -> Encoded:
    """Linear light of any primaries, xy of red, green, blue and white (SMPTE RP 177), adapted to D65 (Bradford)."""
    red_green_blue, white, d65 = (_xyz(xy) for xy in (primaries[:6], primaries[6:], D65))
    colorspace = f"linear, chromaticities {', '.join(f'{value:.4g}' for value in primaries)}"
    try:
        with np.errstate(all="raise"):
            to_xyz = red_green_blue.T * np.linalg.solve(red_green_blue.T, white[0] / white[0, 1])
            gain = (BRADFORD @ d65[0] / d65[0, 1]) / (BRADFORD @ white[0] / white[0, 1])
    except (np.linalg.LinAlgError, FloatingPointError) as error:
        raise _UnusableError(f"its chromaticities {primaries} are of no colour space") from error
    matrix = np.linalg.inv(BRADFORD) @ np.diag(gain) @ BRADFORD @ to_xyz
    return Encoded(_convert((rgb @ matrix.T).astype(np.float32), XYZ, SRGB), colorspace)


def _xyz(xy: tuple[float, ...]) -> npt.NDArray[np.float64]:
    """xyz [N, 3] of N pairs of chromaticities."""
    pairs = np.array(xy, np.float64).reshape(-1, 2)
    return np.concatenate([pairs, 1 - pairs.sum(1, keepdims=True)], axis=1)


def _convert(rgb: FloatArray, source: str, target: str, config: str = BUILT_IN) -> FloatArray:
    image = oiio.ImageBuf(np.ascontiguousarray(rgb, np.float32))
    if not oiio.ImageBufAlgo.colorconvert(image, image, source, target, unpremult=False, colorconfig=config):
        message = image.geterror().strip().partition("\n")[0]
        raise _UnusableError(f"it declares the colour space {source!r}, from which no way leads to sRGB ({message})")
    return np.asarray(image.get_pixels(oiio.FLOAT), np.float32)
