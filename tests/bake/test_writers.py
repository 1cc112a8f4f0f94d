"""What is written is what was evaluated: read back by OpenImageIO, OpenEXR, VTK and numpy at chosen voxels.

The volume has three different extents and a random texture, which has no symmetry: any swapped or mirrored axis shows.
"""

from __future__ import annotations

import json
import os
import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
import pyvista
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOXML import vtkXMLImageDataReader

from solidgrain.bake.baker import bake
from solidgrain.bake.color import to_linear
from solidgrain.bake.plan import BASE_MEMORY, Plan
from solidgrain.bake.store import Store
from solidgrain.bake.writers import PREVIEW, Output, Volume, make_output, open_writer
from solidgrain.runtime.workers import Workers

SIZE = (7, 5, 19)  # x, y, z: more slices than one slab
ORIGIN, SPACING = (10.0, -20.0, 1000.0), (1.0, 0.5, 2.0)
VOXELS = [(0, 0, 0), (6, 0, 0), (0, 4, 0), (0, 0, 18), (6, 4, 18), (3, 1, 17)]


def plan_for(texture, *outputs: Output, tile: str = "", size: tuple[int, int, int] = SIZE, **changes) -> Plan:
    return Plan(
        source="toy",
        texture="toy",
        texture_sha256=texture.data.sha256,
        sampler_sha256=texture.data.sampler_sha256,
        precision="float32",
        seed=7,
        size=size,
        origin=ORIGIN,
        spacing=SPACING,
        tile=tile,
        outputs=outputs,
        **changes,
    )


def expected(texture, x: int, y: int, z: int) -> np.ndarray:
    """The colour at a voxel, asked of the texture point by point."""
    point = [o + (k + 0.5) * s for o, k, s in zip(ORIGIN, (x, y, z), SPACING, strict=True)]
    return texture.sample([point], seed=7)[0]


@pytest.fixture(scope="module")
def baked(toy, tmp_path_factory):
    """All formats in one pass."""
    folder = tmp_path_factory.mktemp("baked")
    outputs = [
        make_output(folder / "toy.####.exr", start=1),
        make_output(folder / "toy.vti", type="uint8"),
        make_output(folder / "float.vti", type="float32"),
        make_output(folder / "toy.npy"),
        make_output(folder / "toy.png", PREVIEW),
    ]
    result = bake(plan_for(toy, *outputs), toy)
    assert sorted(path.name for path in result.files) == sorted(
        path.name for path in folder.iterdir() if not path.name.endswith(".bake.json")
    )
    return folder


@pytest.mark.parametrize(("x", "y", "z"), VOXELS)
def test_exr_slices_read_by_openexr(baked, toy, x, y, z):
    with OpenEXR.File(os.fspath(baked / f"toy.{z + 1:04d}.exr")) as file:
        pixels = file.channels()["RGB"].pixels
        assert pixels.dtype == np.float16
        assert pixels.shape == (5, 7, 3)
        np.testing.assert_allclose(pixels[y, x], to_linear(expected(toy, x, y, z)), rtol=1e-3)


@pytest.mark.parametrize(("x", "y", "z"), VOXELS)
def test_exr_slices_read_by_openimageio(baked, toy, x, y, z):
    image = oiio.ImageBuf(os.fspath(baked / f"toy.{z + 1:04d}.exr"))
    assert image.spec().get_string_attribute("oiio:ColorSpace") == "lin_rec709_scene"
    srgb = oiio.ImageBufAlgo.colorconvert(image, "lin_rec709_scene", "srgb_rec709_scene")
    np.testing.assert_allclose(srgb.getpixel(x, y), expected(toy, x, y, z), atol=1e-3)


def test_exr_attributes_say_what_a_slice_is(baked, toy):
    with OpenEXR.File(os.fspath(baked / "toy.0005.exr")) as file:
        header = dict(file.header())  # the file's own is emptied when it closes
    assert oiio.ImageBuf(os.fspath(baked / "toy.0005.exr")).spec()["compression"] == "zip"
    assert header["colorInteropID"] == "lin_rec709_scene"
    assert header["solidgrain:slice"] == 4
    assert header["solidgrain:depth"] == 19
    assert header["solidgrain:seed"] == "7"
    assert header["solidgrain:model"] == toy.data.sampler_sha256
    assert tuple(header["solidgrain:origin"]) == ORIGIN
    assert tuple(header["solidgrain:spacing"]) == SPACING
    assert header["pixelAspectRatio"] == pytest.approx(SPACING[0] / SPACING[1])


def test_exr_pixels_of_a_shape_that_no_header_holds_are_called_square(solidgrain, toy_folder, tmp_path):
    outcome = solidgrain("bake", toy_folder, "--size", 2, "--spacing", "1e-4,1000,1", "--out", tmp_path / "a.####.exr")
    assert outcome.code == 0, outcome.err
    with OpenEXR.File(os.fspath(tmp_path / "a.0001.exr")) as file:
        header = dict(file.header())
    assert header["pixelAspectRatio"] == 1
    assert json.loads(header["solidgrain:json"])["spacing"] == [1e-4, 1000, 1]


@pytest.mark.parametrize(("x", "y", "z"), VOXELS)
@pytest.mark.parametrize(("name", "tolerance"), [("toy.vti", 0.5 / 255 + 1e-6), ("float.vti", 0)])
def test_vti_read_by_vtk_at_the_sampled_point(baked, toy, name, tolerance, x, y, z):
    image = pyvista.read(baked / name)
    assert image.dimensions == SIZE
    index = x + SIZE[0] * (y + SIZE[1] * z)
    point = [o + (k + 0.5) * s for o, k, s in zip(ORIGIN, (x, y, z), SPACING, strict=True)]
    np.testing.assert_allclose(image.points[index], point)
    scale = 255 if name == "toy.vti" else 1
    np.testing.assert_allclose(image.point_data["rgb"][index] / scale, expected(toy, x, y, z), atol=tolerance)
    assert image.field_data["color_encoding"] == ["srgb_rec709_scene"]


@pytest.mark.parametrize("compression", ["none", "zip", "zips", "piz", "dwaa"])
@pytest.mark.parametrize("kind", ["half", "float"])
def test_every_exr_compression_is_read_by_openimageio(toy, tmp_path, kind, compression):
    bake(plan_for(toy, make_output(tmp_path / "a.####.exr", type=kind, compression=compression, start=0)), toy)
    image = oiio.ImageBuf(os.fspath(tmp_path / "a.0017.exr"))
    assert image.spec().format == (oiio.HALF if kind == "half" else oiio.FLOAT)
    assert image.spec()["compression"].startswith(compression)
    level = toy.grid(SIZE[::-1], seed=7, origin=ORIGIN, spacing=SPACING)[17]
    tolerance = 0.02 if compression == "dwaa" else 6e-4 if kind == "half" else 1e-6
    np.testing.assert_allclose(image.get_pixels(oiio.FLOAT), to_linear(level), atol=tolerance)


def test_exr_channels_have_the_names_and_contents_asked_for(toy, tmp_path):
    channels = "albedo.R=r,albedo.G=g,albedo.B=b,A=one,height=luma"
    bake(plan_for(toy, make_output(tmp_path / "a.####.exr", type="float", channels=channels)), toy)
    image = oiio.ImageBuf(os.fspath(tmp_path / "a.0004.exr"))
    found = dict(zip(image.spec().channelnames, np.moveaxis(image.get_pixels(oiio.FLOAT), -1, 0), strict=True))
    level = to_linear(toy.grid(SIZE[::-1], seed=7, origin=ORIGIN, spacing=SPACING)[3])
    for k, name in enumerate(("albedo.R", "albedo.G", "albedo.B")):
        np.testing.assert_allclose(found[name], level[..., k], atol=1e-6)
    np.testing.assert_allclose(found["height"], level @ np.array([0.2126, 0.7152, 0.0722]), atol=1e-5)
    assert (found["A"] == 1).all()


@pytest.mark.parametrize("compression", ["none", "zlib"])
@pytest.mark.parametrize(("kind", "largest"), [("uint8", 255), ("uint16", 65535), ("float32", 1)])
def test_every_kind_of_vti_is_read_by_vtk_whole_and_in_part(toy, tmp_path, kind, largest, compression):
    bake(plan_for(toy, make_output(tmp_path / "a.vti", type=kind, compression=compression)), toy)
    grid = toy.grid(SIZE[::-1], seed=7, origin=ORIGIN, spacing=SPACING)
    whole = pyvista.read(tmp_path / "a.vti").point_data["rgb"].reshape(*SIZE[::-1], 3)
    assert whole.dtype == kind
    np.testing.assert_allclose(whole / largest, grid, atol=0.5 / largest + 1e-6 if largest > 1 else 0)
    reader = vtkXMLImageDataReader(file_name=os.fspath(tmp_path / "a.vti"))
    reader.UpdateExtent((0, SIZE[0] - 1, 0, SIZE[1] - 1, 11, 12))
    part = vtk_to_numpy(reader.GetOutput().GetPointData().GetArray("rgb")).reshape(-1, *SIZE[1::-1], 3)
    assert np.array_equal(part, whole[11:13])


def test_npy_is_the_grid_bit_for_bit(baked, toy):
    grid = toy.grid(SIZE[::-1], seed=7, origin=ORIGIN, spacing=SPACING)
    assert np.array_equal(np.load(baked / "toy.npy"), grid)
    for x, y, z in VOXELS:
        assert np.array_equal(grid[z, y, x], expected(toy, x, y, z))


def test_the_preview_shows_the_slices_and_the_faces(baked, toy):
    picture = oiio.ImageBuf(os.fspath(baked / "toy.png")).get_pixels(oiio.FLOAT)
    assert picture.shape == (384, 4 * 384 + 3 * 12, 3)
    middle = picture[192, 192]  # of the first panel: the middle of z = 9
    np.testing.assert_allclose(middle, expected(toy, 3, 2, 9), atol=1 / 255)
    assert picture[:, -384:].std() > 0.05


def test_two_bakes_are_the_same_bytes(baked, toy, tmp_path):
    outputs = [
        make_output(tmp_path / "toy.####.exr", start=1),
        make_output(tmp_path / "toy.vti"),
        make_output(tmp_path / "toy.png", PREVIEW),
    ]
    for path in bake(plan_for(toy, *outputs), toy).files:
        assert path.read_bytes() == (baked / path.name).read_bytes(), path.name


def test_a_tiled_volume_meets_itself_in_the_written_files(toy, tmp_path):
    """The step from the last voxel of the tile to its first is a step like any other, on every axis, in every format."""
    outputs = [make_output(tmp_path / "tile.npy"), make_output(tmp_path / "tile.vti"), make_output(tmp_path / "tile.####.exr")]
    bake(plan_for(toy, *outputs, tile="xyz"), toy)
    twice = toy.grid([2 * n for n in SIZE[::-1]], seed=7, origin=ORIGIN, spacing=SPACING, tile="xyz", period=SIZE[::-1])
    stack = [oiio.ImageBuf(os.fspath(tmp_path / f"tile.{z + 1:04d}.exr")).get_pixels(oiio.FLOAT) for z in range(SIZE[2])]
    volume = pyvista.read(tmp_path / "tile.vti").point_data["rgb"].reshape(*SIZE[::-1], 3) / 255
    for tile, expected, tolerance in (
        (np.load(tmp_path / "tile.npy"), twice, 1e-4),
        (volume, twice, 0.5 / 255 + 1e-4),
        (np.stack(stack), to_linear(twice), 6e-4),
    ):
        assert np.abs(expected - np.tile(tile, (2, 2, 2, 1))).max() <= tolerance


def test_the_preview_of_a_tile_shows_its_repeats(toy, tmp_path):
    plan = plan_for(toy, make_output(tmp_path / "a.png", PREVIEW), tile="xy", size=(16, 16, 32))
    bake(replace(plan, spacing=(1.0, 1.0, 1.0)), toy)
    picture = oiio.ImageBuf(os.fspath(tmp_path / "a.png")).get_pixels(oiio.FLOAT)
    panels = [picture[:, start : start + 384] for start in (0, 396, 792)]
    across_z, across_y = panels[0], panels[1]
    assert np.array_equal(across_z[:192, :192], across_z[192:, 192:])
    assert np.array_equal(across_y[:, :192], across_y[:, 192:])
    assert not np.array_equal(across_y[:192], across_y[192:])


@pytest.mark.parametrize(
    ("size", "spacing", "tile", "rows", "columns"),
    [
        ((1024, 4, 256), (1, 1, 1), "", 96, 384),
        ((600, 4, 512), (1, 1, 1), "", 328, 384),
        ((512, 4, 600), (1, 1, 1), "", 384, 328),
        ((1024, 4, 256), (1, 1, 1), "z", 192, 384),
        ((1024, 4, 256), (0.5, 1, 2), "", 384, 384),
    ],
)
def test_a_preview_has_the_proportions_of_the_volume_however_it_was_thinned(tmp_path, size, spacing, tile, rows, columns):
    """The slice across y of a volume that is bright, brighter towards its middle x: more than 512 voxels are thinned."""
    volume = Volume(size[::-1], ORIGIN, spacing, "toy", "", 0, tile)
    writer, store = open_writer(make_output(tmp_path / "a.png", PREVIEW), volume, Workers(1)), Store(tmp_path, size[2])
    ramp = 1 - 0.8 * np.abs(np.linspace(-1, 1, size[0], dtype=np.float32))
    store.append(0, size[2], writer.encode(0, np.broadcast_to(ramp[:, None], (*volume.shape, 3))))
    picture = oiio.ImageBuf(os.fspath(writer.assemble(store)[0].staged)).get_pixels(oiio.FLOAT)
    panel = picture[:, 396:780, 0]
    shown = panel > 0.15  # the background is darker
    assert (shown.any(1).sum(), shown.any(0).sum()) == (rows, columns)
    assert shown.sum() == rows * columns
    expected_columns = np.interp(np.arange(columns) / columns * size[0], np.arange(size[0]), ramp)
    assert np.abs(panel[192, shown[192]] - expected_columns).max() < 0.02


@pytest.mark.parametrize(
    ("name", "options", "samples"),
    [
        ("a.####.exr", {}, 1),
        ("a.####.exr", {"compression": "piz", "channels": "R=r,G=g,B=b,height=luma"}, 1),
        ("a.vti", {"type": "uint16", "dither": 1, "compression": "zlib"}, 1),
        ("a.vdb", {"type": "float"}, 1),
        ("a.####.exr", {}, 8),
        ("a.raw", {"dither": 1}, 8),
    ],
)
def test_a_bake_of_large_slices_holds_no_more_than_the_plan_says(tmp_path, monkeypatch, name, options, samples):
    """Slabs of one slice, which a thread has to itself; the texture costs nothing."""

    def slabs(shape, seed, slab, slices, **place):
        return ((z, np.full((slab, *shape[1:], 3), 0.5, np.float32)) for z in range(*slices, slab))

    monkeypatch.setattr("solidgrain.bake.writers.base.SLAB_BYTES", 1)
    texture = SimpleNamespace(slabs=slabs, workers=Workers(2), data=SimpleNamespace(sha256="0" * 64, sampler_sha256="0" * 64))
    side = 512 if samples == 1 else 192
    plan = plan_for(texture, make_output(tmp_path / name, **options), size=(side, side, 5), samples=samples)
    assert plan.slab == 1
    tracemalloc.start()
    try:
        bake(plan, texture)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak <= plan.memory - BASE_MEMORY


def test_a_nan_leaves_nothing_behind(toy, tmp_path, monkeypatch):
    from solidgrain.runtime import EvaluationError

    def slabs(*arguments, **keywords):
        yield 0, np.zeros((16, 5, 7, 3), np.float32)
        raise EvaluationError("the sampler returned NaN")

    monkeypatch.setattr(type(toy), "slabs", slabs)
    outputs = [make_output(tmp_path / name) for name in ("a.####.exr", "a.vti", "a.npy")]
    with pytest.raises(EvaluationError):
        bake(plan_for(toy, *outputs, make_output(tmp_path / "a.png", PREVIEW)), toy)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_nothing_behind_and_old_files_whole(toy, tmp_path, monkeypatch):
    """Space runs out when the last output is completed: the first ones must not have been replaced by then."""
    from solidgrain.runtime import BakeError

    outputs = [make_output(tmp_path / name) for name in ("a.####.exr", "a.vti", "a.npy")]
    bake(plan_for(toy, *outputs), toy)
    for path in tmp_path.iterdir():
        path.write_bytes(b"old")
    synced = os.fsync

    def full(number):
        file = Path(f"/proc/self/fd/{number}").readlink()
        if file.parent.name == ".a.npy.baking" and list(tmp_path.glob(".*/finished.json")):
            raise OSError(28, "No space left on device")
        synced(number)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(BakeError, match=r"a\.npy.*No space left on device"):
        bake(plan_for(toy, *outputs), toy)
    assert {path.read_bytes() for path in tmp_path.iterdir()} == {b"old"}
    assert len(list(tmp_path.iterdir())) == SIZE[2] + 2 + 3  # slices, two files, three manifests


def test_a_preview_that_a_full_disk_cut_short_is_noticed(baked, toy, tmp_path, monkeypatch):
    """OpenImageIO reports success there: `write` here does the same after writing half a file."""
    from solidgrain.runtime import BakeError

    half = (baked / "toy.png").read_bytes()[:4096]

    monkeypatch.setattr(oiio.ImageBuf, "write", lambda image, name: bool(Path(name).write_bytes(half)))
    with pytest.raises(BakeError, match="cannot write the preview"):
        bake(plan_for(toy, make_output(tmp_path / "a.png", PREVIEW)), toy)
    assert list(tmp_path.iterdir()) == []


def test_files_say_by_which_matrix_and_axes_their_colours_are_found_again(toy, tmp_path):
    matrix = ((0.0, -1.0, 0.0, 5.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.25), (0.0, 0.0, 0.0, 1.0))
    names = ("a.vti", "a.raw", "a.####.exr", "a.vdb")
    outputs = [make_output(tmp_path / name, **({"axes": "+x+z+y"} if name == "a.vti" else {})) for name in names]
    bake(plan_for(toy, *outputs, transform=matrix), toy)
    image = pyvista.read(tmp_path / "a.vti")
    assert image.field_data["axes"] == ["+x+z+y"]
    found = np.array(json.loads(image.field_data["transform"][0]))
    ours = image.points[:, [0, 2, 1]]
    again = toy.sample(ours @ found[:3, :3].T + found[:3, 3], 7)
    np.testing.assert_allclose(image.point_data["rgb"] / 255, again, atol=0.5 / 255 + 1e-3)
    assert json.loads((tmp_path / "a.raw.json").read_text())["transform"] == [list(row) for row in matrix]
    header = OpenEXR.File(os.fspath(tmp_path / "a.0001.exr")).header()
    assert json.loads(header["solidgrain:transform"]) == [list(row) for row in matrix]
    assert json.dumps(matrix).encode() in (tmp_path / "a.vdb").read_bytes()
