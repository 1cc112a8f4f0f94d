"""Mip levels are the level above them, filtered in three dimensions and in linear light."""

from __future__ import annotations

import os

import numpy as np
import OpenImageIO as oiio
import pytest

from solidgrain.bake.baker import bake
from solidgrain.bake.color import to_linear, to_srgb
from solidgrain.bake.writers import make_output
from solidgrain.bake.writers.mips import filtered, level_output, level_volumes, taps
from solidgrain.runtime import load
from tests.bake.test_writers import plan_for


def box(volume: np.ndarray) -> np.ndarray:
    """Halved by the mean of 2x2x2 voxels: what a box filter is where all extents are even."""
    z, y, x = (extent // 2 for extent in volume.shape[:3])
    return volume.reshape(z, 2, y, 2, x, 2, 3).mean((1, 3, 5))


def kaiser(volume: np.ndarray, axis: int, wrap: bool) -> np.ndarray:
    """The windowed sinc written out, voxel by voxel along one axis."""
    source = np.moveaxis(volume, axis, 0).astype(np.float64)
    count = len(source)
    result = np.zeros((count // 2, *source.shape[1:]))
    for j in range(count // 2):
        total = 0.0
        for i in range(-12, count + 12):
            distance = (i + 0.5) / 2 - (j + 0.5)
            if abs(distance) < 3:
                weight = np.sinc(distance) * np.i0(4 * np.sqrt(1 - (distance / 3) ** 2)) / np.i0(4)
                result[j] += weight * source[i % count if wrap else min(max(i, 0), count - 1)]
                total += weight
        result[j] /= total
    return np.moveaxis(result, 0, axis)


def test_a_box_level_is_the_mean_of_eight_voxels_in_linear_light(toy, tmp_path):
    bake(plan_for(toy, make_output(tmp_path / "a.npy", mips="box"), size=(16, 8, 24)), toy)
    above = to_linear(np.load(tmp_path / "a.npy"))
    for level in (1, 2, 3):
        below = to_linear(np.load(tmp_path / f"a.mip{level}.npy"))
        np.testing.assert_allclose(below, box(above), atol=2e-6)
        above = below


@pytest.mark.parametrize("tile", ["", "xyz", "y"])
def test_a_kaiser_level_wraps_around_tiled_axes_and_repeats_the_edge_of_others(toy, tmp_path, tile):
    bake(plan_for(toy, make_output(tmp_path / "a.npy", mips="kaiser"), size=(16, 8, 24), tile=tile), toy)
    expected = to_linear(np.load(tmp_path / "a.npy"))
    for axis in range(3):
        expected = kaiser(expected, axis, "zyx"[axis] in tile)
    np.testing.assert_allclose(np.load(tmp_path / "a.mip1.npy"), to_srgb(expected.astype(np.float32)), atol=2e-5)


@pytest.mark.parametrize("kind", ["box", "kaiser"])
@pytest.mark.parametrize("count", [1, 2, 3, 5, 7, 16, 19])
def test_a_constant_stays_constant_and_a_level_keeps_the_mean_of_a_tiled_axis(kind, count):
    by = taps(count, kind, wrap=True)
    assert len(by.weight) == max(1, count // 2)
    np.testing.assert_allclose(filtered(np.full((count, 3), 0.25, np.float32), 0, by), 0.25, atol=1e-6)
    weights = np.zeros(count)
    np.add.at(weights, by.source.ravel(), by.weight.ravel())
    if kind == "box" or count % 2 == 0:
        np.testing.assert_allclose(weights, len(by.weight) / count, atol=1e-6)


def test_the_chain_ends_at_one_voxel_and_covers_the_same_space(toy):
    volume = plan_for(toy).volume
    levels = level_volumes(volume)
    assert [level.shape for level in levels] == [(9, 2, 3), (4, 1, 1), (2, 1, 1), (1, 1, 1)]
    for level in levels:
        assert level.origin == volume.origin
        for extent, step, whole, fine in zip(level.shape[::-1], level.spacing, volume.shape[::-1], volume.spacing, strict=True):
            assert extent * step == pytest.approx(whole * fine)


@pytest.mark.parametrize(
    ("name", "level"),
    [("a.vti", "a.mip1.vti"), ("a.####.exr", "a.mip1.####.exr"), ("a_%04d.exr", "a_.mip1.%04d.exr")],
)
def test_a_level_is_named_after_its_number(tmp_path, name, level):
    assert level_output(make_output(tmp_path / name), 1).path.name == level


def test_a_stack_has_its_levels_in_stacks_of_their_own(toy, tmp_path):
    bake(plan_for(toy, make_output(tmp_path / "a.####.exr", mips="box"), size=(16, 8, 24)), toy)
    assert [len(list(tmp_path.glob(f"a.mip{level}.*.exr"))) for level in (1, 2, 3, 4, 5)] == [12, 6, 3, 1, 0]
    top = [oiio.ImageBuf(os.fspath(tmp_path / f"a.{z:04d}.exr")).get_pixels(oiio.FLOAT) for z in (5, 6)]
    level = oiio.ImageBuf(os.fspath(tmp_path / "a.mip1.0003.exr"))
    np.testing.assert_allclose(level.get_pixels(oiio.FLOAT), box(np.stack(top))[0], atol=1e-3)
    assert level.spec()["solidgrain:depth"] == 12


def test_coarse_levels_do_not_alias(tmp_path):
    """Evaluating on a coarser grid keeps the fine octaves' variance; filtering takes it away."""
    granite = load("granite")
    bake(plan_for(granite, make_output(tmp_path / "a.npy", mips="box"), size=(64, 64, 64)), granite)
    again = granite.grid((16, 16, 16), seed=7, spacing=4.0)
    assert np.load(tmp_path / "a.mip2.npy").std() < 0.8 * again.std()
