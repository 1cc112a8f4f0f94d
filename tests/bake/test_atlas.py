"""Atlases: OpenImageIO reads the image, the JSON file says where each slice is in it."""

from __future__ import annotations

import json
import os
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from solidgrain.bake.baker import bake
from solidgrain.bake.color import LINEAR, SRGB, to_linear
from solidgrain.bake.store import Store
from solidgrain.bake.writers import Volume, check_output, make_output, open_writer, output_bytes, output_files
from solidgrain.bake.writers.atlas import layout
from solidgrain.runtime import BakeError, UsageError
from solidgrain.runtime.workers import Workers
from tests.bake.test_writers import SIZE, VOXELS, expected, plan_for


def volume_of(*shape: int) -> Volume:
    depth, height, width = shape
    return Volume((depth, height, width), (0, 0, 0), (1, 1, 1), "toy", "", 7, "")


def bake_atlas(toy, path: Path, depth: int = SIZE[2], tile: str = "", **options: str | int) -> dict:
    """Bake an atlas. Returns its JSON file."""
    plan = replace(plan_for(toy, make_output(path, **options), tile=tile), size=(*SIZE[:2], depth))
    bake(plan, toy)
    return json.loads(path.with_suffix(".json").read_bytes())


def tile_of(path: Path, values: dict, z: int) -> np.ndarray:
    """Slice z [y, x, 3] as OpenImageIO reads it, found by the JSON file."""
    image = oiio.ImageBuf(os.fspath(path)).get_pixels(oiio.FLOAT)
    columns, rows = values["tiles"]
    width, height = values["tile_size"]
    assert image.shape == (rows * height, columns * width, 3)
    top, left = z // columns * height, z % columns * width
    return image[top : top + height, left : left + width]


@pytest.fixture(scope="module")
def baked(toy, tmp_path_factory):
    """Both kinds, 18 slices: 6 x 3 tiles."""
    folder = tmp_path_factory.mktemp("atlas")
    return folder, {
        "toy.atlas.png": bake_atlas(toy, folder / "toy.atlas.png", 18, tile="x"),
        "half.atlas.exr": bake_atlas(toy, folder / "half.atlas.exr", 18, tile="x"),
    }


@pytest.mark.parametrize(("x", "y", "z"), [(x, y, min(z, 17)) for x, y, z in VOXELS])
def test_slices_lie_in_rows_from_the_top_left(toy, tmp_path, x, y, z):
    for name, tolerance in (("a.atlas.png", 0.5 / 255 + 1e-6), ("b.atlas.exr", 2**-11)):
        values = bake_atlas(toy, tmp_path / name, 18)
        color = expected(toy, x, y, z)
        wanted = to_linear(color) if name.endswith("exr") else color
        np.testing.assert_allclose(tile_of(tmp_path / name, values, z)[y, x], wanted, atol=tolerance)


def test_the_images_are_8_bit_srgb_and_half_linear(baked):
    folder, values = baked
    for name, kind, colorspace in (("toy.atlas.png", "uint8", SRGB), ("half.atlas.exr", "half", LINEAR)):
        spec = oiio.ImageBuf(os.fspath(folder / name)).spec()
        assert str(spec.format) == kind
        assert spec.get_string_attribute("oiio:ColorSpace") == colorspace == values[name]["colorspace"]
        assert not spec.get_string_attribute("DateTime")


def test_the_json_file_describes_the_tiles(baked, toy):
    values = baked[1]["toy.atlas.png"]
    assert values["image"] == "toy.atlas.png"
    assert (values["size"], values["tiles"], values["tile_size"]) == ([7, 5, 18], [6, 3], [7, 5])
    assert values["wrap"] == ["repeat", "clamp", "clamp"]
    assert (values["axes"], values["engine"], values["import"]) == ("+x+y+z", "", {})
    assert (values["texture"], values["seed"], values["model"]) == ("toy", 7, toy.data.sampler_sha256)


GRIDS = {64: (8, 8), 256: (16, 16), 128: (16, 8), 18: (6, 3), 14: (7, 2), 7: (3, 3), 5: (3, 2), 1: (1, 1), 2: (2, 1), 3: (3, 1)}
CHOSEN = {7: (7, 1), 1: (1, 7), 4: (4, 2)}


@pytest.mark.parametrize(
    ("depth", "columns", "tiles"),
    [*((depth, 0, tiles) for depth, tiles in GRIDS.items()), *((7, columns, tiles) for columns, tiles in CHOSEN.items())],
)
def test_grids_are_as_square_as_the_slices_fill_them(depth, columns, tiles):
    output = make_output(Path("a.atlas.png"), columns=columns)
    found = layout(output, volume_of(depth, 5, 7))
    assert (found.columns, found.rows) == tiles


def test_seven_slices_leave_two_tiles_black(toy, tmp_path):
    values = bake_atlas(toy, tmp_path / "a.atlas.png", 7)
    assert values["tiles"] == [3, 3]
    for z in range(7):
        color = expected(toy, 6, 4, z)
        np.testing.assert_allclose(tile_of(tmp_path / "a.atlas.png", values, z)[4, 6], color, atol=0.51 / 255)
    for z in (7, 8):
        assert not tile_of(tmp_path / "a.atlas.png", values, z).any()


def test_columns_can_be_chosen(toy, tmp_path):
    values = bake_atlas(toy, tmp_path / "a.atlas.exr", 7, columns=2)
    assert values["tiles"] == [2, 4]
    color = to_linear(expected(toy, 3, 1, 5))
    np.testing.assert_allclose(tile_of(tmp_path / "a.atlas.exr", values, 5)[1, 3], color, atol=2**-11)


def test_two_bakes_are_the_same_bytes(baked, toy, tmp_path):
    for name in baked[1]:
        bake_atlas(toy, tmp_path / name, 18, tile="x")
        for path in output_files(make_output(tmp_path / name), volume_of(18, 5, 7)):
            assert path.read_bytes() == (baked[0] / path.name).read_bytes()


def test_both_files_are_within_the_estimate(baked):
    for name in baked[1]:
        output, volume = make_output(baked[0] / name), volume_of(18, 5, 7)
        assert sum(path.stat().st_size for path in output_files(output, volume)) <= output_bytes(output, volume)


@pytest.mark.parametrize("kind", ["png", "exr"])
def test_noise_is_within_the_estimate_too(tmp_path, kind):
    """What no compressor makes smaller."""
    slab = np.random.default_rng(3).random((16, 96, 96, 3), np.float32)
    output, volume = make_output(tmp_path / f"a.atlas.{kind}"), volume_of(16, 96, 96)
    store, writer = Store(tmp_path, 16), open_writer(output, volume, Workers(2))
    store.append(0, 16, writer.encode(0, slab))
    finished = writer.assemble(store)
    assert sum(file.staged.stat().st_size for file in finished) <= output_bytes(output, volume)
    again = {file.final.name: file.staged.read_bytes() for file in finished}
    assert {file.final.name: file.staged.read_bytes() for file in writer.assemble(store)} == again  # as after a kill


def test_assembling_holds_one_row_of_tiles(tmp_path):
    """Four times the depth takes no more memory."""

    def peak(depth: int) -> int:
        folder = tmp_path / str(depth)
        folder.mkdir()
        writer = open_writer(make_output(folder / "a.atlas.png", columns=4), volume_of(depth, 64, 64), Workers(1))
        store = Store(folder, depth)
        for z in range(depth):
            store.append(z, 1, writer.encode(z, np.full((1, 64, 64, 3), z / depth, np.float32)))
        tracemalloc.start()
        try:
            writer.assemble(store)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    row = 4 * 64 * 64 * 3
    shallow, deep = peak(16), peak(64)
    assert shallow < 6 * row + 200_000
    assert deep < 1.5 * shallow


@pytest.mark.parametrize(("name", "dither"), [("a.atlas.png", 0), ("a.atlas.png", 1), ("a.atlas.exr", 0)])
def test_a_probe_finds_the_colours_within_its_bound(toy, tmp_path, name, dither):
    output = make_output(tmp_path / name, dither=dither)
    bake(plan_for(toy, output), toy)
    colors, bound = open_writer(output, plan_for(toy).volume, Workers(1)).probe(np.array(VOXELS))
    wanted = np.array([expected(toy, *voxel) for voxel in VOXELS])
    assert np.abs(colors - (to_linear(wanted) if name.endswith("exr") else wanted)).max() <= bound < 0.01


def test_an_atlas_that_a_full_disk_cut_short_is_noticed(baked, toy, tmp_path, monkeypatch):
    """OpenImageIO may report success there: here its file is cut in half before it is read back."""
    opened = oiio.ImageInput.open

    def cut(name, *rest):
        os.truncate(name, Path(name).stat().st_size // 2)
        return opened(name, *rest)

    monkeypatch.setattr(oiio.ImageInput, "open", cut)
    with pytest.raises(BakeError, match=r"a\.atlas\.exr: cannot read the atlas .*free space"):
        bake_atlas(toy, tmp_path / "a.atlas.exr")
    assert list(tmp_path.iterdir()) == []


def test_more_columns_than_slices_are_refused():
    with pytest.raises(UsageError, match=r"--atlas-columns 8: a\.atlas\.png has 7 slices; use that at most$"):
        check_output(make_output(Path("a.atlas.png"), columns=8), volume_of(7, 5, 7))


def test_images_that_no_reader_opens_are_refused():
    with pytest.raises(UsageError, match=r"1024x1 tiles make an image of 1048576x1024 pixels, at most 1000000 a side"):
        check_output(make_output(Path("a.atlas.png"), columns=1024), volume_of(1024, 1024, 1024))


@pytest.mark.parametrize(
    ("engine", "settings"),
    [
        ("unity", {"Texture Shape": "3D", "Columns": 6, "Rows": 3, "Max Size": 64, "sRGB (Color Texture)": True}),
        ("godot", {"Import As": "Texture3D", "slices/horizontal": 6, "slices/vertical": 3}),
        ("unreal", {"Source2DTileSizeX": 7, "Source2DTileSizeY": 5, "SRGB": True}),
    ],
)
def test_the_json_file_has_the_import_settings_of_the_engine(toy, tmp_path, engine, settings):
    values = bake_atlas(toy, tmp_path / "a.atlas.png", 18, engine=engine)
    assert (values["engine"], values["import"]) == (engine, settings)
