"""`solidgrain blend`: sequences between two textures, and textures that go from one to the other and bake as any."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import numpy as np
import OpenImageIO as oiio
import pytest
import pyvista

from solidgrain.bake.baker import bake
from solidgrain.bake.schema import load_plan
from solidgrain.bake.sequence import sequence_files
from solidgrain.export.bundle import Details, write_bundle
from solidgrain.runtime import BundleError, Texture, load_space, load_texture
from solidgrain.runtime.texture_file import read_texture
from tests.toy_space import LATENT, toy_space_weights

PATCH = 128


@pytest.fixture(scope="module")
def folder(toy_space_folder):
    return toy_space_folder


@pytest.fixture(scope="module")
def space(folder):
    return load_space(folder)


@pytest.fixture(scope="module")
def pair(space, tmp_path_factory):
    """Two texture files."""
    home = tmp_path_factory.mktemp("pair")
    for name, z in zip("ab", np.random.default_rng(0).standard_normal((2, LATENT)), strict=True):
        space.texture(z, name).save(home / f"{name}.sgt.npz")
    return home / "a.sgt.npz", home / "b.sgt.npz"


@pytest.fixture(scope="module")
def textures(pair, folder):
    return tuple(load_texture(file, bundle=folder) for file in pair)


@pytest.fixture
def blend(solidgrain, pair, folder):
    """The command, on the two texture files."""
    return lambda *flags: solidgrain("blend", *pair, "--bundle", folder, *flags)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_sequence_goes_from_the_first_texture_to_the_second(blend, space, textures, tmp_path):
    outcome = blend("--at", "0:1:0.25", "--out", tmp_path / "ab.####.sgt.npz", "--json")
    assert outcome.code == 0
    assert names(tmp_path) == [f"ab.{k:04d}.sgt.npz" for k in range(5)]
    report = json.loads(outcome.out)
    assert [one["at"] for one in report["textures"]] == [0, 0.25, 0.5, 0.75, 1]
    for k, one in enumerate(report["textures"]):
        assert one["texture_sha256"] == read_texture(tmp_path / f"ab.{k:04d}.sgt.npz").sha256
        assert one["texture_sha256"] == space.blend(*textures, k / 4).data.sha256
    assert report["textures"][0]["texture_sha256"] == textures[0].data.sha256
    assert report["textures"][4]["texture_sha256"] == textures[1].data.sha256


def test_a_blend_is_at_a_scale_between_those_of_its_ends(space, textures):
    halved, quartered = (space.open(replace(one.data, scale=scale)) for one, scale in zip(textures, (2.0, 4.0), strict=True))
    assert space.blend(halved, quartered, 0.5).data.scale == pytest.approx(8**0.5)
    assert space.blend(halved, quartered, 1).data.scale == 4
    assert space.blend(*textures, 0.5).data.sha256 == space.blend(halved, quartered, 0.5).data.sha256


def test_steps_of_tenths_are_tenths(blend, space, textures, tmp_path):
    outcome = blend("--at", "1:0:-0.1", "--out", tmp_path / "ab.%02d.sgt.npz", "--json")
    assert [one["at"] for one in json.loads(outcome.out)["textures"]] == [1, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0]
    assert names(tmp_path)[-1] == "ab.10.sgt.npz"


def test_one_step_is_one_file_and_a_folder_gives_the_names(blend, tmp_path):
    assert blend("--at", "0.5", "--out", tmp_path / "middle.sgt.npz").code == 0
    assert blend("--at", "-0.5", "--out", tmp_path).code == 0
    assert blend("--at", "0:1:1", "--out", tmp_path).code == 0
    assert names(tmp_path) == ["a-b.0000.sgt.npz", "a-b.0001.sgt.npz", "a-b.sgt.npz", "middle.sgt.npz"]


def test_photographs_are_encoded_first(solidgrain, space, folder, pair, tmp_path):
    pixels = np.random.default_rng(1).random((150, 140, 3), np.float32)
    assert oiio.ImageBuf(pixels).write(os.fspath(tmp_path / "cliff.png"), oiio.UINT8)
    outcome = solidgrain(
        "blend", tmp_path / "cliff.png", pair[1], "--crop", "3,4", "--at", 0.5, "--out", tmp_path, "--bundle", folder
    )
    assert outcome.code == 0, outcome.err
    assert f"{PATCH}x{PATCH} of 140x150 pixels from 3,4" in outcome.err
    stored = oiio.ImageBuf(os.fspath(tmp_path / "cliff.png")).get_pixels(oiio.FLOAT)
    first = space.encode(stored[4 : 4 + PATCH, 3 : 3 + PATCH])
    expected = space.blend(first, load_texture(pair[1], bundle=folder), 0.5)
    assert read_texture(tmp_path / "cliff-b.sgt.npz").sha256 == expected.data.sha256


def test_a_texture_along_an_axis_bakes_resumes_and_verifies(solidgrain, blend, textures, folder, tmp_path):
    file, out = tmp_path / "ab.sgt.npz", tmp_path / "ab.npy"
    assert blend("--along", "z", "--from", 4, "--to", 20, "--out", file).code == 0
    flags = ("--bundle", folder, "--size", "12x10x24", "--seed", 3, "--quiet", "--tile", "xy", "--out")
    assert solidgrain("bake", file, *flags, out).code == 0
    volume = np.load(out)
    place = {"shape": (24, 10, 12), "seed": 3, "tile": "xy"}
    assert np.array_equal(volume, load_texture(file, bundle=folder).grid(**place))
    assert np.array_equal(volume[:4], textures[0].grid(**place)[:4])
    assert np.array_equal(volume[20:], textures[1].grid(**place)[20:])
    assert solidgrain("verify", out, "--voxels", 40).code == 0
    assert solidgrain("bake", file, *flags, out, "--resume").code == 0
    shards = tmp_path / "shards.npy"
    for shard in ("2/2", "1/2"):
        assert solidgrain("bake", file, *flags, shards, "--shard", shard).code == 0
    plan = tmp_path / "plan.json"
    plan.write_text(solidgrain("bake", file, *flags, shards, "--dry-run", "--json").out)
    assert solidgrain("merge", plan).code == 0
    assert np.array_equal(np.load(shards), volume)
    damaged = np.load(out)
    damaged[10] = 0
    np.save(out, damaged)
    assert solidgrain("verify", out).code == 3


def test_info_says_from_where_to_where_a_blend_goes(blend, solidgrain, folder, tmp_path):
    blend("--along", "z", "--from", 4, "--to", 20, "--out", tmp_path / "ab.sgt.npz")
    outcome = solidgrain("info", tmp_path / "ab.sgt.npz", "--bundle", folder)
    assert outcome.code == 0
    assert outcome.out.startswith("texture    a-b\n")
    assert "a to b by a mask of 1x1x2 voxels (x, y, z), from (0.0, 0.0, -4.0) to (1.0, 1.0, 28.0)" in outcome.out


def test_an_interrupted_bake_of_a_blend_goes_on_to_the_same_bytes(blend, solidgrain, folder, tmp_path):
    file = tmp_path / "ab.sgt.npz"
    blend("--along", "z", "--from", 10, "--to", 60, "--out", file)
    flags = ("bake", file, "--bundle", folder, "--size", "16x16x64", "--quiet", "--out")
    assert solidgrain(*flags, tmp_path / "whole.npy").code == 0
    (tmp_path / "plan.json").write_text(solidgrain(*flags, tmp_path / "part.npy", "--dry-run", "--json").out)

    def stop(done, total):
        if done >= 32:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bake(load_plan(tmp_path / "plan.json"), load_texture(file, bundle=folder), stop, resume=True)
    outcome = solidgrain(*flags, tmp_path / "part.npy", "--resume", "--json")
    assert outcome.code == 0, outcome.err
    assert json.loads(outcome.out)["reused_slices"] >= 16
    assert (tmp_path / "part.npy").read_bytes() == (tmp_path / "whole.npy").read_bytes()


def test_a_mask_that_has_changed_is_another_texture_to_a_plan(blend, solidgrain, folder, tmp_path):
    file = tmp_path / "ab.sgt.npz"
    np.save(tmp_path / "mask.npy", np.eye(4, dtype=np.float32)[None])
    assert blend("--mask", tmp_path / "mask.npy", "--out", file).code == 0
    assert solidgrain("bake", file, "--bundle", folder, "--size", 4, "--out", tmp_path / "ab.npy", "--quiet").code == 0
    np.save(tmp_path / "mask.npy", 1 - np.eye(4, dtype=np.float32)[None])
    assert blend("--mask", tmp_path / "mask.npy", "--out", file, "--overwrite").code == 0
    outcome = solidgrain("verify", tmp_path / "ab.npy")
    assert outcome.code == 1
    assert "made with the texture" in outcome.error


@pytest.mark.parametrize("kind", ["npy", "points.vti", "cells.vti", "part.points.vti", "part.cells.vti"])
def test_a_mask_comes_from_a_file_with_its_place(blend, folder, textures, space, tmp_path, kind):
    values = np.random.default_rng(0).random((2, 3, 4), np.float32)
    path, flags = tmp_path / f"mask.{kind}", ["--mask-origin", "1,-2,3", "--mask-spacing", "2,3,4"]
    if kind == "npy":
        np.save(path, values)
    else:
        at_points, flags, first = kind.endswith("points.vti"), [], np.array([5, 0, 7]) * kind.startswith("part")
        extent = np.array([4, 3, 2]) + (not at_points)
        image = pyvista.ImageData(
            spacing=(2, 3, 4), origin=np.array([1, -2, 3]) + (0.5 * at_points - first) * np.array([2, 3, 4])
        )
        image.extent = np.stack([first, first + extent - 1], 1).reshape(-1)  # of a larger volume, whose index 0 is elsewhere
        (image.point_data if at_points else image.cell_data)["weight"] = values.reshape(-1)
        image.save(path)
    outcome = blend("--mask", path, *flags, "--out", tmp_path / "ab.sgt.npz", "--json")
    assert outcome.code == 0, outcome.err
    expected = space.blend_by(*textures, values, (1, -2, 3), (2, 3, 4))
    assert json.loads(outcome.out)["textures"][0]["texture_sha256"] == expected.data.sha256
    assert load_texture(tmp_path / "ab.sgt.npz", bundle=folder).data.sha256 == expected.data.sha256


@pytest.mark.parametrize(
    ("flags", "message", "code"),
    [
        ([], "expected one of --at, --along and --mask, found none", 2),
        (["--at", "0.5", "--along", "x"], "found --at and --along", 2),
        (["--at", "half"], "--at: expected a number or FIRST:LAST:STEP", 2),
        (["--at", "0:1"], "--at: expected a number or FIRST:LAST:STEP", 2),
        (["--at", "0:1:0"], "--at: expected steps that lead from 0 to 1, found 0", 2),
        (["--at", "0:1:-0.1"], "--at: expected steps", 2),
        (["--at", "0:1:1e-9"], "--at: expected steps", 2),
        (["--at", "0:1:nan"], "--at: expected a number", 2),
        (["--at", "0:1:0.5"], "expected a frame pattern for 3 textures, such as ab.####.sgt.npz, or a folder", 2),
        (["--at", "0.5", "--from", "3"], "--from: is about --along", 2),
        (["--along", "x", "--mask-origin", "1,2,3"], "--mask-origin: is about --mask", 2),
        (["--along", "w"], "--along", 2),
        (["--along", "x", "--from", "nan"], "--from: expected exemplar pixels", 2),
        (["--along", "x", "--from", "128"], "--from and --to: from 128.0 to 128.0: expected two different places", 2),
        (["--mask", "no.npy"], "--mask no.npy: no such file", 1),
        (["--mask", "mask.exr"], "expected a name that ends in .npy or .vti", 2),
        (["--at", "0.5", "--crop", "1,2"], "are about photographs, and there are none", 2),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(blend, tmp_path, flags, message, code):
    outcome = blend(*flags, "--out", tmp_path / "ab.sgt.npz")
    assert outcome.code == code
    assert message in outcome.error
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (np.zeros((2, 2)), "mask of shape (2, 2): expected a volume [z, y, x]"),
        (np.full((1, 1, 2), np.nan), "mask has values from nan to nan, expected 0 to 1"),
        (np.full((1, 1, 2), 7.0), "mask has values from 7 to 7, expected 0 to 1"),
        (b"no array", "not readable as a NumPy array"),
    ],
)
def test_a_bad_mask_is_refused_in_a_line_with_its_name(blend, tmp_path, content, message):
    path = tmp_path / "mask.npy"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content)
    outcome = blend("--mask", path, "--out", tmp_path / "ab.sgt.npz")
    assert outcome.code == 1
    assert f"--mask {path}: {message}" in outcome.error
    assert names(tmp_path) == ["mask.npy"]


def test_image_data_that_is_no_mask_is_refused(blend, tmp_path):
    image = pyvista.ImageData(dimensions=(2, 2, 2))
    image.point_data["rgb"] = np.zeros((8, 3), np.uint8)
    image.save(tmp_path / "colors.vti")
    (tmp_path / "torn.vti").write_text("<VTKFile")
    for name, message in (("colors", "expected image data with one array of one number per voxel"), ("torn", "colors|torn")):
        outcome = blend("--mask", tmp_path / f"{name}.vti", "--out", tmp_path / "ab.sgt.npz")
        assert outcome.code == 1
        assert any(part in outcome.error for part in message.split("|"))


def test_textures_that_do_not_belong_together_are_refused_in_a_line(solidgrain, pair, folder, space, textures, tmp_path):
    other = write_bundle(tmp_path / "other", toy_space_weights(seed=6), Details(name="other", patch=PATCH))
    load_space(other).texture(np.ones(LATENT), "other").save(tmp_path / "other.sgt.npz")
    space.open(replace(textures[0].data, latent=None)).save(tmp_path / "bare.sgt.npz")
    space.blend_along(*textures).save(tmp_path / "ab.sgt.npz")
    for second, message in (
        ("other", "only textures of one space can be blended"),
        ("bare", "has no latent code"),
        ("ab", "solidgrain-blend version 1, expected solidgrain-texture version 1; it is of another kind"),
        ("missing", "no such file; expected a texture file (.sgt.npz) or a photograph"),
    ):
        flags = ("--bundle", folder, "--at", 0.5, "--out", tmp_path / "out.sgt.npz")
        outcome = solidgrain("blend", pair[0], tmp_path / f"{second}.sgt.npz", *flags)
        assert outcome.code == 1
        assert message in outcome.error
    outcome = solidgrain("blend", *pair, "--bundle", "granite", "--at", 0.5, "--out", tmp_path / "out.sgt.npz")
    assert "holds one texture and no encoder" in outcome.error
    assert not (tmp_path / "out.sgt.npz").exists()


def test_files_that_exist_stay_unless_they_are_to_be_replaced(blend, tmp_path):
    kept = tmp_path / "ab.0002.sgt.npz"
    kept.write_bytes(b"mine")
    flags = ("--at", "0:1:0.5", "--out", tmp_path / "ab.####.sgt.npz")
    outcome = blend(*flags)
    assert outcome.code == 1
    assert f"{kept}: already exists" in outcome.error
    assert names(tmp_path) == ["ab.0002.sgt.npz"]
    assert blend(*flags, "--overwrite").code == 0
    assert names(tmp_path) == [f"ab.{k:04d}.sgt.npz" for k in range(3)]
    read_texture(kept)


@pytest.mark.parametrize("fails", ["write", "rename"])
def test_a_sequence_that_cannot_be_written_leaves_all_as_it_was(blend, tmp_path, monkeypatch, fails):
    former, last = tmp_path / "ab.0000.sgt.npz", tmp_path / "ab.0002.sgt.npz"
    former.write_bytes(b"mine")
    save, rename = Texture.save, os.replace

    def save_but_the_last(texture, path):
        if ".ab.0002" in str(path):
            raise BundleError("no space left")
        save(texture, path)

    def replace_but_the_last(source, target):
        if target == last:
            raise OSError(28, "no space left")
        rename(source, target)

    if fails == "write":
        monkeypatch.setattr(Texture, "save", save_but_the_last)
    else:
        monkeypatch.setattr(os, "replace", replace_but_the_last)
    outcome = blend("--at", "0:1:0.25", "--out", tmp_path / "ab.####.sgt.npz", "--overwrite")
    assert outcome.code == 1
    assert ("nothing was changed" in outcome.error) == (fails == "rename")
    assert "no space left" in outcome.error
    assert names(tmp_path) == ["ab.0000.sgt.npz"]
    assert former.read_bytes() == b"mine"


def test_a_folder_takes_names_that_look_like_patterns(tmp_path):
    names = [path.name for path in sequence_files(tmp_path, 2, "s#1-q")]
    assert names == ["s#1-q.0000.sgt.npz", "s#1-q.0001.sgt.npz"]
    assert sequence_files(tmp_path, 1, "s#1-q") == [tmp_path / "s#1-q.sgt.npz"]


def test_a_damaged_header_of_an_array_is_refused_in_a_line(blend, tmp_path):
    np.save(tmp_path / "mask.npy", np.zeros((2, 2, 2), np.float32))
    content = (tmp_path / "mask.npy").read_bytes()
    (tmp_path / "mask.npy").write_bytes(content.replace(b"(2, 2, 2)", b"(2, 2, 2 ", 1))
    assert "mask.npy: not readable as a NumPy array" in blend("--mask", tmp_path / "mask.npy", "--out", "m.sgt.npz").error
