"""Turned files hold the same voxels, found where their axes say."""

from __future__ import annotations

import itertools
import os

import numpy as np
import OpenEXR
import pytest

from solidgrain.bake.baker import bake
from solidgrain.bake.color import luma, to_linear
from solidgrain.bake.writers import make_output
from solidgrain.bake.writers.orient import oriented
from tests.bake.test_writers import ORIGIN, SIZE, SPACING, plan_for

ALL_AXES = [
    "".join(sign + axis for sign, axis in zip(signs, order, strict=True))
    for order in itertools.permutations("xyz")
    for signs in itertools.product("+-", repeat=3)
]


@pytest.fixture(scope="module")
def grid(toy):
    return toy.grid(SIZE[::-1], seed=7, origin=ORIGIN, spacing=SPACING)


def test_all_forty_eight_orientations_are_what_numpy_makes_of_the_grid(toy, grid, tmp_path):
    outputs = [make_output(tmp_path / f"{axes}.npy", axes=axes) for axes in ALL_AXES]
    bake(plan_for(toy, *outputs), toy)
    for axes in ALL_AXES:
        order = [2 - "xyz".index(axis) for axis in axes[1::2]][::-1]
        turned = grid.transpose(*order, 3)
        for k, sign in enumerate(axes[::2]):
            turned = np.flip(turned, 2 - k) if sign == "-" else turned
        assert np.array_equal(np.load(tmp_path / f"{axes}.npy"), turned), axes


@pytest.mark.parametrize(("axis", "count", "columns", "rows"), [("x", 7, "y", "z"), ("y", 5, "x", "z"), ("z", 19, "x", "y")])
def test_a_stack_can_lie_across_any_axis_and_says_so(toy, grid, tmp_path, axis, count, columns, rows):
    bake(plan_for(toy, make_output(tmp_path / "a.####.exr", axis=axis)), toy)
    assert len(list(tmp_path.glob("a.*.exr"))) == count
    k = count - 2
    with OpenEXR.File(os.fspath(tmp_path / f"a.{k + 1:04d}.exr")) as file:
        pixels = file.channels()["RGB"].pixels
        assert file.header()["solidgrain:axes"] == f"column {columns}, row {rows} downwards from the top, slice {axis}"
    across = grid.take(k, "zyx".index(axis))
    np.testing.assert_allclose(pixels, to_linear(across), rtol=1e-3)


def test_the_turned_volume_keeps_its_place_in_space(toy):
    volume = plan_for(toy, tile="yz").volume
    turned = oriented(volume, "+z-y+x")
    assert turned.shape == (SIZE[0], SIZE[1], SIZE[2])
    assert turned.origin == (ORIGIN[2], -(ORIGIN[1] + SIZE[1] * SPACING[1]), ORIGIN[0])
    assert turned.spacing == SPACING[::-1]
    assert turned.tile == "xy"


def test_the_estimate_of_memory_knows_slices_that_lie_along_the_depth(tmp_path, toy):
    output = make_output(tmp_path / "a.####.exr", axis="y")
    deep = plan_for(toy, output, size=(256, 256, 65536))
    assert deep.memory > plan_for(toy, make_output(tmp_path / "a.####.exr"), size=(256, 256, 65536)).memory + 2**29


def test_luma_does_not_depend_on_where_a_slice_begins():
    linear = np.random.default_rng(3).random((5, 37, 3), dtype=np.float32)
    np.testing.assert_array_equal(luma(linear)[:, 3:], luma(linear[:, 3:]))
