"""Presets for engines: axes that keep or change the handedness as the engine does, and refusals with a reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from solidgrain.bake.engines import ENGINES, axes_for, check_engine, unreal_guess
from solidgrain.bake.writers import Output, Volume, make_output
from solidgrain.bake.writers.atlas import Layout
from solidgrain.runtime import UsageError

# Where the engine's x, y and z point, as (right, forward, up) of one who stands in the scene; ours is x right, y forward, z up.
RIGHT, FORWARD, UP = np.eye(3, dtype=int)
OURS = np.stack([RIGHT, FORWARD, UP])
HANDED = {"unreal": -1, "unity": -1, "godot": 1}
UPWARDS = {"unreal": 2, "unity": 1, "godot": 1}


def volume_of(depth: int, height: int, width: int) -> Volume:
    return Volume((depth, height, width), (0, 0, 0), (1, 1, 1), "toy", "", 7, "")


def rows_of(axes: str) -> np.ndarray:
    """The texture's coordinates that each axis of a file runs along."""
    pairs = zip(axes[::2], axes[1::2], strict=True)
    return np.stack([(1 if sign == "+" else -1) * OURS["xyz".index(axis)] for sign, axis in pairs])


@pytest.mark.parametrize("engine", ENGINES)
def test_a_volume_keeps_its_shape_in_the_engines_space(engine):
    """A file's axes as a matrix: the determinant is that of the change of handedness, and up is up."""
    matrix = rows_of(axes_for(engine))
    assert round(np.linalg.det(matrix)) == HANDED[engine]
    assert np.array_equal(matrix[UPWARDS[engine]], UP)


def test_in_each_engine_x_y_and_z_are_what_they_are_there():
    assert np.array_equal(rows_of(axes_for("unreal")), [RIGHT, -FORWARD, UP])  # their x is ours, y is mirrored
    assert np.array_equal(rows_of(axes_for("unity")), [RIGHT, UP, FORWARD])  # x right, y up, z forward
    assert np.array_equal(rows_of(axes_for("godot")), [RIGHT, UP, -FORWARD])  # x right, y up, z towards the viewer


@pytest.mark.parametrize("kind", [".atlas.png", ".atlas.exr"])
def test_unity_reads_the_rows_of_an_image_from_the_bottom(kind):
    assert axes_for("unity", kind) == "+x-z+y"
    assert axes_for("unity", ".dds") == axes_for("unity") == "+x+z+y"
    assert {axes_for(engine, kind) == axes_for(engine) for engine in ("unreal", "godot")} == {True}


def test_an_unknown_engine_is_refused():
    with pytest.raises(UsageError, match=r"--for source: unknown engine; pick one of unreal, unity, godot$"):
        axes_for("source")


def refusal(engine: str, output: Output, *shape: int) -> str:
    with pytest.raises(UsageError) as caught:
        check_engine(engine, output, volume_of(*shape))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def dds(**options: str | int) -> Output:
    return make_output(Path("a.dds"), **options)


def atlas(columns: int = 0) -> Output:
    return make_output(Path("a.atlas.png"), columns=columns)


def test_unreal_takes_512_slices():
    check_engine("unreal", dds(), volume_of(512, 512, 2048))
    assert "a.dds has 513 voxels along its z, Unreal takes at most 512" in refusal("unreal", dds(), 513, 8, 8)


@pytest.mark.parametrize("engine", ["unity", "godot"])
def test_the_others_take_2048_voxels_a_side(engine):
    check_engine(engine, dds(), volume_of(2048, 2048, 2048))
    raw = make_output(Path("a.raw"))
    assert "a.raw has 2049 voxels along its x" in refusal(engine, raw, 8, 8, 2049)
    assert "a.raw has 2049 voxels along its z" in refusal(engine, raw, 2049, 8, 8)


def test_what_no_engine_loads_as_a_volume_is_not_limited():
    check_engine("unreal", make_output(Path("a.vti")), volume_of(4096, 8, 8))


@pytest.mark.parametrize("kind", ["bc1", "bc7"])
def test_unreal_imports_no_blocks(kind):
    assert f"a.dds is {kind}, Unreal imports no block-compressed DDS" in refusal("unreal", dds(type=kind), 8, 8, 8)
    check_engine("unity", dds(type=kind), volume_of(8, 8, 8))


@pytest.mark.parametrize("side", [1, 4, 16, 64, 256])
def test_unreal_finds_the_tiles_of_a_cube_with_a_square_number_of_slices(side):
    check_engine("unreal", atlas(), volume_of(side, side, side))


def test_unreal_finds_the_tiles_of_what_is_nearly_such_a_cube():
    check_engine("unreal", atlas(), volume_of(49, 64, 64))
    check_engine("unreal", atlas(), volume_of(64, 64, 128))


@pytest.mark.parametrize("shape", [(128, 128, 128), (32, 32, 32), (16, 64, 128), (4, 64, 64), (256, 64, 64)])
def test_atlases_that_unreal_would_cut_wrongly_are_refused(shape):
    assert "Unreal would guess their size wrongly; bake .dds" in refusal("unreal", atlas(), *shape)


def test_the_guess_is_that_of_unreals_source():
    assert unreal_guess(Layout(8, 8, 64, 64)) == (64, 64)
    assert unreal_guess(Layout(16, 8, 128, 128)) == (186, 93)  # sqrt(128) becomes 11
    assert unreal_guess(Layout(1, 1, 1, 4096)) == (0, 0)


def test_empty_tiles_are_refused_because_they_would_become_slices():
    message = refusal("unity", atlas(), 7, 16, 16)
    assert "has 3x3 tiles of 16x16 for 7 slices" in message
    assert "choose --atlas-columns that divides 7" in message
    check_engine("unity", atlas(columns=7), volume_of(7, 16, 16))


def test_mip_levels_of_an_atlas_are_refused_for_their_tiles_are_no_ones():
    output = make_output(Path("a.atlas.png"), mips="box")
    assert "a.atlas.png is an atlas, whose levels Unity makes itself" in refusal("unity", output, 16, 16, 16)
    check_engine("unity", dds(mips="box"), volume_of(16, 16, 16))


@pytest.mark.parametrize("engine", ["unity", "godot"])
def test_images_beyond_16384_pixels_a_side_are_refused(engine):
    check_engine(engine, atlas(), volume_of(256, 1024, 1024))
    assert "32x16 tiles of 1024x1024, 32768x16384 pixels" in refusal(engine, atlas(), 512, 1024, 1024)
