"""A `.vdb` read by OpenVDB: every voxel, where it lies, what is active, and what the file says about itself.

The reader is Debian's python3-openvdb, which the system's Python alone can import, so it runs in a process of its own.
"""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from solidgrain.bake.baker import bake
from solidgrain.bake.color import LINEAR, SRGB, to_linear
from solidgrain.bake.store import Store
from solidgrain.bake.writers import Volume, check_output, make_output, open_writer, output_bytes
from solidgrain.bake.writers.base import replay
from solidgrain.runtime.errors import BakeError, UsageError
from solidgrain.runtime.workers import Workers
from tests.bake.test_writers import ORIGIN, SIZE, SPACING, VOXELS, expected, plan_for

PYTHON = "/usr/bin/python3"
READER = """
import json, sys
import numpy as np
import pyopenvdb as vdb

path, out = sys.argv[1:]
grids, facts = vdb.readAllGridMetadata(path), {}
for name in [grid.name for grid in grids]:
    grid = vdb.read(path, name)
    low, high = grid.evalActiveVoxelBoundingBox()
    size = [h - l + 1 for l, h in zip(low, high)]
    array = np.zeros(size + ([3] if "vec3s" in grid.valueTypeName else []), np.float32)
    grid.copyToArray(array, ijk=low)
    np.save(f"{out}.{name}.npy", array)
    outside = grid.getConstAccessor().probeValue([h + 1 for h in high])
    facts[name] = {
        "type": grid.valueTypeName, "class": str(grid.gridClass), "half": grid.saveFloatAsHalf,
        "box": [low, high], "active": grid.activeVoxelCount(), "outside": outside,
        "in_leaves": grid.activeLeafVoxelCount(), "leaves": grid.leafCount(),
        "voxel": list(grid.transform.voxelSize()), "first": list(grid.transform.indexToWorld((0, 0, 0))),
        "last": list(grid.transform.indexToWorld(high)), "map": grid.transform.typeName,
        "metadata": {key: str(value) for key, value in grid.metadata.items()},
    }
print(json.dumps(facts))
"""


@cache
def foreign_reader() -> str:
    """Why the foreign reader cannot be used; empty if it can."""
    try:
        done = subprocess.run(
            [PYTHON, "-c", "import numpy, pyopenvdb"], check=False, capture_output=True, text=True, timeout=60
        )
    except OSError as error:
        return str(error)
    return done.stderr.strip().splitlines()[-1] if done.returncode else ""


def read_back(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What OpenVDB says about the grids of a file, and their active boxes as arrays [x, y, z, ...]."""
    if reason := foreign_reader():
        pytest.skip(f"{PYTHON} cannot import pyopenvdb (Debian's python3-openvdb) and numpy: {reason}")
    done = subprocess.run([PYTHON, "-c", READER, path, path], check=False, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    return facts, {name: np.load(f"{path}.{name}.npy") for name in facts}


def volume_of(size, origin=ORIGIN, spacing=SPACING) -> Volume:
    return Volume(size[::-1], origin, spacing, texture="tøy", sampler_sha256="0" * 64, seed=2**70, tile="")


def noise(size) -> np.ndarray:
    """Random colours [z, y, x, 3]: smooth enough to deflate, without any symmetry."""
    steps = np.random.default_rng(size[0]).random((*size[::-1], 3), np.float32)
    return (0.2 * steps + 0.8 * np.linspace(0, 1, size[2], dtype=np.float32)[:, None, None, None]).astype(np.float32)


def written(folder: Path, volume: Volume, colors: np.ndarray, slab: int = 5, name: str = "a.vdb", **options: str) -> Path:
    """A file from slabs whose thickness divides neither leaves nor nodes."""
    output = make_output(folder / name, **{"colorspace": SRGB, **options})
    check_output(output, volume)
    slabs = [(z, colors[z : z + slab]) for z in range(0, len(colors), slab)]
    (file,) = replay(slabs, open_writer(output, volume, Workers(2)), folder / "staging")
    os.replace(file.staged, file.final)
    assert output.path.stat().st_size <= output_bytes(output, volume)
    return output.path


@pytest.mark.parametrize("compression", ["zlib", "none"])
@pytest.mark.parametrize("kind", ["half", "float"])
@pytest.mark.parametrize("size", [(7, 5, 19), (130, 9, 40), (8, 16, 8), (1, 1, 1), (9, 140, 131)])
def test_every_voxel_is_read_back_bit_for_bit(tmp_path, size, kind, compression):
    colors = noise(size)
    facts, arrays = read_back(written(tmp_path, volume_of(size), colors, type=kind, compression=compression))
    stored = colors.astype(np.float16).astype(np.float32) if kind == "half" else colors
    assert np.array_equal(arrays["Cd"], stored.transpose(2, 1, 0, 3))
    assert np.array_equal(arrays["density"], np.ones(size, np.float32))
    assert [facts["Cd"]["type"], facts["density"]["type"]] == ["vec3s", "float"]
    assert facts["Cd"]["half"] == (kind == "half")


@pytest.mark.parametrize("size", [(130, 9, 40), (8, 16, 8), (1, 1, 1), (128, 128, 136)])
def test_exactly_the_volume_is_active_and_the_rest_is_background(tmp_path, size):
    facts, _ = read_back(written(tmp_path, volume_of(size), noise(size)))
    for name, background in (("Cd", [0, 0, 0]), ("density", 0)):
        assert facts[name]["box"] == [[0, 0, 0], [extent - 1 for extent in size]]
        assert facts[name]["active"] == np.prod(size)
        assert facts[name]["outside"] == [background, False]
        assert facts[name]["class"] == "fog volume"


def test_several_nodes_below_the_root_are_in_order(tmp_path):
    """More than 4096 voxels along x, and as many along y in another file."""
    for size in ((4100, 3, 2), (2, 4105, 3)):
        colors = noise(size)
        facts, arrays = read_back(written(tmp_path, volume_of(size), colors))
        assert np.array_equal(arrays["Cd"], colors.astype(np.float16).astype(np.float32).transpose(2, 1, 0, 3))
        assert facts["density"]["active"] == np.prod(size)


def test_the_density_is_tiles_where_the_volume_fills_nodes(tmp_path):
    size = (256, 130, 128)
    colors = np.zeros((*size[::-1], 3), np.float32)
    path = written(tmp_path, volume_of(size), colors)
    facts, _ = read_back(path)
    assert facts["density"]["active"] == np.prod(size)
    assert facts["density"]["leaves"] == (256 // 8) * (128 // 8)  # those at y = 128 alone
    assert facts["density"]["in_leaves"] == 256 * 2 * 128
    values, heads = colors.size * 2, facts["Cd"]["leaves"] * (64 + 65)
    assert path.stat().st_size < values + heads + 400_000


@pytest.mark.parametrize(
    ("origin", "spacing", "kind"),
    [
        (ORIGIN, SPACING, "ScaleTranslateMap"),
        ((-1e9, 123456.789, -0.1), (0.1, 3.0, 7.25), "ScaleTranslateMap"),
        ((-5.0, 2.0, 1e9), (0.3, 0.3, 0.3), "UniformScaleTranslateMap"),
    ],
)
def test_voxels_lie_where_they_were_sampled(tmp_path, origin, spacing, kind):
    volume = volume_of(SIZE, origin, spacing)
    facts, _ = read_back(written(tmp_path, volume, noise(SIZE)))
    for grid in facts.values():
        assert grid["voxel"] == list(spacing)
        assert grid["first"] == list(volume.first_sample)
        last = [start + (extent - 1) * step for start, extent, step in zip(volume.first_sample, SIZE, spacing, strict=True)]
        np.testing.assert_allclose(grid["last"], last, rtol=1e-15)
        assert grid["map"] == kind


def test_metadata_says_what_the_grids_are(tmp_path):
    options = {"grid": "color", "colorspace": LINEAR, "compression": "zlib"}
    facts, _ = read_back(written(tmp_path, volume_of(SIZE), noise(SIZE), **options))
    assert set(facts) == {"color", "density"}
    for name, grid in facts.items():
        found = {
            "name": name,
            "class": "fog volume",
            "creator": "solidgrain",
            "texture": "tøy",
            "seed": str(2**70),
            "axes": "+x+y+z",
            "color_encoding": LINEAR,
            "is_saved_as_half_float": "True",
            "file_bbox_min": "(0, 0, 0)",
            "file_bbox_max": "(6, 4, 18)",
            "file_voxel_count": str(7 * 5 * 19),
            "file_compression": "zip + active values",
        }
        assert grid["metadata"].items() >= found.items()


@pytest.fixture(scope="module")
def baked(toy, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("baked") / "toy.vdb"
    bake(plan_for(toy, make_output(path)), toy)
    return path


def test_a_bake_is_linear_and_upright(baked, toy):
    facts, arrays = read_back(baked)
    assert facts["Cd"]["metadata"]["color_encoding"] == LINEAR
    for voxel in VOXELS:
        np.testing.assert_allclose(arrays["Cd"][voxel], to_linear(expected(toy, *voxel)), rtol=1e-3)


def test_two_bakes_are_the_same_bytes_and_others_have_another_uuid(baked, toy, tmp_path):
    output = make_output(tmp_path / "toy.vdb")
    bake(plan_for(toy, output), toy)
    assert output.path.read_bytes() == baked.read_bytes()
    bake(replace(plan_for(toy, output), seed=8), toy)
    uuids = {path.read_bytes()[21 : 21 + 36] for path in (output.path, baked)}
    assert len(uuids) == 2


def test_assembling_again_after_a_kill_gives_the_same_file(tmp_path):
    store, output = Store(tmp_path, SIZE[2]), make_output(tmp_path / "a.vdb")
    store.append(0, SIZE[2], open_writer(output, volume_of(SIZE), Workers(1)).encode(0, noise(SIZE)))
    whole = open_writer(output, volume_of(SIZE), Workers(1)).assemble(store)[0].staged.read_bytes()
    (tmp_path / "a.vdb").write_bytes(whole[:1000] * 500)  # longer than the file
    assert open_writer(output, volume_of(SIZE), Workers(2)).assemble(store)[0].staged.read_bytes() == whole


@pytest.mark.parametrize("compression", ["zlib", "none"])
@pytest.mark.parametrize(("kind", "bound"), [("half", 2**-11), ("float", 1e-6)])
def test_a_probe_finds_what_the_file_holds(tmp_path, kind, bound, compression):
    size = (130, 141, 20)
    volume, colors = volume_of(size), noise(size)
    path = written(tmp_path, volume, colors, type=kind, compression=compression)
    voxels = np.random.default_rng(1).integers(0, size, (300, 3))
    output = make_output(path, colorspace=SRGB, type=kind, compression=compression)
    found, rounding = open_writer(output, volume, Workers(1)).probe(voxels)
    x, y, z = voxels.T
    assert rounding == bound
    assert np.abs(found - colors[z, y, x]).max() <= bound


def test_a_probe_of_another_file_says_what_was_expected(tmp_path):
    path = tmp_path / "a.vdb"
    for content in (b"", b"no volume" * 20, written(tmp_path, volume_of(SIZE), noise(SIZE), grid="color").read_bytes()):
        path.write_bytes(content)
        writer = open_writer(make_output(path), volume_of(SIZE), Workers(1))
        with pytest.raises(BakeError, match=r"a\.vdb: expected an OpenVDB file with a grid 'Cd'"):
            writer.probe(np.zeros((1, 3), np.int64))


@pytest.mark.parametrize("name", ["density", " ", "a\nb"])
def test_a_grid_needs_a_name_of_its_own(tmp_path, name):
    with pytest.raises(UsageError, match=r"--vdb-grid .* expected a name for the colours"):
        check_output(make_output(tmp_path / "a.vdb", grid=name), volume_of(SIZE))


def test_more_voxels_than_coordinates_are_refused(tmp_path):
    with pytest.raises(UsageError, match=r"2147483648 voxels along an axis, \.vdb holds 2147483647"):
        check_output(make_output(tmp_path / "a.vdb"), volume_of((2**31, 1, 1)))
