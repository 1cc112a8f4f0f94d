"""`solidgrain bake` on the command line: what it prints, what it refuses, what it leaves behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import OpenImageIO as oiio
import pytest

from solidgrain.bake import checks, report
from solidgrain.export.bundle import Details, write_bundle
from tests.toy import toy_weights


def test_the_readme_bake_makes_a_stack_a_volume_and_a_preview(solidgrain, tmp_path):
    outcome = solidgrain(
        "bake", "granite", "--size", 32, "--seed", 7,
        "--out", tmp_path / "granite.####.exr", "--out", tmp_path / "granite.vti", "--preview", tmp_path / "granite.png",
    )  # fmt: skip
    assert outcome.code == 0
    assert outcome.out == ""
    assert len(list(tmp_path.iterdir())) == 32 + 2 + 3  # slices, volume and preview, a manifest for each output


def test_json_is_one_object_on_stdout(solidgrain, tmp_path, toy_folder):
    outcome = solidgrain("bake", toy_folder, "--size", "8x6x4", "--out", tmp_path / "a.vti", "--json", "--quiet")
    assert outcome.err == ""
    report = json.loads(outcome.out)
    assert report["files"] == [str(tmp_path / "a.vti")]
    assert report["plan"]["size"] == [8, 6, 4]
    assert len(report["plan"]["hash"]) == 64


def test_a_dry_run_writes_nothing_and_tells_bytes_memory_and_time(solidgrain, tmp_path, toy_folder):
    outcome = solidgrain("bake", toy_folder, "--size", 64, "--out", tmp_path / "a.npy", "--dry-run", "--json", "--tile", "xy")
    report = json.loads(outcome.out)
    assert report["bytes_at_most"][str(tmp_path / "a.npy")] == 128 + 64**3 * 12
    assert report["memory_bytes"] > 0
    assert report["seconds"] > 0
    assert len(report["tile_distortion"]) == 16
    assert list(tmp_path.iterdir()) == []
    assert "memory" in solidgrain("bake", toy_folder, "--dry-run").out


def test_a_texture_file_bakes_with_its_bundle(solidgrain, tmp_path, toy, toy_folder):
    toy.save(tmp_path / "mine.sgt.npz")
    outcome = solidgrain("bake", tmp_path / "mine.sgt.npz", "--bundle", toy_folder, "--size", 4, "--out", tmp_path / "a.npy")
    assert outcome.code == 0
    assert np.array_equal(np.load(tmp_path / "a.npy"), toy.grid((4, 4, 4)))


def test_threads_and_origin_reach_the_sampler(solidgrain, tmp_path, toy, toy_folder):
    solidgrain(
        "bake", toy_folder, "--size", "4x3x2", "--threads", 1, "--origin", "1e9,-5,0.5", "--spacing", 2, "--seed", 2**64 - 1,
        "--out", tmp_path / "a.npy",
    )  # fmt: skip
    assert np.array_equal(np.load(tmp_path / "a.npy"), toy.grid((2, 3, 4), 2**64 - 1, origin=(1e9, -5, 0.5), spacing=2))


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--size", "0"], "--size"),
        (["--size", "-4"], "--size"),
        (["--size", "4x4"], "--size"),
        (["--size", "big"], "--size"),
        (["--seed", "-1"], "--seed"),
        (["--seed", str(2**64)], "--seed"),
        (["--spacing", "0"], "--spacing"),
        (["--origin", "1,2"], "--origin"),
        (["--origin", "nan,0,0"], "--origin"),
        (["--tile", "xw"], "--tile"),
        (["--threads", "-1"], "--threads"),
        (["--nonsense"], "--nonsense"),
        (["--overwrite", "--no-clobber"], "--no-clobber"),
    ],
)
def test_flags_that_make_no_sense_are_usage_errors_in_one_line(solidgrain, tmp_path, toy_folder, flags, message):
    outcome = solidgrain("bake", toy_folder, "--out", tmp_path / "a.vti", *flags)
    assert outcome.code == 2
    assert message in outcome.error
    assert list(tmp_path.iterdir()) == []


USAGE = (
    "pick one of .exr",
    "a.####.exr",
    "a.vti: two outputs",
    "a.01.exr: two outputs",
    "ends in .png",
    "no use for it",
    "no --out of whole numbers",
    "nothing to write",
    "expected at most",
)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--out", "a.tga"], "pick one of .exr"),
        (["--out", "a.exr"], "a.####.exr"),
        (["--out", "a.vti", "--out", "./a.vti"], "a.vti: two outputs"),
        (["--out", "a.##.exr", "--out", "a.%02d.exr", "--size", "4"], "a.01.exr: two outputs"),
        (["--preview", "a.jpg"], "ends in .png"),
        (["--preview", "a.png", "--dither"], "no use for it"),
        (["--preview", "a.png", "--mip-filter", "box"], "no use for it"),
        (["--out", "a.vti", "--vti-type", "float32", "--dither"], "no --out of whole numbers"),
        (["--out", "missing/a.vti"], "does not exist"),
        (["--out", "a.vti", "--size", "1000x1000x10000000"], "free"),
        (["--out", "a.vti", "--size", "2000000x2000000x1"], "memory"),
        (["--preview", "a.png", "--size", "1x1x9000000000"], "memory"),
        (["--out", "a.####.exr", "--size", "1000000000"], "memory"),
        (["--out", "a.vti", "--origin", "-1e300,0,0"], "expected at most"),
        (["--out", "a.vti", "--provider", "rocket"], "provider 'rocket'"),
        ([], "nothing to write"),
    ],
)
def test_what_cannot_work_is_refused_before_any_work(solidgrain, tmp_path, toy_folder, monkeypatch, flags, message):
    monkeypatch.chdir(tmp_path)
    outcome = solidgrain("bake", toy_folder, *flags)
    assert outcome.code == (2 if message in USAGE else 1)
    assert message in outcome.error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("source", "message"), [("granit", "did you mean granite"), ("nothing-like-it", "embedded textures are")]
)
def test_an_unknown_texture_is_refused_with_a_hint(solidgrain, tmp_path, source, message):
    outcome = solidgrain("bake", source, "--out", tmp_path / "a.vti")
    assert outcome.code == 1
    assert message in outcome.error


def test_an_existing_output_is_kept_unless_told_otherwise(solidgrain, tmp_path, toy_folder):
    (tmp_path / "a.npy").write_text("mine")
    refused = solidgrain("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.npy")
    assert refused.code == 1
    assert "already exists" in refused.error
    skipped = solidgrain(
        "bake", toy_folder, "--size", 4, "--out", tmp_path / "a.npy", "--out", tmp_path / "b.npy", "--no-clobber"
    )
    assert skipped.code == 0
    assert skipped.err.splitlines()[0] == f"{tmp_path / 'a.npy'}: skipped, its files are there"
    again = solidgrain("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.npy", "--no-clobber", "--json", "--quiet")
    assert (json.loads(again.out)["skipped"], again.err) == ([str(tmp_path / "a.npy")], "")
    assert (tmp_path / "a.npy").read_text() == "mine"
    assert (tmp_path / "b.npy").exists()
    assert solidgrain("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.npy", "--overwrite").code == 0
    assert np.load(tmp_path / "a.npy").shape == (4, 4, 4, 3)


def test_one_existing_slice_is_enough_to_refuse_a_stack(solidgrain, tmp_path, toy_folder):
    (tmp_path / "a.0003.exr").write_text("mine")
    outcome = solidgrain("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.####.exr")
    assert "a.0003.exr: already exists" in outcome.error
    assert len(list(tmp_path.iterdir())) == 1
    kept = solidgrain("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.####.exr", "--no-clobber")
    assert "skipped, 1 of its 4 files are there; --update completes it" in kept.error


def test_a_link_to_nowhere_is_somebody_s(solidgrain, tmp_path, toy_folder):
    (tmp_path / "a.npy").symlink_to("/nonexistent/store/a.npy")
    assert "a.npy: already exists" in solidgrain("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.npy").error
    assert solidgrain("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.npy", "--no-clobber").code == 0
    assert (tmp_path / "a.npy").is_symlink()


def test_a_plan_takes_no_photograph(solidgrain, tmp_path, toy_folder, toy_space_folder):
    oiio.ImageBuf(np.full((128, 128, 3), 0.5, np.float32)).write(str(tmp_path / "photo.png"), oiio.UINT8)
    assert solidgrain("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.npy").code == 0
    flags = ("--plan", tmp_path / "a.npy.bake.json", "--overwrite", "--bundle", toy_space_folder)
    outcome = solidgrain("bake", tmp_path / "photo.png", *flags)
    assert outcome.code == 2
    assert "takes a texture file for SOURCE; solidgrain encode makes one of the photograph" in outcome.err


def test_an_unwritable_folder_is_refused(solidgrain, tmp_path, toy_folder, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root, who runs many CIs, may write everywhere
    outcome = solidgrain("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.vti")
    assert outcome.code == 1
    assert "not writable" in outcome.error


def test_a_folder_that_refuses_writes_is_an_error_in_one_line(solidgrain, toy_folder):
    outcome = solidgrain("bake", toy_folder, "--size", 4, "--out", "/proc/a.vti")
    assert outcome.code == 1
    assert "/proc/a.vti" in outcome.error or "/proc" in outcome.error


def test_a_model_that_returns_nan_leaves_nothing_behind(solidgrain, tmp_path):
    weights = toy_weights()
    weights.weights[2][0, 0] = np.nan
    folder = write_bundle(tmp_path / "nan", weights, Details(name="nan", patch=64))
    (tmp_path / "out").mkdir()
    outcome = solidgrain(
        "bake", folder, "--size", 8, "--out", tmp_path / "out" / "a.####.exr", "--out", tmp_path / "out" / "a.vti"
    )
    assert outcome.code == 1
    assert "returned NaN" in outcome.error
    assert list((tmp_path / "out").iterdir()) == []


# Shells let the jobs that they start in the background ignore Ctrl-C, nohup SIGHUP, and children inherit it.
HEEDING = ("env", "--default-signal=INT,HUP")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_leaves_nothing_behind_and_exits_with_130(tmp_path, toy_folder, number):
    command = [*HEEDING, sys.executable, "-m", "solidgrain.bake.cli", "bake", toy_folder, "--size", "512", "--quiet"]
    outputs = ["--out", tmp_path / "a.####.exr", "--out", tmp_path / "a.vti", "--out", tmp_path / "a.npy"]
    process = subprocess.Popen([*map(str, command), *map(str, outputs)], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob(".a.npy.baking/data.*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.5)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err.strip().splitlines()[-1].startswith("interrupted")
    assert list(tmp_path.iterdir()) == []


def test_help_lists_the_commands_and_no_command_is_a_usage_error(solidgrain):
    assert "bake" in solidgrain("--help").out
    assert solidgrain().code == 2
    assert solidgrain("frobnicate").code == 2


def test_a_control_group_bounds_the_memory_that_is_available(tmp_path):
    """A container of 1000 bytes in a job of 400."""
    (tmp_path / "own").write_text("1:name=systemd:/x\n0::/job/container\n")
    for folder, limit, used in (("job/container", "1000", 500), ("job", "400", 300), ("", "max", 10**6)):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        (tmp_path / folder / "memory.max").write_text(f"{limit}\n")
        (tmp_path / folder / "memory.current").write_text(f"{used}\n")
    (tmp_path / "job" / "memory.stat").write_text("anon 7\ninactive_file 20\n")
    assert sorted(checks._left_by_groups(tmp_path, tmp_path / "own")) == [120, 500]
    assert checks._left_by_groups(tmp_path, tmp_path / "none") == []
    assert checks.available_memory() > 0


def test_time_left_is_told_once_something_is_done(monkeypatch, capsys):
    """The first call says what was there from the start."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    clock = iter([0.0, 0.0, 1.0, 2.0])
    monkeypatch.setattr(report, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    progress = report.Progress(quiet=False)
    for done in (64, 80, 96):
        progress.show(done, 256)
    shown = capsys.readouterr().err.split("\r")[1:]
    assert [line.split("] ")[1] for line in shown] == ["slice 64/256 ", "slice 80/256, 11 s left ", "slice 96/256, 10 s left "]


def test_a_bake_without_the_fused_kernel_says_why(solidgrain, tmp_path, toy_folder, monkeypatch):
    monkeypatch.setenv("SOLIDGRAIN_KERNEL_LIBRARY", "/nonexistent")
    outcome = solidgrain("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.npy", "--json")
    assert json.loads(outcome.out)["provider_note"]
    assert "toy: evaluated by CPUExecutionProvider, no fused kernel: " in outcome.err


def test_an_empty_name_is_not_taken_for_the_default(solidgrain, tmp_path, toy_folder):
    outcome = solidgrain("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.vdb", "--vdb-grid", "")
    assert outcome.code == 2
    assert list(tmp_path.iterdir()) == []
