"""A photograph's own colour space is honoured: profiles made here, converted colours from the standards' matrices."""

from __future__ import annotations

import io
import os
import struct
import subprocess
import sys
import zlib

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from solidgrain.train.photograph import read_photograph

BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
D50 = np.array([0.9642, 1.0, 0.8249])  # of ICC's connection space
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
ADOBE = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)  # Adobe RGB (1998), Sec. 4.3.1.1
P3 = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.3290)
ACES_AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
WIDE = (0.70, 0.30, 0.18, 0.74, 0.13, 0.05, 0.3457, 0.3585)  # of nobody, white D50
ADOBE_GAMMA = 563 / 256
SRGB = "srgb_rec709_scene"


def to_xyz(primaries) -> np.ndarray:
    """Columns: XYZ of red, green and blue at full strength (SMPTE RP 177)."""
    red, green, blue, white = np.array(primaries, float).reshape(4, 2)
    columns = np.array([[x / y, 1, (1 - x - y) / y] for x, y in (red, green, blue)]).T
    return columns * np.linalg.solve(columns, [white[0] / white[1], 1, (1 - white.sum()) / white[1]])


def adapted(matrix: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Columns of XYZ, seen from another white."""
    gain = (BRADFORD @ white) / (BRADFORD @ matrix.sum(1))
    return np.linalg.inv(BRADFORD) @ np.diag(gain) @ BRADFORD @ matrix


def decode(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def encode(linear: np.ndarray) -> np.ndarray:
    linear = linear.clip(0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def expected(linear: np.ndarray, primaries) -> np.ndarray:
    """sRGB of linear light of some primaries."""
    ours = to_xyz(REC709)
    return encode(linear.astype(np.float64) @ (np.linalg.inv(ours) @ adapted(to_xyz(primaries), ours.sum(1))).T)


def fixed(*values: float) -> bytes:
    return b"".join(struct.pack(">i", round(value * 65536)) for value in values)


def gamma_curve(exponent: float) -> bytes:
    return b"curv\0\0\0\0" + struct.pack(">IH", 1, round(exponent * 256))


def table_curve(values: np.ndarray) -> bytes:
    return b"curv\0\0\0\0" + struct.pack(">I", len(values)) + np.round(values * 65535).astype(">u2").tobytes()


def parametric_curve(kind: int, *parameters: float) -> bytes:
    return b"para\0\0\0\0" + struct.pack(">HH", kind, 0) + fixed(*parameters)


def profile(primaries, curve: bytes, space: bytes = b"RGB ", matrix: bool = True, description: str = "test") -> bytes:
    """A display profile with a matrix and three equal curves (ICC.1:2001-04 and, for parametric curves, ICC.1:2010)."""
    columns, name = adapted(to_xyz(primaries), D50), description.encode() + b"\0"
    tags = {
        b"desc": b"desc\0\0\0\0" + struct.pack(">I", len(name)) + name + b"\0" * 78,
        b"cprt": b"text\0\0\0\0none\0",
        b"wtpt": b"XYZ \0\0\0\0" + fixed(*D50),
    }
    for k, channel in enumerate(b"rgb"):
        letter = bytes([channel])
        tags |= {letter + b"XYZ": b"XYZ \0\0\0\0" + fixed(*columns[:, k])} if matrix else {}
        tags |= {letter + b"TRC": curve}
    start, table, body = 128 + 4 + 12 * len(tags), b"", b""
    for tag, content in tags.items():
        table += tag + struct.pack(">II", start + len(body), len(content))
        body += content + b"\0" * (-len(content) % 4)
    version = 0x04200000 if curve.startswith(b"para") else 0x02100000
    header = struct.pack(">I4sI4s4s4s6H4s", start + len(body), b"none", version, b"mntr", space, b"XYZ ", *range(6), b"acsp")
    header += b"\0" * 28 + fixed(*D50)
    return header.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + body


SRGB_CURVES = {
    "parametric": parametric_curve(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045),
    "table": table_curve(decode(np.linspace(0, 1, 1024))),
}


def pixels() -> np.ndarray:
    """Colours of the whole cube, in codes of 8 bits."""
    return np.random.default_rng(2).integers(0, 256, (70, 80, 3)).astype(np.float32) / 255


def write(path, rgb: np.ndarray, kind=oiio.UINT8, icc: bytes = b"", **attributes):
    image = oiio.ImageBuf(np.ascontiguousarray(rgb, np.float32))
    for name, value in attributes.items():
        image.specmod().attribute(name.replace("__", ":"), value)
    if icc:
        image.specmod().attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(icc)}]"), np.frombuffer(icc, np.uint8))
    assert image.write(os.fspath(path), kind), image.geterror()
    return path


def write_png(path, rgb: np.ndarray, **chunks: bytes):
    """A PNG whose chunks are exactly those given."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    height, width, _ = rgb.shape
    rows = np.round(rgb * 255).astype(np.uint8).reshape(height, -1)
    data = zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows))
    parts = [(b"IHDR", struct.pack(">2I5B", width, height, 8, 2, 0, 0, 0)), *((k.encode(), v) for k, v in chunks.items())]
    parts += [(b"IDAT", data), (b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts))
    return path


@pytest.mark.parametrize("suffix", ["png", "tif", "jpg"])
def test_an_embedded_adobe_rgb_profile_is_honoured(tmp_path, suffix):
    rgb = pixels() if suffix != "jpg" else np.broadcast_to(np.float32([[200, 100, 50]]) / 255, (70, 80, 3))
    icc = profile(ADOBE, gamma_curve(ADOBE_GAMMA), description="Adobe RGB (1998)")
    photograph = read_photograph(write(tmp_path / f"a.{suffix}", rgb, icc=icc), 64)
    tolerance = 5e-4 if suffix != "jpg" else 0.015  # JPEG's own
    np.testing.assert_allclose(photograph.pixels, expected(rgb.astype(float) ** ADOBE_GAMMA, ADOBE), atol=tolerance)
    assert photograph.colorspace == "ICC profile 'Adobe RGB (1998)'"
    assert photograph.warning == ""
    assert np.abs(photograph.pixels - rgb).max() > 0.1


@pytest.mark.parametrize("curve", SRGB_CURVES.values(), ids=SRGB_CURVES)
def test_an_embedded_display_p3_profile_is_honoured(tmp_path, curve):
    rgb = pixels()
    photograph = read_photograph(write(tmp_path / "a.png", rgb, icc=profile(P3, curve)), 64)
    np.testing.assert_allclose(photograph.pixels, expected(decode(rgb), P3), atol=1e-3)


def test_littlecms_agrees_on_the_profile(tmp_path):
    """The same conversion by another engine, to its own sRGB."""
    cms = pytest.importorskip("PIL.ImageCms")
    from PIL import Image

    rgb = pixels()
    icc = profile(ADOBE, gamma_curve(ADOBE_GAMMA))
    image = Image.fromarray(np.round(rgb * 255).astype(np.uint8))
    other = cms.profileToProfile(image, cms.ImageCmsProfile(io.BytesIO(icc)), cms.createProfile("sRGB"), 1)
    found = read_photograph(write(tmp_path / "a.png", rgb, icc=icc), 64).pixels
    np.testing.assert_allclose(found, np.asarray(other) / 255, atol=2 / 255)


@pytest.mark.parametrize("curve", SRGB_CURVES.values(), ids=SRGB_CURVES)
def test_an_srgb_profile_changes_nothing(tmp_path, curve):
    rgb = pixels()
    photograph = read_photograph(write(tmp_path / "a.png", rgb, icc=profile(REC709, curve, description="sRGB")), 64)
    np.testing.assert_allclose(photograph.pixels, rgb, atol=1e-7)
    assert photograph.colorspace == f"{SRGB} (ICC profile 'sRGB')"


@pytest.mark.parametrize(
    ("icc", "message"),
    [
        (profile(REC709, gamma_curve(2.2), space=b"CMYK"), "its ICC profile is of CMYK colours, expected RGB"),
        (profile(REC709, gamma_curve(2.2), matrix=False), "its ICC profile has no matrix and curves"),
        (profile(REC709, gamma_curve(2.2))[:200], "its ICC profile has no matrix and curves"),
    ],
    ids=["cmyk", "no matrix", "cut short"],
)
def test_a_profile_that_cannot_be_honoured_is_told_and_the_colours_are_taken_as_srgb(tmp_path, icc, message):
    rgb = pixels()
    photograph = read_photograph(write(tmp_path / "a.tif", rgb, icc=icc), 64)
    assert photograph.warning.startswith(message)
    assert photograph.warning.endswith(f"its colours are taken as {SRGB}")
    assert "\n" not in photograph.warning
    np.testing.assert_allclose(photograph.pixels, rgb, atol=1e-7)


def test_evaluate_tells_it_too(tmp_path, solidgrain, toy_folder):
    photograph = write(tmp_path / "a.tif", pixels(), icc=profile(REC709, gamma_curve(2.2), space=b"CMYK"))
    outcome = solidgrain("evaluate", toy_folder, "--exemplar", photograph, "--slices", 1, "--threads", 1)
    assert outcome.code == 0
    assert f"warning: {photograph}: its ICC profile is of CMYK colours, expected RGB" in outcome.err


@pytest.mark.parametrize(
    ("chunks", "linear", "primaries"),
    [
        ({"cICP": bytes([12, 13, 0, 1])}, decode, P3),
        ({"cICP": bytes([12, 13, 0, 1]), "iCCP": b"x\0\0" + zlib.compress(profile(ADOBE, gamma_curve(2.2)))}, decode, P3),
        ({"iCCP": b"x\0\0" + zlib.compress(profile(ADOBE, gamma_curve(2.2)))}, lambda rgb: rgb ** (563 / 256), ADOBE),
        ({"gAMA": struct.pack(">I", 100000)}, lambda rgb: rgb, REC709),
        ({"gAMA": struct.pack(">I", 55556)}, lambda rgb: rgb**1.8, REC709),
    ],
)
def test_what_a_png_declares_is_honoured(tmp_path, chunks, linear, primaries):
    rgb = pixels()
    photograph = read_photograph(write_png(tmp_path / "a.png", rgb, **chunks), 64)
    np.testing.assert_allclose(photograph.pixels, expected(linear(rgb), primaries), atol=2e-3)


@pytest.mark.parametrize(
    "chunks",
    [
        {},
        {"sRGB": b"\0", "gAMA": struct.pack(">I", 45455)},
        {"gAMA": struct.pack(">I", 45455)},  # what writers of sRGB state for old readers
        {"cICP": bytes([1, 13, 0, 1])},
    ],
)
def test_an_srgb_png_is_untouched(tmp_path, chunks):
    rgb = pixels()
    photograph = read_photograph(write_png(tmp_path / "a.png", rgb, **chunks), 64)
    np.testing.assert_allclose(photograph.pixels, rgb, atol=1e-7)
    assert photograph[1:] == (SRGB, "")


def test_unknown_code_points_are_told(tmp_path):
    photograph = read_photograph(write_png(tmp_path / "a.png", pixels(), cICP=bytes([4, 4, 0, 1])), 64)
    assert "cICP chunk (4, 4, 0, 1) is of no colour space" in photograph.warning


def test_a_camera_that_says_not_srgb_without_a_profile_is_told(tmp_path):
    write(tmp_path / "a.jpg", pixels(), Exif__ColorSpace=65535)
    assert "Exif says that its colours are not sRGB" in read_photograph(tmp_path / "a.jpg", 64).warning
    write(tmp_path / "b.jpg", pixels(), Exif__ColorSpace=1)
    assert read_photograph(tmp_path / "b.jpg", 64).warning == ""


@pytest.mark.parametrize(
    ("header", "primaries", "colorspace"),
    [
        ({}, REC709, "lin_rec709_scene"),
        ({"colorInteropID": "lin_ap1_scene"}, ACES_AP1, "lin_ap1_scene"),
        ({"oiio:ColorSpace": "ACEScg"}, ACES_AP1, "ACEScg"),
        ({"chromaticities": ACES_AP1}, ACES_AP1, "linear, chromaticities 0.713, 0.293"),
        ({"chromaticities": WIDE}, WIDE, "linear, chromaticities 0.7, 0.3"),
        ({"colorInteropID": "unknown", "chromaticities": P3}, P3, "linear, chromaticities 0.68"),
    ],
)
def test_a_linear_exr_of_any_primaries_is_encoded_to_srgb(tmp_path, header, primaries, colorspace):
    linear = pixels() * 0.9
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, {"RGB": linear}).write(os.fspath(tmp_path / "a.exr"))
    photograph = read_photograph(tmp_path / "a.exr", 64)
    assert photograph.colorspace.startswith(colorspace)
    assert photograph.warning == ""
    np.testing.assert_allclose(photograph.pixels, expected(linear, primaries), atol=3e-4)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ({"oiio:ColorSpace": "house_wood"}, "'house_wood', which the OpenColorIO configuration does not know; set OCIO"),
        ({"chromaticities": (0.3, 0.3) * 3 + (0.31, 0.33)}, "of no colour space"),
        ({"chromaticities": (*REC709[:6], 0.3, 0.0)}, "of no colour space"),
    ],
)
def test_an_exr_of_no_known_space_is_told_and_taken_as_linear(tmp_path, header, message):
    linear = pixels()
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, {"RGB": linear}).write(os.fspath(tmp_path / "a.exr"))
    photograph = read_photograph(tmp_path / "a.exr", 64)
    assert message in photograph.warning
    np.testing.assert_allclose(photograph.pixels, encode(linear), atol=3e-4)


@pytest.mark.parametrize("kind", [oiio.FLOAT, oiio.DOUBLE], ids=str)
def test_a_float_file_that_declares_nothing_is_linear(tmp_path, kind):
    write(tmp_path / "linear.tif", np.full((64, 64, 3), 0.2140, np.float32), kind)
    photograph = read_photograph(tmp_path / "linear.tif", 64)
    np.testing.assert_allclose(photograph.pixels, 0.5, atol=1e-3)
    assert photograph.colorspace == "lin_rec709_scene"


CONFIG = """ocio_profile_version: 2
environment: {}
roles: {default: plate}
file_rules:
  - !<Rule> {name: Default, colorspace: default}
displays:
  none:
    - !<View> {name: Raw, colorspace: plate}
colorspaces:
  - !<ColorSpace> {name: plate, aliases: [lin_rec709_scene]}
  - !<ColorSpace>
    name: house_wood
    to_scene_reference: !<MatrixTransform> {matrix: [0.5,0,0,0, 0,0.25,0,0, 0,0,1,0, 0,0,0,1]}
"""


def test_a_studios_space_is_converted_by_the_running_configuration_and_standard_ones_need_none(tmp_path):
    (tmp_path / "studio.ocio").write_text(CONFIG)
    ones = np.ones((64, 64, 3), np.float32)
    for name in ("house_wood", "lin_ap1_scene"):
        header = {"type": OpenEXR.scanlineimage, "oiio:ColorSpace": name}
        OpenEXR.File(header, {"RGB": ones}).write(os.fspath(tmp_path / f"{name}.exr"))
    code = (
        "import sys; from solidgrain.train.photograph import read_photograph;"
        "[print(*read_photograph(path, 64).pixels[0, 0].round(3)) for path in sys.argv[1:]]"
    )
    command = [sys.executable, "-c", code, tmp_path / "house_wood.exr", tmp_path / "lin_ap1_scene.exr"]
    environment = {**os.environ, "OCIO": str(tmp_path / "studio.ocio")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["0.735 0.537 1.0", "1.0 1.0 1.0"]


def test_training_warns_and_records_what_the_colours_were_read_as(tmp_path, solidgrain):
    from solidgrain.train.run import open_run

    icc = profile(ADOBE, gamma_curve(ADOBE_GAMMA), description="Adobe RGB (1998)")
    write(tmp_path / "adobe.png", pixels(), icc=icc)
    write(tmp_path / "cmyk.png", pixels(), icc=profile(ADOBE, gamma_curve(2.2), matrix=False))
    flags = ("--iterations", "1", "--patch", "32", "--batch", "1", "--quiet")
    assert solidgrain("train", tmp_path / "adobe.png", "--out", tmp_path / "run", *flags).code == 0
    assert open_run(tmp_path / "run").source.colorspace == "ICC profile 'Adobe RGB (1998)'"
    outcome = solidgrain("train", tmp_path / "cmyk.png", "--out", tmp_path / "second", *flags)
    assert f"warning: {tmp_path / 'cmyk.png'}: its ICC profile has no matrix" in outcome.err
