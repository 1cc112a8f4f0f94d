"""Where voxels are: boxes, metres, placements, and several samples per voxel."""

from __future__ import annotations

import json

import numpy as np
import pytest

from solidgrain.bake.baker import bake
from solidgrain.bake.color import to_linear, to_srgb
from solidgrain.bake.writers import make_output
from tests.bake.test_writers import ORIGIN, SIZE, SPACING, plan_for

TURN = ((0.0, -1.0, 0.0, 5.0), (1.0, 0.0, 0.0, -3.0), (0.0, 0.0, 2.0, 0.25), (0.0, 0.0, 0.0, 1.0))


def placed(point: np.ndarray) -> np.ndarray:
    return (np.array(TURN) @ [*point, 1.0])[:3]


def baked(texture, folder, **changes) -> np.ndarray:
    bake(plan_for(texture, make_output(folder / "a.npy"), **changes), texture)
    return np.load(folder / "a.npy")


def test_a_transform_places_the_grid_in_the_texture(toy, tmp_path):
    grid = baked(toy, tmp_path, transform=TURN)
    for x, y, z in [(0, 0, 0), (6, 4, 18), (3, 1, 17)]:
        point = [o + (k + 0.5) * s for o, k, s in zip(ORIGIN, (x, y, z), SPACING, strict=True)]
        np.testing.assert_allclose(grid[z, y, x], toy.sample([placed(point)], seed=7)[0], atol=1e-5)


def test_a_transformed_grid_tiles_along_its_own_axes(toy, tmp_path):
    tile = baked(toy, tmp_path, transform=TURN, tile="xyz")
    twice = toy.grid(
        [2 * n for n in SIZE[::-1]], seed=7, origin=ORIGIN, spacing=SPACING, tile="xyz", period=SIZE[::-1], transform=TURN
    )
    assert np.abs(twice - np.tile(tile, (2, 2, 2, 1))).max() <= 1e-4


@pytest.mark.parametrize("samples", [8, 27])
def test_several_samples_are_averaged_in_linear_light(toy, tmp_path, samples):
    fine = round(samples ** (1 / 3))
    many = toy.grid([fine * n for n in SIZE[::-1]], seed=7, origin=ORIGIN, spacing=[step / fine for step in SPACING])
    z, y, x = SIZE[::-1]
    mean = to_linear(many).reshape(z, fine, y, fine, x, fine, 3).mean((1, 3, 5))
    np.testing.assert_allclose(baked(toy, tmp_path, samples=samples), to_srgb(mean), atol=1e-5)


def test_several_samples_still_tile(toy, tmp_path):
    tile = baked(toy, tmp_path, samples=8, tile="xyz", size=(8, 6, 10))
    seam = np.abs(tile[:, :, 0] - tile[:, :, -1]).mean()
    assert seam < 1.5 * np.abs(np.diff(tile, axis=2)).mean()


@pytest.mark.parametrize(
    ("flags", "origin", "spacing"),
    [
        (["--box", "1,2,3,9,6,11", "--size", "4x2x16"], [1, 2, 3], [2, 2, 0.5]),
        (["--box", "0,0,0,0.1,0.1,0.2", "--pixel-size", "0.005", "--size", "20x20x40"], [0, 0, 0], [1, 1, 1]),
        (["--origin", "-1,0,0.5", "--spacing", "0.01", "--pixel-size", "0.005"], [-200, 0, 100], [2, 2, 2]),
        (["--origin", "4,5,6"], [4, 5, 6], [1, 1, 1]),
    ],
)
def test_boxes_and_metres_become_exemplar_pixels(solidgrain, toy_folder, flags, origin, spacing):
    plan = json.loads(solidgrain("bake", toy_folder, *flags, "--dry-run", "--json").out)["plan"]
    np.testing.assert_allclose(plan["origin"], origin)
    np.testing.assert_allclose(plan["spacing"], spacing)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--box", "0,0,0,1,1"], "--box"),
        (["--box", "0,0,0,1,1,0"], "--box"),
        (["--box", "0,0,0,1,1,1", "--spacing", "2"], "leave out --origin and --spacing"),
        (["--pixel-size", "0"], "--pixel-size"),
        (["--transform", "1,0,0,0"], "--transform"),
        (["--transform", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1"], "--transform"),
        (["--samples", "4"], "--samples"),
        (["--mip-filter", "box"], "add --mips"),
        (["--shard", "3/2"], "--shard"),
        (["--shard", "0/2"], "--shard"),
        (["--exr-compression", "lzma"], "--exr-compression"),
        (["--exr-channels", "R=r,R=g"], "--exr-channels"),
        (["--exr-channels", "R=red"], "--exr-channels"),
        (["--update", "--overwrite"], "--overwrite"),
        (["--vti-type", "uint8"], "no --out of this format"),
        (["--colorspace", ""], "--colorspace"),
    ],
)
def test_flags_that_cannot_work_are_refused_in_one_line(solidgrain, tmp_path, toy_folder, flags, message):
    outcome = solidgrain("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.####.exr", *flags)
    assert outcome.code == 2
    assert message in outcome.error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("flat", ["1,0,0,0, 0,1,0,0, 1,1,0,0, 0,0,0,1", "0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,1"])
def test_a_transform_without_an_inverse_is_refused(solidgrain, tmp_path, toy_folder, flat):
    outcome = solidgrain("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.npy", "--transform", flat)
    assert outcome.code == 2
    assert "no inverse" in outcome.error
    assert list(tmp_path.iterdir()) == []
