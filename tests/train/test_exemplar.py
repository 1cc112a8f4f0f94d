"""Photographs of every kind are read, or refused in one line."""

from __future__ import annotations

import os
import shutil

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from solidgrain.runtime import ExemplarError
from solidgrain.train import exemplar
from solidgrain.train.exemplar import (
    FRAMED,
    MIRRORED,
    draw_patches,
    edge_step,
    measure_grain,
    mirror_symmetry,
    nonstationarity,
    unfolded,
)
from solidgrain.train.photograph import read_exemplar, read_photograph, scaled
from solidgrain.train.settings import preset
from tests.train.conftest import blotches


def write(path, pixels, kind=oiio.UINT8, **attributes):
    image = oiio.ImageBuf(np.ascontiguousarray(pixels, np.float32))
    for name, value in attributes.items():
        image.specmod().attribute(name, value)
    assert image.write(os.fspath(path), kind), image.geterror()
    return path


@pytest.mark.parametrize(
    ("name", "channels", "kind", "tolerance"),
    [
        ("rgb.png", 3, oiio.UINT8, 0.5 / 255),
        ("rgb16.png", 3, oiio.UINT16, 0.5 / 65535),
        ("rgba.png", 4, oiio.UINT8, 0.5 / 255),
        ("grey.png", 1, oiio.UINT8, 0.5 / 255),
        ("grey16.tif", 1, oiio.UINT16, 0.5 / 65535),
        ("greyalpha.png", 2, oiio.UINT8, 0.5 / 255),
        ("rgb.tif", 3, oiio.FLOAT, 1e-6),
    ],
)
def test_eight_and_sixteen_bit_grey_and_alpha(tmp_path, name, channels, kind, tolerance):
    pixels = blotches(70, 90)
    if channels in {2, 4}:
        pixels = np.concatenate([pixels[..., : channels - 1], np.ones((70, 90, 1), np.float32)], axis=-1)
    pixels = pixels[..., :channels]
    if name == "rgb.tif":
        write(tmp_path / name, pixels, kind, **{"oiio:ColorSpace": "srgb_rec709_scene"})
    else:
        write(tmp_path / name, pixels, kind)
    exemplar = read_exemplar(tmp_path / name, 64)
    assert exemplar.shape == (70, 90, 3)
    assert exemplar.dtype == np.float32
    if name != "rgb.tif":
        wanted = pixels[..., :3] if channels >= 3 else np.repeat(pixels[..., :1], 3, axis=-1)
        np.testing.assert_allclose(exemplar, wanted, atol=tolerance + 1e-6)


def test_colours_are_not_multiplied_by_alpha(tmp_path):
    pixels = np.full((64, 64, 4), 200 / 255, np.float32)
    pixels[..., 3] = 128 / 255
    image = oiio.ImageBuf(pixels)
    image.specmod().attribute("oiio:UnassociatedAlpha", 1)
    assert image.write(os.fspath(tmp_path / "rgba.png"), oiio.UINT8)
    assert read_exemplar(tmp_path / "rgba.png", 64)[0, 0, 0] == pytest.approx(200 / 255, abs=1 / 255)
    assert "is transparent in places" in read_photograph(tmp_path / "rgba.png", 64).warning
    write(tmp_path / "opaque.png", np.ones((64, 64, 4)))
    assert read_photograph(tmp_path / "opaque.png", 64).warning == ""


def layered(path, **channels):
    """An EXR with a constant value in each channel."""
    spec = oiio.ImageSpec(64, 64, len(channels), oiio.FLOAT)
    spec.channelnames = [name.replace("_", ".") for name in channels]
    image = oiio.ImageBuf(spec)
    oiio.ImageBufAlgo.fill(image, list(channels.values()))
    assert image.write(os.fspath(path)), image.geterror()
    return path


@pytest.mark.parametrize(
    "others", [{"N_X": 0.9, "N_Y": 0.9, "N_Z": 0.9}, {"height": 0.9, "A_id": 0.9}, {"albedo_A": 0.2}, {"B": 0.7}]
)
def test_of_an_exr_with_layers_the_colours_are_read(tmp_path, others):
    """Whatever their place: OpenImageIO sorts channels by the names of their layers."""
    path = layered(tmp_path / "a.exr", **{"albedo_R": 1.0, "albedo_G": 0.0, "albedo_B": 1.0}, **others)
    photograph = read_photograph(path, 64)
    np.testing.assert_allclose(photograph.pixels[5, 7], [1, 0, 1])
    assert ("transparent" in photograph.warning) == ("albedo_A" in others)


def test_colours_of_no_layer_count_first(tmp_path):
    path = layered(tmp_path / "a.exr", a_R=0.5, a_G=0.5, a_B=0.5, b_R=0.5, b_G=0.5, b_B=0.5, R=1.0, G=1.0, B=0.0)
    np.testing.assert_allclose(read_exemplar(path, 64)[0, 0], [1, 1, 0])


@pytest.mark.parametrize("names", [("N_X", "N_Y", "N_Z"), ("Y", "BY", "RY"), ("a_R", "a_G", "a_B", "b_R", "b_G", "b_B")])
def test_an_exr_whose_colours_are_in_doubt_is_refused_with_its_channels(tmp_path, names):
    with pytest.raises(ExemplarError, match=r"a\.exr: channels .*, expected R, G and B, of one layer at most, or grey"):
        read_exemplar(layered(tmp_path / "a.exr", **dict.fromkeys(names, 0.5)), 64)


def test_a_gif_is_a_photograph_too(tmp_path):
    write(tmp_path / "a.gif", np.ones((64, 64, 3)))
    photograph = read_photograph(tmp_path / "a.gif", 64)
    assert (photograph.pixels.min(), photograph.warning) == (1, "")


@pytest.mark.parametrize("suffix", ["ppm", "pgm"])
def test_what_the_reader_says_of_all_portable_pixmaps_is_no_declaration(tmp_path, suffix):
    write(tmp_path / f"a.{suffix}", np.full((64, 64, 3 if suffix == "ppm" else 1), 100 / 255))
    photograph = read_photograph(tmp_path / f"a.{suffix}", 64)
    assert photograph.pixels.max() == pytest.approx(100 / 255)
    assert (photograph.colorspace, photograph.warning) == ("srgb_rec709_scene", "")


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_a_photograph_is_turned_as_its_orientation_says(tmp_path, suffix):
    shown = np.zeros((80, 64, 3))
    shown[:40, :32] = 1  # bright at the top left
    stored = {0: shown, 1: shown, 2: shown[:, ::-1], 3: np.rot90(shown, 2), 4: shown[::-1], 5: shown.swapaxes(0, 1)}
    stored |= {6: np.rot90(shown, 1), 7: np.rot90(shown, 2).swapaxes(0, 1), 8: np.rot90(shown, -1), 9: shown}
    for orientation, pixels in stored.items():
        path = write(tmp_path / f"{orientation}.{suffix}", pixels, Orientation=orientation)
        np.testing.assert_allclose(read_exemplar(path, 64), shown, atol=0.02, err_msg=str(orientation))


def test_cmyk_is_converted(tmp_path):
    image = oiio.ImageBuf(oiio.ImageSpec(80, 80, 4, "uint8"))
    oiio.ImageBufAlgo.fill(image, (0.0, 1.0, 1.0, 0.0))  # no cyan, all magenta and yellow, no black: red
    image.specmod().channelnames = ("C", "M", "Y", "K")
    image.specmod().attribute("tiff:PhotometricInterpretation", 5)
    image.specmod().attribute("tiff:ColorSpace", "CMYK")
    if not image.write(os.fspath(tmp_path / "cmyk.tif")) or "CMYK" not in oiio.ImageBuf(
        os.fspath(tmp_path / "cmyk.tif")
    ).spec().get_string_attribute("tiff:ColorSpace"):
        pytest.skip(f"this OpenImageIO cannot write CMYK: {image.geterror()}")
    red = read_exemplar(tmp_path / "cmyk.tif", 64).mean((0, 1))
    assert red[0] > 0.8
    assert max(red[1], red[2]) < 0.3


def test_linear_files_are_encoded(tmp_path):
    write(tmp_path / "linear.exr", np.full((64, 64, 3), 0.5), oiio.HALF)
    assert read_exemplar(tmp_path / "linear.exr", 64)[0, 0, 0] == pytest.approx(0.7354, abs=1e-3)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_a_truncated_file_is_refused(tmp_path, suffix):
    path = write(tmp_path / f"cut.{suffix}", blotches(200, 200))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ExemplarError, match="damaged or cut short"):
        read_exemplar(path, 64)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.png", None, "no such file"),
        ("empty.png", b"", "empty"),
        ("text.png", b"hello", "not readable"),
        ("text.txt", b"hello", "not readable"),
    ],
)
def test_a_file_that_is_no_photograph_is_refused(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ExemplarError, match=message):
        read_exemplar(tmp_path / name, 64)


def test_a_file_whose_name_is_no_text_is_refused(tmp_path, photograph):
    strange = os.fsencode(tmp_path) + b"/caf\xe9.png"
    shutil.copy(photograph, strange)
    with pytest.raises(ExemplarError, match=r"the name is not UTF-8, .* rename it"):
        read_exemplar(os.fsdecode(strange), 64)


def test_a_tiny_photograph_is_refused_with_the_size_that_is_needed(tmp_path):
    write(tmp_path / "tiny.png", blotches(64, 63))
    with pytest.raises(ExemplarError, match="63x64 pixels, expected at least 64x64"):
        read_exemplar(tmp_path / "tiny.png", 64)


def test_a_huge_photograph_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "huge.png"
    assert oiio.ImageBuf(oiio.ImageSpec(8193, 8193, 1, "uint8")).write(os.fspath(path))
    with pytest.raises(ExemplarError, match="at most 64 megapixels"):
        read_exemplar(path, 64)


def test_patches_come_from_the_exemplar_flipped_and_transposed(photograph):
    image = torch.from_numpy(read_exemplar(photograph, 64)).permute(2, 0, 1)
    generator = torch.Generator().manual_seed(0)
    patches = draw_patches(image, preset("fast", batch=32), generator)
    assert patches.shape == (32, 3, 64, 64)
    crops = {image[:, y : y + 64, x : x + 64].sum().item() for y in range(17) for x in range(33)}
    assert all(min(abs(patch.sum().item() - crop) for crop in crops) < 0.05 for patch in patches)


def test_upright_patches_are_crops_as_they_are(photograph):
    image = torch.from_numpy(read_exemplar(photograph, 64)).permute(2, 0, 1)
    patches = draw_patches(image, preset("fast", batch=32, grain="x", upright=True), torch.Generator().manual_seed(0))
    crops = torch.stack([image[:, y : y + 64, x : x + 64] for y in range(17) for x in range(33)])
    assert all((crops == patch).flatten(1).all(1).any() for patch in patches)


def test_the_grain_of_stripes_is_along_them():
    draw = np.random.default_rng(0)
    rows = np.repeat(np.convolve(draw.random(260), np.ones(5) / 5, "valid")[:, None], 256, axis=1)
    stripes = np.stack([rows + 0.2 * draw.random(rows.shape)] * 3, -1).astype(np.float32)
    assert measure_grain(stripes).axis == "x"
    assert measure_grain(stripes.transpose(1, 0, 2)).axis == "y"
    assert measure_grain(stripes).ratio < 0.2


def test_the_grain_of_a_large_photograph_is_that_of_its_middle(monkeypatch):
    monkeypatch.setattr(exemplar, "CORRELATED", 64)
    rows = np.repeat(np.random.default_rng(0).random((128, 1, 1)), 192, axis=1)
    across = np.broadcast_to(np.random.default_rng(1).random((1, 192, 1)), rows.shape).copy()
    across[32:96, 64:128] = rows[32:96, 64:128]
    assert measure_grain(across.astype(np.float32)).axis == "x"


def test_a_photograph_is_not_enlarged_beyond_all_bounds():
    with pytest.raises(ExemplarError, match="makes 64000x32000 pixels of the photograph, expected at most 64 megapixels"):
        scaled(blotches(32, 64), 0.001)


def test_nonstationarity_tells_a_gradient_from_an_even_texture():
    even = blotches(128, 128)
    gradient = even * 0.3 + np.linspace(0, 0.7, 128, dtype=np.float32)[:, None, None]
    assert nonstationarity(even) < 0.3 < nonstationarity(gradient)


@pytest.mark.parametrize("width", [1, 4])
def test_a_frame_is_a_step_near_an_edge_that_nothing_beside_it_comes_near(width):
    whole = 0.4 + 0.2 * blotches(128, 160)
    framed = whole.copy()
    framed[:, -width:] = 0
    assert edge_step(whole) < 2 < FRAMED < edge_step(framed)
    assert edge_step(np.full((64, 64, 3), 0.5, np.float32)) == 0


@pytest.mark.parametrize("cropped", [0, 1, 3])
def test_a_mirrored_photograph_is_unfolded_to_one_side(cropped):
    side = blotches(90, 130)
    assert unfolded(side, 32) is side
    once = np.concatenate([side, side[:, ::-1]], axis=1)[:, cropped:]
    twice = np.concatenate([once, once[::-1]], axis=0)[cropped:]
    for mirrored, shape in ((once, (90, 130 - 2)), (twice, (90 - 2, 130 - 2))):
        assert mirror_symmetry(mirrored) > 2 * MIRRORED
        found = unfolded(mirrored, 32)
        np.testing.assert_allclose(found.shape[:2], shape, atol=2)
        np.testing.assert_array_equal(found, mirrored[: found.shape[0], : found.shape[1]])


def test_what_was_mirrored_twice_is_unfolded_twice_but_not_below_the_smallest():
    side = blotches(80, 80)
    mirrored = np.concatenate([side, side[:, ::-1]] * 2, axis=1)
    assert unfolded(mirrored, 64).shape == (80, 77, 3)
    assert unfolded(mirrored, 90).shape == (80, 158, 3)


def no_mirror_images():
    rows = np.random.default_rng(0).random((96, 1, 1), np.float32) + 0.3 * blotches(96, 96)
    weave = np.add.outer(*2 * [np.sin(2 * np.pi / 7 * np.arange(160))])[..., None] + 0.1 * blotches(160, 160)
    return {
        "even": blotches(90, 130),
        "small": blotches(32, 40),
        "rows": rows,
        "columns": rows.transpose(1, 0, 2),
        "framed": np.pad(0.4 + 0.2 * blotches(90, 90), ((4, 4), (4, 4), (0, 0)), constant_values=1),
        "weave": weave.astype(np.float32),
        "plain": np.full((96, 96, 3), 0.5, np.float32),
    }


@pytest.mark.parametrize("kind", no_mirror_images())
def test_what_only_looks_alike_on_both_sides_is_no_mirror_image(kind):
    exemplar = no_mirror_images()[kind]
    assert mirror_symmetry(exemplar) < MIRRORED
    assert unfolded(exemplar, 15) is exemplar


def test_photographs_are_no_mirror_images_framed_or_not_and_their_halves_beside_their_own_are(exemplars, tmp_path):
    """Of stones, woods and rusts, mirrored ones as a JPEG of quality 75, which leaves little of a faint wood."""
    natural, mirrored = [], []
    for photograph in sorted(exemplars.glob("*128/*.png")):
        pixels = read_exemplar(photograph, 64)
        half = pixels[:, : pixels.shape[1] // 2]
        tile = write(tmp_path / "tile.jpg", np.concatenate([half, half[:, ::-1]], axis=1), compression="jpeg:75")
        framed = np.pad(pixels[2:-2, 2:-2], ((2, 2), (2, 2), (0, 0)), constant_values=1)
        natural += [mirror_symmetry(pixels), mirror_symmetry(framed)]
        mirrored.append(mirror_symmetry(read_exemplar(tile, 64)))
    assert len(mirrored) > 200
    assert max(natural) < 0.5 * MIRRORED
    assert [figure > MIRRORED for figure in mirrored].count(False) <= 1
    assert [figure > 3 * MIRRORED for figure in mirrored].count(False) <= 3
