"""`encode`, `bake PHOTO` and `info` of a space: a photograph becomes a texture without torch."""

from __future__ import annotations

import gc
import json
import os
import shlex
import shutil
import subprocess
import sys
import weakref
from argparse import Namespace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from solidgrain.bake.color import to_linear, to_srgb
from solidgrain.bake.evaluate import evaluate
from solidgrain.bake.sources import Cut, Encoded, cut_patch
from solidgrain.runtime import BundleError, EvaluationError, ExemplarError, load, load_space, load_texture
from solidgrain.runtime.texture_file import read_texture
from solidgrain.train.photograph import scaled


@pytest.fixture(scope="module")
def photograph(tmp_path_factory) -> Path:
    """300 x 200 pixels of coloured noise."""
    path = tmp_path_factory.mktemp("photographs") / "cliff.png"
    pixels = np.random.default_rng(1).random((200, 300, 3), np.float32) ** np.array([1, 2, 3], np.float32)
    assert oiio.ImageBuf(pixels).write(os.fspath(path), oiio.UINT8)
    return path


@pytest.fixture(scope="module")
def pixels(photograph) -> np.ndarray:
    return oiio.ImageBuf(os.fspath(photograph)).get_pixels(oiio.FLOAT)


def test_encode_writes_the_texture_that_the_runtime_makes_of_the_middle(
    solidgrain, toy_space_folder, photograph, pixels, tmp_path
):
    out = tmp_path / "cliff.sgt.npz"
    outcome = solidgrain("encode", photograph, "--bundle", toy_space_folder, "--out", out, "--json")
    assert outcome.code == 0, outcome.err
    assert "128x128 of 300x200 pixels at its middle, 27 % of the picture" in outcome.err
    expected = load_space(toy_space_folder).encode(pixels, "cliff").data
    assert read_texture(out).sha256 == expected.sha256 == json.loads(outcome.out)["texture_sha256"]
    np.testing.assert_array_equal(load_texture(out, bundle=toy_space_folder).data.latent, expected.latent)


def test_the_cut_is_reported_and_the_scale_kept(solidgrain, toy_space_folder, photograph, tmp_path):
    out = tmp_path / "cliff.sgt.npz"
    flags = ("--patch-scale", 1.5, "--crop", "7,5", "--out", out, "--json")
    outcome = solidgrain("encode", photograph, "--bundle", toy_space_folder, *flags)
    report = json.loads(outcome.out)
    assert (report["patch_scale"], report["crop"], read_texture(out).scale) == (1.5, [7, 5], 1.5)


def test_an_advised_scale_fits(toy_space_folder, tmp_path):
    """1020 pixels are 7.96 times 128, and not 8 times."""
    picture = np.zeros((1020, 1020, 3), np.float32)
    with pytest.raises(ExemplarError, match=r"--patch-scale 7\.96$"):
        cut_patch(picture, 128, Cut(9.0), "wide.png")
    assert cut_patch(picture, 128, Cut(7.96), "wide.png")[0].shape == (128, 128, 3)


def test_a_photograph_bakes_as_the_texture_that_is_saved_beside_it(solidgrain, toy_space_folder, photograph, tmp_path):
    flags = ("--bundle", toy_space_folder, "--size", "8", "--out", tmp_path / "cliff.npy", "--quiet")
    assert solidgrain("bake", photograph, *flags).code == 0
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["cliff.npy", "cliff.npy.bake.json", "cliff.sgt.npz"]
    texture = load_texture(tmp_path / "cliff.sgt.npz", bundle=toy_space_folder)
    volume = np.load(tmp_path / "cliff.npy")
    np.testing.assert_allclose(volume, texture.grid((8, 8, 8)), atol=1 / 255)
    photograph_is_gone = json.loads((tmp_path / "cliff.npy.bake.json").read_text())["plan"]["source"]
    assert photograph_is_gone == "./cliff.sgt.npz"
    assert solidgrain("verify", tmp_path / "cliff.npy").code == 0
    assert solidgrain("bake", photograph, *flags, "--resume").code == 0


def test_no_texture_is_saved_for_files_that_stay(solidgrain, toy_space_folder, photograph, tmp_path):
    (tmp_path / "cliff.npy").touch()
    flags = ("--bundle", toy_space_folder, "--size", "8", "--out", tmp_path / "cliff.npy")
    assert solidgrain("bake", photograph, *flags, "--no-clobber").code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["cliff.npy"]


def test_a_dry_run_of_a_photograph_writes_nothing(solidgrain, toy_space_folder, photograph, tmp_path):
    flags = ("bake", photograph, "--bundle", toy_space_folder, "--size", 4, "--out", tmp_path / "a.vti")
    outcome = solidgrain(*flags, "--dry-run", "--json")
    assert outcome.code == 0, outcome.err
    assert f"{tmp_path / 'cliff.sgt.npz'}: is not there yet, and the plan needs it; bake without --dry-run" in outcome.err
    assert list(tmp_path.iterdir()) == []
    assert solidgrain(*flags, "--quiet").code == 0
    again = solidgrain(*flags, "--dry-run", "--json", "--update")
    assert "is not there yet" not in again.err
    assert json.loads(again.out)["plan"]["source"] == json.loads(outcome.out)["plan"]["source"]


def test_a_texture_that_is_there_already_stays(solidgrain, toy_space_folder, photograph, tmp_path):
    flags = ("--bundle", toy_space_folder, "--size", "4", "--quiet", "--out")
    assert solidgrain("bake", photograph, *flags, tmp_path / "a.npy").code == 0
    before = (tmp_path / "cliff.sgt.npz").read_bytes()
    for replacing in ((), ("--overwrite",), ("--update",)):  # these are about outputs
        outcome = solidgrain("bake", photograph, "--crop", "0,0", *flags, tmp_path / "b.npy", *replacing)
        assert outcome.code == 1
        assert "cliff.sgt.npz: exists, and is another texture than" in outcome.err
        assert (tmp_path / "cliff.sgt.npz").read_bytes() == before
        assert not (tmp_path / "b.npy").exists()
    assert solidgrain("bake", photograph, *flags, tmp_path / "a.npy", "--overwrite").code == 0
    (tmp_path / "cliff.sgt.npz").write_bytes(b"damaged, or of another kind")
    assert "is another texture than" in solidgrain("bake", photograph, *flags, tmp_path / "a.npy", "--overwrite").err


@pytest.mark.parametrize("error", [EvaluationError("damaged"), KeyboardInterrupt()])
def test_a_bake_that_fails_leaves_no_texture_unless_it_can_be_resumed(
    solidgrain, toy_space_folder, photograph, tmp_path, monkeypatch, error
):
    def fail(*arguments):
        raise error

    monkeypatch.setattr("solidgrain.bake.baker.evaluate", fail)
    flags = ("bake", photograph, "--bundle", toy_space_folder, "--size", "4", "--quiet", "--out", tmp_path / "a.npy")
    assert solidgrain(*flags).code in (1, 130)
    assert list(tmp_path.iterdir()) == []
    assert solidgrain(*flags, "--resume").code in (1, 130)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".a.npy.baking", "cliff.sgt.npz"]
    monkeypatch.undo()
    assert solidgrain(*flags, "--resume").code == 0
    monkeypatch.setattr("solidgrain.bake.baker.evaluate", fail)
    assert solidgrain(*flags, "--overwrite", "--seed", 1).code in (1, 130)
    assert (tmp_path / "cliff.sgt.npz").is_file()  # it was there before


def test_a_texture_that_another_bake_has_found_stays(solidgrain, toy_space_folder, photograph, tmp_path, monkeypatch):
    flags = ("bake", photograph, "--bundle", toy_space_folder, "--size", "4", "--quiet", "--out")

    def fail(*arguments):
        monkeypatch.undo()
        assert solidgrain(*flags, tmp_path / "b.npy").code == 0
        raise KeyboardInterrupt

    monkeypatch.setattr("solidgrain.bake.baker.evaluate", fail)
    assert solidgrain(*flags, tmp_path / "a.npy").code == 130
    assert solidgrain("verify", tmp_path / "b.npy").code == 0
    assert (tmp_path / "cliff.sgt.npz").is_file()


def test_a_texture_is_kept_if_one_of_its_jobs_is_baked(solidgrain, toy_space_folder, photograph, tmp_path, monkeypatch):
    good, folder = {"texture": str(photograph), "bundle": str(toy_space_folder), "size": 4}, tmp_path / "other"
    folder.mkdir()
    jobs = [{"name": "a", **good, "out": "a.npy"}, *({"name": n, **good, "out": n} for n in ("b.npy", "other/c.npy"))]
    (tmp_path / "jobs.json").write_text(json.dumps({"jobs": jobs}))
    monkeypatch.setattr("solidgrain.bake.baker.evaluate", _only_for("a.npy", evaluate))
    assert solidgrain("bake", "--jobs", tmp_path / "jobs.json", "--continue-on-error", "--quiet").code == 1
    assert (tmp_path / "cliff.sgt.npz").is_file()
    assert list(folder.iterdir()) == []


def _only_for(name, evaluate):
    """`evaluate` that fails for other outputs."""

    def fail_for_others(plan, *arguments):
        if plan.outputs[0].path.name != name:
            raise EvaluationError("damaged")
        return evaluate(plan, *arguments)

    return fail_for_others


def test_jobs_of_one_photograph_have_their_own_precision_and_one_space(toy_space_folder, photograph, tmp_path, monkeypatch):
    """As if every processor had bfloat16: the textures say which they were asked for, and are evaluated in float32."""
    loaded = []

    def load_recorded(source, *, provider, precision, threads):
        loaded.append(precision)
        return load_space(source, provider=provider, threads=threads)

    monkeypatch.setattr("solidgrain.bake.sources.load_space", load_recorded)
    named = {"bundle": str(toy_space_folder), "provider": "auto", "threads": 1, "patch_scale": None, "crop": None}
    named |= {"source": str(photograph), "out": [tmp_path / "a.npy"], "preview": None}
    jobs = [Namespace(**named, precision=precision) for precision in (None, "bfloat16", "float32", "bfloat16")]
    encoded = Encoded()
    for job in jobs:
        encoded.settle(job)
    assert loaded == ["float32", "bfloat16"]
    textures = [encoded.load(job) for job in jobs]
    assert textures[0] is textures[2]
    assert textures[1] is textures[3]
    assert textures[0] is not textures[1]
    kept = weakref.ref(textures[0])
    del textures
    encoded.save([Namespace(source=str(tmp_path / "cliff.sgt.npz"), outputs=("a.npy",))])
    gc.collect()
    assert kept() is None  # the jobs alone hold on to what they bake
    assert read_texture(tmp_path / "cliff.sgt.npz").name == "cliff"


def test_an_embedded_space_is_named_wherever_a_bundle_is(solidgrain, photograph, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    flags = ("--bundle", "stone", "--size", 4, "--quiet", "--out")
    assert solidgrain("bake", photograph, *flags, "a.npy").code == 0
    assert solidgrain("bake", "cliff.sgt.npz", *flags, "b.npy").code == 0
    assert json.loads(Path("a.npy.bake.json").read_text())["plan"]["bundle"] == "stone"
    for name in ("a.npy", "b.npy"):
        assert solidgrain("verify", name).code == 0
    assert solidgrain("bake", "--plan", "a.npy.bake.json", "--overwrite", "--quiet").code == 0
    job = {"name": "c", "texture": "cliff.sgt.npz", "bundle": "stone", "size": 4, "out": "c.npy"}
    Path("jobs.json").write_text(json.dumps({"jobs": [job]}))
    outcome = solidgrain("bake", "--jobs", "jobs.json", "--quiet")
    assert outcome.code == 0, outcome.err
    assert np.array_equal(np.load("a.npy"), np.load("c.npy"))


def test_a_job_file_takes_photographs(solidgrain, toy_space_folder, photograph, tmp_path):
    jobs = [
        {"name": "a", "texture": str(photograph), "bundle": str(toy_space_folder), "size": 4, "out": "a.npy"},
        {"name": "b", "texture": str(photograph), "bundle": str(toy_space_folder), "size": 4, "seed": 3, "out": "b.npy"},
    ]
    (tmp_path / "jobs.json").write_text(json.dumps({"jobs": jobs}))
    assert solidgrain("bake", "--jobs", tmp_path / "jobs.json", "--quiet").code == 0
    assert (tmp_path / "cliff.sgt.npz").is_file()
    assert solidgrain("verify", tmp_path / "b.npy").code == 0
    jobs[1]["crop"] = [0, 0]
    (tmp_path / "jobs.json").write_text(json.dumps({"jobs": jobs}))
    assert "two textures would be saved there" in solidgrain("bake", "--jobs", tmp_path / "jobs.json", "--overwrite").err


def test_a_cut_takes_in_what_it_says(pixels):
    corner, note = cut_patch(pixels, 64, Cut(corner=(10, 20)), "cliff.png")
    np.testing.assert_array_equal(corner, pixels[20:84, 10:74])
    assert "64x64 of 300x200 pixels from 10,20" in note
    half, note = cut_patch(pixels, 100, Cut(scale=2.0), "cliff.png")
    mean = to_linear(pixels[:, 50:250]).reshape(100, 2, 100, 2, 3).mean((1, 3), dtype=np.float32)
    np.testing.assert_allclose(half, to_srgb(mean), atol=1e-5)
    assert "200x200" in note


def test_scaling_down_keeps_the_mean_in_linear_light(pixels):
    found = scaled(pixels, 2.7)
    assert found.shape == (74, 111, 3)
    assert to_linear(found).mean() == pytest.approx(to_linear(pixels).mean(), abs=2e-3)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--patch-scale", "3"), "300x200 pixels, expected at least 384x384 (128 at --patch-scale 3)"),
        (("--crop", "200,0"), "--crop 200,0: 128x128 pixels from there leave its 300x200; expected at most 172,72"),
        (("--out", "a.npz"), "expected a name that ends in .sgt.npz"),
        (("--out", "nowhere/a.sgt.npz"), "no folder nowhere; make it first"),
        (("--bundle", "granite"), "holds one texture and no encoder; expected a space"),
        (("--bundle", "nothing"), "no such texture, bundle folder or texture file"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(solidgrain, toy_space_folder, photograph, tmp_path, flags, message):
    outcome = solidgrain("encode", photograph, "--bundle", toy_space_folder, "--out", tmp_path / "a.sgt.npz", *flags)
    assert outcome.code in (1, 2)
    assert message in outcome.error
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_nothing_can_be_written_to_is_named_before_any_work(solidgrain, photograph, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    outcome = solidgrain("encode", photograph, "--out", tmp_path / "a.sgt.npz")
    assert (outcome.code, outcome.error) == (1, f"solidgrain: {tmp_path / 'a.sgt.npz'}: folder {tmp_path} is not writable")


def test_a_photograph_that_is_none_is_one_line(solidgrain, toy_space_folder, tmp_path):
    (tmp_path / "broken.png").write_bytes(b"no picture")
    out = tmp_path / "out.sgt.npz"
    assert (
        "not readable as an image"
        in solidgrain("encode", tmp_path / "broken.png", "--bundle", toy_space_folder, "--out", out).error
    )
    assert (
        "no such file"
        in solidgrain("bake", tmp_path / "none.jpg", "--bundle", toy_space_folder, "--out", tmp_path / "a.vti").error
    )
    assert [path.name for path in tmp_path.iterdir()] == ["broken.png"]


def test_a_cut_is_for_photographs(solidgrain, tmp_path):
    outcome = solidgrain("bake", "granite", "--crop", "0,0", "--out", tmp_path / "a.vti")
    assert outcome.code == 2
    assert "are about photographs, and SOURCE is none" in outcome.error


def test_a_space_is_no_texture(solidgrain, toy_space_folder, tmp_path):
    outcome = solidgrain("bake", toy_space_folder, "--out", tmp_path / "a.vti")
    assert "is a space, which holds no texture of its own; solidgrain encode" in outcome.error
    with pytest.raises(BundleError, match="is a space"):
        load_texture(toy_space_folder)


def test_info_tells_a_space_and_checks_all_of_its_graphs(solidgrain, toy_space_folder):
    outcome = solidgrain("info", toy_space_folder, "--json")
    assert outcome.code == 0, outcome.err
    report = json.loads(outcome.out)
    assert report["probe_error"] < 1e-4
    assert report["latent"] == 32
    assert "128² pixels to 32 numbers" in solidgrain("info", toy_space_folder).out


def test_encoding_imports_no_torch(toy_space_folder, photograph, tmp_path):
    command = (
        "import sys; from solidgrain.bake.cli import main;"
        f"code = main(['encode', {str(photograph)!r}, '--bundle', {str(toy_space_folder)!r}, '--out', 'a.sgt.npz']);"
        "sys.exit(code or 'torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", command], cwd=tmp_path, check=True, capture_output=True, timeout=120)


def test_a_space_blends_from_one_end_to_the_other(toy_space_folder, pixels):
    space = load(toy_space_folder)
    first, second = space.encode(pixels), space.encode(1 - pixels)
    ends = [space.blend(first, second, at).data.sha256 for at in (0, 1)]
    assert ends == [first.data.sha256, second.data.sha256]
    middle = space.blend(first, second, 0.5)
    np.testing.assert_allclose(middle.data.latent, (first.data.latent + second.data.latent) / 2, atol=1e-6)
    steps = np.stack([space.blend(first, second, at).grid((1, 16, 16)) for at in np.linspace(0, 1, 33)])
    assert np.abs(np.diff(steps, axis=0)).max() < 0.2 * np.abs(steps[-1] - steps[0]).max() + 0.05


def test_a_blend_of_adapted_textures_reaches_both(toy_space_folder, pixels):
    from dataclasses import replace

    space = load_space(toy_space_folder)
    first, second = space.encode(pixels), space.encode(1 - pixels)
    adapted = space.open(replace(first.data, gamma=first.data.gamma + np.float32(0.25)))
    almost = space.blend(adapted, second, 1e-7).data
    np.testing.assert_allclose(almost.gamma, adapted.data.gamma, atol=1e-4)
    np.testing.assert_allclose(
        space.blend(adapted, second, 0.5).data.gamma, space.blend(first, second, 0.5).data.gamma + 0.125, atol=1e-4
    )


def test_textures_of_another_space_are_not_blended(toy_space_folder, pixels):
    space, granite = load_space(toy_space_folder), load_texture("granite")
    with pytest.raises(BundleError, match="only textures of one space can be blended"):
        space.blend(space.encode(pixels), granite, 0.5)


@pytest.mark.parametrize(
    ("exemplar", "message"),
    [
        (np.zeros((64, 200, 3), np.uint8), "200x64 pixels, expected at least 128x128"),
        (np.zeros((128, 128), np.uint8), "expected [H, W, 3]"),
        (np.full((128, 128, 3), 2.0), "expected uint8, or floats from 0 to 1"),
        (np.full((128, 128, 3), np.nan), "expected uint8, or floats from 0 to 1"),
        (np.zeros((128, 128, 3), np.int32), "expected uint8, or floats from 0 to 1"),
    ],
)
def test_what_is_no_photograph_is_refused(toy_space_folder, exemplar, message):
    with pytest.raises(ExemplarError) as caught:
        load_space(toy_space_folder).encode(exemplar)
    assert message in str(caught.value)


@pytest.mark.parametrize("scale", [0, -1, float("nan"), float("inf")])
def test_a_scale_that_no_texture_file_may_have_is_refused(toy_space_folder, pixels, scale):
    with pytest.raises(ExemplarError, match="expected a number above 0"):
        load_space(toy_space_folder).encode(pixels, scale=scale)


def test_bytes_and_floats_encode_alike(toy_space_folder, pixels):
    space = load_space(toy_space_folder)
    np.testing.assert_allclose(space.code(pixels), space.code(np.round(pixels * 255).astype(np.uint8)), atol=1e-6)


@pytest.mark.parametrize("scale", ["0.001", "1e307", "nan", "0"])
def test_a_scale_of_no_photograph_is_refused(solidgrain, tmp_path, scale):
    outcome = solidgrain("encode", tmp_path / "p.png", "--out", tmp_path / "p.sgt.npz", "--patch-scale", scale)
    assert outcome.code == 2
    assert "expected pixels of the photograph per texture pixel, from 0.01 to 1000" in outcome.error


def test_an_image_is_a_photograph_whatever_it_is_called(solidgrain, toy_space_folder, photograph, tmp_path):
    shutil.copy(photograph, tmp_path / "my stone")
    flags = ("--bundle", toy_space_folder, "--size", 4, "--out")
    assert solidgrain("bake", tmp_path / "my stone", *flags, tmp_path / "a.npy").code == 0
    assert solidgrain("bake", photograph, *flags, tmp_path / "b.npy").code == 0
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), np.load(tmp_path / "b.npy"))
    encoded = solidgrain("encode", tmp_path / "my stone", "--bundle", toy_space_folder, "--out", tmp_path / "a b.sgt.npz")
    command = shlex.split(encoded.err.splitlines()[-1].partition("next: solidgrain ")[2])
    assert command[:2] == ["bake", str(tmp_path / "a b.sgt.npz")]
    assert "damaged one; save it again, or solidgrain encode a photograph" in solidgrain("info", tmp_path / "my stone").error
