"""`solidgrain verify` finds what is not as it was written, and what was not written as the texture is."""

from __future__ import annotations

import json
import os
import shutil
from hashlib import sha256

import numpy as np
import pytest

from solidgrain.bake.cli import main
from solidgrain.export.bundle import Details, write_bundle
from tests.toy import toy_weights

FLAGS = ("--size", "12x8x20", "--seed", 3, "--tile", "x", "--samples", 8, "--transform", "0,1,0,5,-1,0,0,3,0,0,2,1,0,0,0,1")
OUTPUTS = {
    "a.npy": (),
    "a.vti": (),
    "z.vti": ("--vti-compression", "zlib", "--vti-type", "uint16"),
    "a.####.exr": (),
    "f.####.exr": ("--exr-type", "float", "--exr-axis", "y", "--exr-channels", "albedo.R=r,albedo.G=g,albedo.B=b,Y=luma"),
    "m.npy": ("--mips",),
}


@pytest.fixture(scope="module")
def baked(tmp_path_factory, toy_folder):
    folder = tmp_path_factory.mktemp("baked")
    for name, flags in OUTPUTS.items():
        assert main([str(word) for word in ("bake", toy_folder, *FLAGS, "--out", folder / name, *flags, "--quiet")]) == 0
    return folder


def test_what_lies_beside_the_files_goes_with_them_and_hides_nothing(solidgrain, toy, toy_folder, tmp_path):
    folder = tmp_path / "made"
    folder.mkdir()
    (folder / "granite").write_text("a note")
    shutil.copytree(toy_folder, folder / "bundle")
    toy.save(folder / "mine.sgt.npz")
    bakes = {
        "a.npy": ("granite",),
        "b.npy": (folder / "bundle",),
        "c.npy": (folder / "mine.sgt.npz", "--bundle", folder / "bundle"),
    }
    for name, source in bakes.items():
        assert solidgrain("bake", *source, "--size", 4, "--out", folder / ".." / "made" / name, "--quiet").code == 0
    folder.rename(tmp_path / "moved")
    for name in bakes:
        outcome = solidgrain("verify", tmp_path / "moved" / name)
        assert outcome.code == 0, outcome.err


def test_a_stack_whose_name_is_not_utf_8_is_verified(solidgrain, toy_folder, tmp_path):
    name = os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.####.exr")
    assert solidgrain("bake", toy_folder, "--size", 4, "--out", name, "--quiet").code == 0
    assert solidgrain("verify", name, "--json").code == 0


@pytest.fixture
def files(baked, tmp_path, monkeypatch):
    folder = shutil.copytree(baked, tmp_path / "files")
    monkeypatch.chdir(folder)
    return folder


def test_what_was_baked_is_sound_wherever_it_lies(solidgrain, files, tmp_path_factory):
    moved = tmp_path_factory.mktemp("moved") / "here"
    files.rename(moved)
    outcome = solidgrain("verify", *[moved / name for name in OUTPUTS], "--json")
    assert outcome.code == 0
    for output in json.loads(outcome.out)["outputs"]:
        assert output["sound"]
        assert output["voxels"] == 256
        assert output["largest"] < 2e-4


@pytest.mark.parametrize(("name", "damaged"), [("a.npy", "a.npy"), ("a.####.exr", "a.0004.exr"), ("m.npy", "m.mip2.npy")])
@pytest.mark.parametrize("damage", ["flip", "cut", "remove"])
def test_a_damaged_file_is_named(solidgrain, files, name, damaged, damage):
    content = bytearray((files / damaged).read_bytes())
    content[300] ^= 1
    if damage == "remove":
        (files / damaged).unlink()
    else:
        (files / damaged).write_bytes(content[:-1] if damage == "cut" else content)
    outcome = solidgrain("verify", name)
    assert outcome.code == 3
    assert damaged in outcome.out


def test_files_that_are_whole_but_of_something_else_are_found(solidgrain, files, toy_folder):
    """As if another seed had been baked: the checksums fit the file, the colours do not fit the plan."""
    manifest = json.loads((files / "a.npy.bake.json").read_text())
    flags = [4 if word == 3 else word for word in FLAGS]
    assert solidgrain("bake", toy_folder, *flags, "--out", "a.npy", "--overwrite", "--quiet").code == 0
    manifest["files"] = json.loads((files / "a.npy.bake.json").read_text())["files"]
    (files / "a.npy.bake.json").write_text(json.dumps(manifest))
    outcome = solidgrain("verify", "a.npy")
    assert outcome.code == 3
    assert "differ from the texture" in outcome.out
    assert solidgrain("verify", "a.npy", "--voxels", 0).code == 0


def test_what_is_wrong_with_one_is_said_whatever_the_others_are(solidgrain, files):
    (files / "a.vti").write_bytes(b"damaged")
    outcome = solidgrain("verify", "none.vti", "a.vti", "no.npy", "a.npy")
    assert outcome.code == 3
    assert outcome.out.splitlines()[0].startswith("a.vti: 7 bytes, expected")
    assert outcome.out.splitlines()[1].startswith("a.npy: 1 files whole")
    assert [line.split(":")[1] for line in outcome.err.splitlines()] == [" none.vti.bake.json", " no.npy.bake.json"]
    report = json.loads(solidgrain("verify", "none.vti", "a.npy", "--json").out)
    assert [output["output"] for output in report["outputs"]] == ["a.npy"]
    assert [error.split(":")[0] for error in report["errors"]] == ["none.vti.bake.json"]
    outcome = solidgrain("verify", "none.vti", "a.npy")
    assert (outcome.code, outcome.out.splitlines()[0][:16]) == (1, "a.npy: 1 files w")
    assert "none.vti.bake.json: cannot read the manifest" in outcome.error


@pytest.mark.parametrize("with_hash", [True, False])
def test_an_edited_manifest_is_refused(solidgrain, files, with_hash):
    manifest = json.loads((files / "a.npy.bake.json").read_text())
    manifest["plan"]["seed"] = 4
    if not with_hash:
        del manifest["plan"]["hash"]
    (files / "a.npy.bake.json").write_text(json.dumps(manifest))
    assert "edited" in solidgrain("verify", "a.npy").error


def test_one_wrong_voxel_in_ten_thousand_checksums_aside(solidgrain, files):
    """A plan is evaluated again voxel by voxel, exactly as the bake did it in slabs."""
    outcome = solidgrain("verify", "a.npy", "--voxels", 12 * 8 * 20, "--json")
    assert json.loads(outcome.out)["outputs"][0]["largest"] < 1e-6
    colors = np.load(files / "a.npy")
    colors[11, 3, 7] += np.float32(0.01)
    np.save(files / "a.npy", colors)
    manifest = json.loads((files / "a.npy.bake.json").read_text())
    manifest["files"]["a.npy"]["sha256"] = sha256((files / "a.npy").read_bytes()).hexdigest()
    (files / "a.npy.bake.json").write_text(json.dumps(manifest))
    outcome = solidgrain("verify", "a.npy", "--voxels", 12 * 8 * 20)
    assert (outcome.code, "by up to 0.0100" in outcome.out) == (3, True), outcome.out


def test_another_texture_under_the_same_name_is_named(solidgrain, tmp_path):
    folder = write_bundle(tmp_path / "toy", toy_weights(), Details(name="toy", patch=64))
    assert solidgrain("bake", folder, "--size", 4, "--out", tmp_path / "a.npy", "--quiet").code == 0
    for path in sorted(folder.iterdir()):
        path.unlink()
    folder.rmdir()
    weights = toy_weights()
    weights.transforms[3] *= np.float64(1.01)
    write_bundle(folder, weights, Details(name="toy", patch=64))
    outcome = solidgrain("verify", tmp_path / "a.npy")
    assert outcome.code == 1
    assert "made with the texture" in outcome.error


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot read"),
        ("{", "not JSON"),
        ("{}", "not a manifest"),
        ("[]", "not a manifest"),
        ('{"plan": {}, "output": "a.vti", "work": "", "files": {}}', "not a manifest"),
        ('{"plan": {}, "output": "a.vti", "work": "", "files": {"a.vti": {}}}', "not a manifest"),
    ],
)
def test_a_manifest_that_is_none_is_refused_in_one_line(solidgrain, tmp_path, content, message):
    if content is not None:
        (tmp_path / "a.vti.bake.json").write_text(content)
    outcome = solidgrain("verify", tmp_path / "a.vti")
    assert outcome.code == 1
    assert message in outcome.error
