"""Raw volumes: numpy reads them with nothing but what the JSON file beside them says."""

from __future__ import annotations

import json

import numpy as np
import pytest

from solidgrain.bake.baker import bake
from solidgrain.bake.color import LINEAR, SRGB, to_linear
from solidgrain.bake.writers import make_output, open_writer, output_bytes, output_files
from solidgrain.runtime.workers import Workers
from tests.bake.test_writers import ORIGIN, SIZE, SPACING, VOXELS, expected, plan_for

TYPES = {"uint8": 0.5 / 255, "uint16": 0.5 / 65535, "half": 2**-12, "float": 0}


@pytest.fixture(scope="module")
def baked(toy, tmp_path_factory):
    folder = tmp_path_factory.mktemp("raw")
    outputs = [make_output(folder / f"{kind}.raw", type=kind) for kind in TYPES]
    outputs.append(make_output(folder / "linear.raw", type="half", colorspace=LINEAR))
    bake(plan_for(toy, *outputs, tile="xz"), toy)
    return folder


def read(path):
    """The volume in [0, 1], by its JSON file alone."""
    header = json.loads(path.with_name(f"{path.name}.json").read_bytes())
    dtype = np.dtype(header["dtype"]).newbyteorder({"little": "<"}[header["byte_order"]])
    volume = np.fromfile(path, dtype).reshape(*header["shape"], header["channels"])
    return volume / (np.iinfo(dtype).max if dtype.kind == "u" else 1), header


@pytest.mark.parametrize("kind", TYPES)
def test_numpy_reads_what_the_json_file_describes(baked, toy, kind):
    volume, _ = read(baked / f"{kind}.raw")
    assert volume.shape == (*SIZE[::-1], 3)
    grid = toy.grid(SIZE[::-1], seed=7, origin=ORIGIN, spacing=SPACING, tile="xz", period=SIZE[::-1])
    np.testing.assert_allclose(volume, grid, atol=TYPES[kind] + 1e-7)


@pytest.mark.parametrize(("x", "y", "z"), VOXELS)
def test_voxels_are_where_the_texture_has_them(toy, tmp_path, x, y, z):
    bake(plan_for(toy, make_output(tmp_path / "a.raw", type="float")), toy)
    assert np.array_equal(read(tmp_path / "a.raw")[0][z, y, x], expected(toy, x, y, z))


def test_colours_are_in_the_space_that_the_json_file_names(baked):
    srgb, header = read(baked / "float.raw")
    assert header["colorspace"] == SRGB
    linear, header = read(baked / "linear.raw")
    assert header["colorspace"] == LINEAR
    np.testing.assert_allclose(linear, to_linear(srgb), atol=2**-11)


def test_the_json_file_says_where_the_volume_comes_from(baked, toy):
    _, header = read(baked / "uint16.raw")
    assert {key: header[key] for key in ("format", "version", "texture", "seed", "model", "axes", "tile", "level")} == {
        "format": "solidgrain raw volume",
        "version": 1,
        "texture": "toy",
        "seed": 7,
        "model": toy.data.sampler_sha256,
        "axes": "+x+y+z",
        "tile": "xz",
        "level": 0,
    }
    assert (tuple(header["origin"]), tuple(header["spacing"])) == (ORIGIN, SPACING)


def test_both_files_are_announced_and_within_the_estimate(baked, toy):
    volume = plan_for(toy).volume
    for kind in TYPES:
        output = make_output(baked / f"{kind}.raw", type=kind)
        files = output_files(output, volume)
        assert [path.name for path in files] == [f"{kind}.raw", f"{kind}.raw.json"]
        assert sum(path.stat().st_size for path in files) <= output_bytes(output, volume)


def test_two_bakes_are_the_same_bytes(baked, toy, tmp_path):
    for path in bake(plan_for(toy, make_output(tmp_path / "uint8.raw"), tile="xz"), toy).files:
        assert path.read_bytes() == (baked / path.name).read_bytes()


@pytest.mark.parametrize("kind", [*TYPES, "dithered"])
def test_a_probe_finds_the_colours_within_its_bound(toy, tmp_path, kind):
    options = {"dither": 1} if kind == "dithered" else {"type": kind}
    output, plan = make_output(tmp_path / "a.raw", **options), plan_for(toy)
    bake(plan_for(toy, output), toy)
    colors, bound = open_writer(output, plan.volume, Workers(1)).probe(np.array(VOXELS))
    assert np.abs(colors - [expected(toy, *voxel) for voxel in VOXELS]).max() <= bound < 0.01
