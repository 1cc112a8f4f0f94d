"""What is written is what was evaluated: read back by OpenImageIO, OpenEXR, VTK and numpy at chosen voxels.

The volume has three different extents and a random texture, which has no symmetry: any swapped or mirrored axis shows.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
import pyvista
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOXML import vtkXMLImageDataReader

from solidgrain.bake.baker import bake
from solidgrain.bake.color import to_linear
from solidgrain.bake.plan import Plan
from solidgrain.bake.writers import PREVIEW, Output, make_output

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
    bake(plan_for(toy, make_output(tmp_path / "a.png", PREVIEW), tile="xy", size=(16, 16, 32)), toy)
    picture = oiio.ImageBuf(os.fspath(tmp_path / "a.png")).get_pixels(oiio.FLOAT)
    panels = [picture[:, start : start + 384] for start in (0, 396, 792)]
    across_z, across_y = panels[0], panels[1]
    assert np.array_equal(across_z[:192, :192], across_z[192:, 192:])
    assert np.array_equal(across_y[:, :192], across_y[:, 192:])
    assert not np.array_equal(across_y[:192], across_y[192:])


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
