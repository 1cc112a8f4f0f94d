"""Colours arrive in the space that was asked for: against the standards' own matrices and curves, and foreign readers."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from solidgrain.bake.baker import bake
from solidgrain.bake.color import LINEAR, SRGB, color_options, from_srgb, quantize, to_half, to_linear, to_srgb, triangular
from solidgrain.bake.writers import make_output
from solidgrain.runtime import UsageError
from tests.bake.test_writers import expected, plan_for

# Rows of RGB from rows of linear Rec.709, Bradford to each white: computed from the primaries (below), not by a library.
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
P3 = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.3290)
REC2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
ACES_AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, 0.32168, 0.33767)
ACES_AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)

CONFIG = """ocio_profile_version: 2
environment: {}
roles: {default: raw, scene_linear: plate, matte_paint: halved}
file_rules:
  - !<Rule> {name: Default, colorspace: default}
displays:
  none:
    - !<View> {name: Raw, colorspace: raw}
colorspaces:
  - !<ColorSpace> {name: raw, isdata: true}
  - !<ColorSpace> {name: plate, aliases: [SOURCE]}
  - !<ColorSpace>
    name: halved
    aliases: [house]
    from_scene_reference: !<MatrixTransform> {matrix: [0.5,0,0,0, 0,0.25,0,0, 0,0,0.125,0, 0,0,0,1]}
  - !<ColorSpace>
    name: blinding
    from_scene_reference: !<MatrixTransform> {matrix: [1e6,0,0,0, 0,-1e6,0,0, 0,0,1,0, 0,0,0,1]}
"""


def to_xyz(primaries) -> np.ndarray:
    """Columns: XYZ of red, green and blue at full strength (SMPTE RP 177)."""
    red, green, blue, white = np.array(primaries, float).reshape(4, 2)
    columns = np.array([[x / y, 1, (1 - x - y) / y] for x, y in (red, green, blue)]).T
    return columns * np.linalg.solve(columns, [white[0] / white[1], 1, (1 - white.sum()) / white[1]])


def reference_linear(srgb: np.ndarray, primaries) -> np.ndarray:
    """IEC 61966-2-1, then Rec.709 to the primaries' RGB with a Bradford adaptation, in float64."""
    srgb = srgb.astype(np.float64)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    ours, theirs = to_xyz(REC709), to_xyz(primaries)
    gain = (BRADFORD @ theirs.sum(1)) / (BRADFORD @ ours.sum(1))
    adapted = np.linalg.inv(BRADFORD) @ np.diag(gain) @ BRADFORD
    return linear @ (np.linalg.inv(theirs) @ adapted @ ours).T


def colors(*shape: int) -> np.ndarray:
    return np.random.default_rng(5).random((*shape, 3), dtype=np.float32)


def in_process(config, code: str) -> subprocess.CompletedProcess[str]:
    """A fresh interpreter, since OpenImageIO reads $OCIO once."""
    environment = {**os.environ, "OCIO": str(config)}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)


def write_config(path, source: str = LINEAR):
    path.write_text(CONFIG.replace("SOURCE", source))
    return path


@pytest.mark.parametrize(
    ("name", "primaries"),
    [
        ("lin_rec709_scene", REC709),
        ("lin_ap1_scene", ACES_AP1),
        ("lin_ap0_scene", ACES_AP0),
        ("lin_rec2020_scene", REC2020),
        ("lin_p3d65_scene", P3),
    ],
)
def test_linear_spaces_agree_with_their_primaries(name, primaries):
    rgb = colors(40, 50)
    np.testing.assert_allclose(from_srgb(rgb, name), reference_linear(rgb, primaries), atol=2e-6)


def test_an_encoded_space_has_the_curve_of_its_standard():
    rgb = colors(40, 50)
    linear = reference_linear(rgb, P3)
    encoded = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear.clip(1e-9) ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(from_srgb(rgb, "srgb_p3d65_scene"), encoded, atol=5e-5)


def test_colours_outside_the_gamut_stay_for_floats_and_are_clipped_for_whole_numbers(tmp_path):
    config = oiio.ColorConfig.default_colorconfig()
    narrow = from_srgb(np.float32([[0, 1, 0]]), config.resolve("lin_adobergb_scene"))
    assert narrow.min() >= -1e-6  # Adobe RGB holds Rec.709
    code = (
        "import numpy as np; from solidgrain.bake.color import from_srgb, quantize;"
        "c = from_srgb(np.float32([[1, 1, 0]]), 'blinding'); print(c.tolist(), quantize(c, 'uint8').tolist())"
    )
    out = in_process(write_config(tmp_path / "studio.ocio"), code).stdout
    assert out.strip() == "[[1000000.0, -1000000.0, 0.0]] [[255, 0, 0]]"


@pytest.mark.parametrize("name", ["lin_ap1_scene", "srgb_p3d65_scene"])
def test_a_colour_is_converted_alike_in_any_shape_and_from_any_thread(name):
    slab = colors(3, 150, 200)  # more than one band of conversion
    whole = from_srgb(slab, name)
    with ThreadPoolExecutor(4) as pool:
        rows = list(pool.map(lambda row: from_srgb(row, name), slab.reshape(-1, 200, 3)))
    assert np.array_equal(np.stack(rows).reshape(slab.shape), whole)
    assert np.array_equal(from_srgb(slab[1, 7, 11:18], name), whole[1, 7, 11:18])
    assert np.array_equal(from_srgb(slab[2, 3, 4], name), whole[2, 3, 4])
    assert from_srgb(slab[:0], name).shape == (0, 150, 200, 3)


def test_srgb_is_untouched_and_linear_light_goes_there_and_back():
    rgb = colors(9)
    assert from_srgb(rgb, SRGB) is rgb
    np.testing.assert_allclose(to_srgb(to_linear(rgb)), rgb, atol=2e-7)


@pytest.mark.parametrize(
    ("given", "canonical"),
    [
        ("ACEScg", "lin_ap1_scene"),
        ("scene_linear", "lin_ap1_scene"),
        ("lin_srgb", LINEAR),
        ("sRGB - Texture", SRGB),
        ("ACEScct", "ocio:acescct_ap1_scene"),
    ],
)
def test_names_aliases_and_roles_become_the_interop_identifier(given, canonical):
    assert color_options(given)["colorspace"] == canonical


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("ACEScq", "--colorspace ACEScq: the configuration built into OpenImageIO has no such .*'ACEScg'"),
        ("Raw", "--colorspace Raw: holds data, not colour"),
    ],
)
def test_what_is_no_colour_space_is_refused_before_anything_is_evaluated(toy_folder, solidgrain, tmp_path, name, message):
    outcome = solidgrain("bake", toy_folder, "--size", "4", "--out", tmp_path / "a.####.exr", "--colorspace", name)
    assert outcome.code == 2
    assert re.search(message, outcome.error)
    assert list(tmp_path.iterdir()) == []


def test_a_studios_configuration_is_honoured(tmp_path):
    config = write_config(tmp_path / "studio.ocio")
    code = (
        "import numpy as np; from solidgrain.bake.color import color_options, from_srgb;"
        "print(color_options('house'), color_options('matte_paint') == color_options('house'), color_options('scene_linear'));"
        "print(from_srgb(np.ones(3, np.float32), 'halved').tolist())"
    )
    done = in_process(config, code)
    assert "'colorspace': 'halved', 'colorconfig': 'studio.ocio sha256:" in done.stdout, done.stderr
    assert f"True {{'colorspace': '{LINEAR}', 'colorconfig': ''}}" in done.stdout
    assert "[0.5, 0.25, 0.125]" in done.stdout


def test_a_configuration_that_knows_only_srgb_textures_serves_as_well(tmp_path):
    """Here the reference is sRGB-encoded: what matters is that the way starts from the encoded colours."""
    code = "import numpy as np; from solidgrain.bake.color import from_srgb; print(from_srgb(np.float32([0.5] * 3), 'halved'))"
    done = in_process(write_config(tmp_path / "texture.ocio", "sRGB - Texture"), code)
    assert done.stdout.strip() == "[0.25   0.125  0.0625]", done.stderr


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.ocio", None, "OCIO=.*missing.ocio: Requested non-existent"),
        ("broken.ocio", "nonsense", "OCIO=.*broken.ocio: Error reading"),
        ("lost.ocio", CONFIG, "has no way to it from Rec.709; give it a colour space lin_rec709_scene"),
    ],
)
def test_a_configuration_that_cannot_serve_is_refused_in_one_line(tmp_path, name, content, message):
    if content:
        (tmp_path / name).write_text(content)
    code = (
        "from solidgrain.bake.cli import main; import sys;"
        f"sys.exit(main(['bake', '--size', '4', '--out', r'{tmp_path / 'a.vti'}', '--colorspace', 'halved']))"
    )
    done = in_process(tmp_path / name, code)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert re.search(message, done.stderr)


def test_a_broken_configuration_does_not_matter_to_srgb_and_linear(tmp_path):
    code = (
        "from solidgrain.bake.color import *; print(color_options(SRGB), color_options(LINEAR), from_srgb(np.ones(3), LINEAR))"
    )
    assert in_process(tmp_path / "missing.ocio", code).returncode == 0


def test_a_plan_of_another_configuration_is_refused():
    planned = color_options("ACEScg")
    assert color_options(planned["colorspace"], planned["colorconfig"]) == planned
    with pytest.raises(UsageError, match=r"planned with the configuration studio\.ocio sha256:0, found ocio://default"):
        color_options("ACEScg", "studio.ocio sha256:0")


@pytest.mark.parametrize(
    ("name", "identifier", "primaries"),
    [
        ("ACEScg", "lin_ap1_scene", ACES_AP1),
        ("lin_rec2020_scene", "lin_rec2020_scene", REC2020),
        ("srgb_p3d65", "srgb_p3d65_scene", P3),
        ("ACEScct", "ocio:acescct_ap1_scene", None),
        (SRGB, SRGB, REC709),
    ],
)
def test_exr_says_its_colour_space_and_readers_agree(toy, tmp_path, name, identifier, primaries):
    bake(plan_for(toy, make_output(tmp_path / "a.####.exr", colorspace=name, type="float")), toy)
    path = os.fspath(tmp_path / "a.0004.exr")
    with OpenEXR.File(path) as file:
        header = dict(file.header())
        pixel = np.array(file.channels()["RGB"].pixels[1, 2])
    assert header["colorInteropID"] == identifier
    assert OpenEXR.checkColorMetadata(header) in (0, OpenEXR.ColorMetadataWarning.OK)
    assert ("chromaticities" in header) == (primaries is not None)
    if primaries is not None:
        np.testing.assert_allclose(header["chromaticities"], primaries, atol=1e-6)
    image = oiio.ImageBuf(path)
    assert image.spec().get_string_attribute("oiio:ColorSpace") == identifier
    back = oiio.ImageBufAlgo.colorconvert(image, identifier, SRGB)
    np.testing.assert_allclose(back.getpixel(2, 1), expected(toy, 2, 1, 3), atol=1e-4)
    if identifier == "lin_ap1_scene":
        np.testing.assert_allclose(pixel, reference_linear(expected(toy, 2, 1, 3), ACES_AP1), atol=2e-6)


def test_a_space_without_an_identifier_is_named_in_the_exr_and_half_stays_finite(toy_folder, tmp_path):
    config = write_config(tmp_path / "studio.ocio")
    code = "from solidgrain.bake.cli import main; import sys; sys.exit(main(sys.argv[1:]))"
    for name in ("house", "blinding"):
        command = ["bake", toy_folder, "--size", "4x3x2", "--out", tmp_path / f"{name}.####.exr", "--colorspace", name]
        environment = {**os.environ, "OCIO": str(config)}
        subprocess.run([sys.executable, "-W", "error", "-c", code, *command, "--quiet"], env=environment, check=True)
    with OpenEXR.File(os.fspath(tmp_path / "house.0001.exr")) as file:
        header = dict(file.header())
    assert "colorInteropID" not in header
    assert "chromaticities" not in header
    assert header["oiio:ColorSpace"] == header["solidgrain:colorspace"] == "halved"
    assert header["solidgrain:colorconfig"].startswith("studio.ocio sha256:")
    assert oiio.ImageBuf(os.fspath(tmp_path / "house.0001.exr")).spec()["oiio:ColorSpace"] == "halved"
    blinding = oiio.ImageBuf(os.fspath(tmp_path / "blinding.0001.exr")).get_pixels(oiio.FLOAT)
    assert blinding[..., 0].max() == 65504
    assert blinding[..., 1].min() == -65504


def test_half_floats_of_every_format_stay_finite_and_are_verified(toy_folder, tmp_path):
    """Of colours far above 1 half an ulp is far more than of those below, and some are more than any half-float."""
    config = write_config(tmp_path / "studio.ocio")
    code = "from solidgrain.bake.cli import main; import sys; sys.exit(main(sys.argv[1:]))"
    environment = {**os.environ, "OCIO": str(config)}
    outputs = [tmp_path / name for name in ("a.####.exr", "a.vdb", "a.raw", "a.dds", "a.atlas.exr", "a.vti")]
    types = ("--raw-type", "half", "--dds-type", "rgba16f", "--vti-type", "float32", "--colorspace", "blinding")
    outs = [word for output in outputs for word in ("--out", output)]
    for command in (["bake", toy_folder, "--size", "4x4x2", *outs, *types, "--quiet"], ["verify", *outputs]):
        ran = subprocess.run(
            [sys.executable, "-W", "error", "-c", code, *command], env=environment, capture_output=True, text=True, check=False
        )
        assert ran.returncode == 0, ran.stderr + ran.stdout
    raw = np.fromfile(tmp_path / "a.raw", "<f2")
    assert (raw.max(), raw.min()) == (65504, -65504)


def test_the_flags_reach_every_output_but_the_preview(toy_folder, solidgrain, tmp_path):
    outcome = solidgrain(
        *("bake", toy_folder, "--size", "4", "--dry-run", "--json", "--colorspace", "ACEScg", "--dither"),
        *("--out", tmp_path / "a.####.exr", "--out", tmp_path / "a.vti", "--preview", tmp_path / "a.png"),
    )
    assert outcome.code == 0, outcome.err
    text = json.dumps(json.loads(outcome.out))
    for name, space in (("a.####.exr", "lin_ap1_scene"), ("a.vti", "lin_ap1_scene"), ("a.png", SRGB)):
        assert f'{json.dumps(str(tmp_path / name))}: "{space}"' in text


def noise(z: int, *shape: int) -> np.ndarray:
    return triangular((*shape, 3), z)


def test_dither_depends_on_the_voxel_alone():
    whole = noise(100, 6, 20, 30)
    assert np.array_equal(np.concatenate([noise(100, 1, 20, 30), noise(101, 3, 20, 30), noise(104, 2, 20, 30)]), whole)
    assert np.array_equal(noise(100, 6, 7, 11), whole[:, :7, :11])
    assert np.array_equal(noise(100, 6, 20, 30), whole)


def test_dither_is_triangular():
    values = noise(0, 40, 60, 60).astype(np.float64)
    assert -1 < values.min() < -0.99 < 0.99 < values.max() < 1
    assert abs(values.mean()) < 3e-3
    assert abs(values.var() - 1 / 6) < 2e-3
    for bound in (0.25, 0.5, 0.75):
        assert abs((np.abs(values) < bound).mean() - (1 - (1 - bound) ** 2)) < 4e-3


@pytest.mark.parametrize("z", [0, 2**21 - 24])
def test_dither_has_no_structure(z):
    """Its correlation with itself, shifted by up to three voxels in any direction and across channels, is chance."""
    values = noise(z, 24, 48, 48).astype(np.float64)
    power = np.abs(np.fft.fftn(values, norm="ortho")) ** 2
    correlation = np.fft.ifftn(power).real / power.mean()
    near = correlation[np.ix_(range(-3, 4), range(-3, 4), range(-3, 4), range(3))]
    assert near[3, 3, 3, 0] == pytest.approx(1)  # the shift by nothing
    near[3, 3, 3, 0] = 0
    assert np.abs(near).max() < 5 / np.sqrt(values.size)
    assert power.ravel()[1:].max() < 25 * values.var()  # chance: ln of the number of frequencies, 12


def test_no_two_places_of_a_large_volume_share_their_dither():
    """Deep, high and wide volumes: no run of voxels along x has the noise of another."""
    deep = np.stack([triangular((1, 1, 4, 3), z)[0, 0] for z in range(0, 2**22, 2**10)]).reshape(2**12, -1)
    high = triangular((4, 2**13, 4, 3), 4092).reshape(2**15, -1)
    wide = np.lib.stride_tricks.sliding_window_view(triangular((1, 4, 2**13, 3), 0).reshape(-1), 12)[::3]
    for runs in (deep, high, wide):
        assert len(np.unique(runs, axis=0)) == len(runs)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("code", [0.1, 0.3, 0.6, 17.25, 100.5, 254.4, 254.9])
def test_dither_keeps_the_mean_between_two_codes(dtype, code):
    largest = np.iinfo(dtype).max
    code = code if code < 128 else code - 255 + largest
    flat = np.full((30, 60, 60, 3), code / largest, np.float32)
    written = quantize(flat, dtype, noise(3, 30, 60, 60)).astype(np.float64)
    assert abs(written.mean() - flat[0, 0, 0, 0] * np.float64(largest)) < 5 * 0.5 / np.sqrt(flat.size) + 1e-3
    assert np.abs(written - code).max() <= 1.5


def test_dither_leaves_black_black_and_white_white():
    values = noise(3, 8, 16, 16)
    assert not quantize(np.zeros_like(values), np.uint8, values).any()
    assert (quantize(np.ones_like(values), np.uint8, values) == 255).all()
    assert (quantize(np.full_like(values, 7), np.uint16, values) == 65535).all()


def test_a_dithered_file_is_the_same_however_it_is_cut_and_differs_from_a_plain_one(toy, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    outputs = [make_output(tmp_path / "plain.vti"), make_output(tmp_path / "dither.vti", dither=1)]
    bake(plan_for(toy, *outputs), toy)
    plain, dithered = (pyvista.read(tmp_path / f"{name}.vti").point_data["rgb"].astype(int) for name in ("plain", "dither"))
    assert 0 < np.abs(plain - dithered).max() <= 1
    grid = np.load(bake(plan_for(toy, make_output(tmp_path / "a.npy")), toy).files[0]).astype(np.float32)
    assert np.array_equal(quantize(grid, np.uint8, triangular(grid.shape, 0)).reshape(-1, 3), dithered)


def test_half_floats_are_numpys_bit_for_bit():
    draw = np.random.default_rng(5)
    for values in (
        draw.random(1_000_000, np.float32),
        np.exp2(draw.uniform(-14, 16, 1_000_000)).astype(np.float32).clip(None, 65503),
        np.exp2(draw.uniform(-30, 0, 100_000)).astype(np.float32),
        np.array([0.0, 1.0, 0.5, 2.0**-14, 65503.9, 70000.0, -7e4, np.inf], np.float32),
        (np.arange(2**16, dtype=np.uint32) * 4096 + 0x38800000).view(np.float32)[:40000],  # every tie
        np.empty((0, 3), np.float32),
    ):
        finite = values.clip(-65504, 65504)
        assert np.array_equal(to_half(values).view(np.uint16), finite.astype(np.float16).view(np.uint16))
