"""A bake that was stopped at any moment, shared out, or run twice ends in the files of an undisturbed one."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from solidgrain.bake import report as report_module
from solidgrain.bake import staging as staging_module
from solidgrain.bake.baker import bake, merge
from solidgrain.bake.interrupts import uninterrupted
from solidgrain.bake.schema import load_plan
from solidgrain.bake.staging import is_begun, open_staging, staged_bytes, staging_folder
from solidgrain.bake.writers import PREVIEW, make_output
from solidgrain.runtime import BakeError
from tests.bake.test_command_bake import HEEDING
from tests.bake.test_writers import SIZE, plan_for

NAMES = ("a.####.exr", "a.vti", "z.vti", "a.npy", "x.####.exr", "m.npy", "m.####.exr", "a.png")


def outputs(folder: Path, names: tuple[str, ...] = NAMES) -> list:
    """One output of every way to keep bytes: files, streams, compressed streams, turned, with mips, and planes."""
    options: dict[str, dict[str, str | int]] = {
        "z.vti": {"compression": "zlib"},
        "x.####.exr": {"axis": "x"},
        "m.npy": {"mips": "kaiser"},
        "m.####.exr": {"mips": "box"},
    }
    kinds = {"a.png": PREVIEW}
    return [make_output(folder / name, kinds.get(name, ""), **options.get(name, {})) for name in names]


def contents(folder: Path) -> dict[str, bytes]:
    """All files but the manifests, which name the folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if not path.name.endswith(".bake.json")}


@pytest.fixture(scope="module")
def undisturbed(toy, tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    bake(plan_for(toy, *outputs(folder)), toy)
    return contents(folder)


class StopError(Exception):
    """Stands for a kill between two slabs."""


def stop_after(slices: int):
    def on_slice(done: int, total: int) -> None:
        if done >= slices:
            raise StopError

    return on_slice


def test_a_resumed_bake_evaluates_only_what_is_missing(toy, tmp_path, undisturbed):
    plan = plan_for(toy, *outputs(tmp_path))
    with pytest.raises(StopError):
        bake(plan, toy, stop_after(16), resume=True)
    baked = bake(plan, toy, resume=True)
    assert baked.reused_slices == 16
    assert contents(tmp_path) == undisturbed


def test_without_resume_nothing_is_left_and_nothing_is_reused(toy, tmp_path, undisturbed):
    plan = plan_for(toy, *outputs(tmp_path))
    with pytest.raises(StopError):
        bake(plan, toy, stop_after(16))
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(StopError):
        bake(plan, toy, stop_after(16), resume=True)
    assert bake(plan, toy).reused_slices == 0
    assert contents(tmp_path) == undisturbed


@pytest.mark.parametrize("damage", ["flip", "cut", "grow", "remove", "tear"])
def test_bytes_that_a_crash_damaged_are_made_again(toy, tmp_path, undisturbed, damage):
    plan = plan_for(toy, *outputs(tmp_path))
    with pytest.raises(StopError):
        bake(plan, toy, stop_after(SIZE[2]), resume=True)
    for folder in tmp_path.glob(".*.baking"):
        name = "journal.*" if damage == "tear" else "[a-z]*[.0-9][0-9][0-9][0-9]*"
        for path in sorted(
            path for path in folder.glob(name) if damage == "tear" or not path.name.startswith(("journal", "lock"))
        ):
            content = bytearray(path.read_bytes())
            if damage == "remove":
                path.unlink()
                continue
            if damage == "flip":
                content[len(content) // 2] ^= 1
            path.write_bytes(
                content[: len(content) - 7] if damage in ("cut", "tear") else content + b"xyz" * (damage == "grow")
            )
    bake(plan, toy, resume=True)
    assert contents(tmp_path) == undisturbed


def test_shards_in_any_order_and_in_several_processes_merge_to_the_same_files(toy, tmp_path, undisturbed):
    plan = plan_for(toy, *outputs(tmp_path))
    assert [plan.shard(k, 3) for k in (1, 2, 3)] == [(0, 0), (0, 16), (16, 19)]
    with pytest.raises(BakeError, match="slices 0 to 18 are missing"):
        merge(plan, toy.workers)
    for shard in ((16, 19), (0, 16)):
        assert bake(plan, toy, shard=shard).files == []
    assert bake(plan, toy, shard=(0, 16)).reused_slices == 16
    merge(plan, toy.workers)
    assert contents(tmp_path) == undisturbed


def test_whole_bakes_take_up_what_shards_have_left(toy, tmp_path):
    """Whatever slabs are there, in whichever streams: the others come after them in a stream, before them in the file."""
    size, folders = (5, 4, 100), [tmp_path / name for name in ("whole", "shards")]
    names = ("a.####.exr", "z.vti", "a.npy", "x.####.exr", "m.npy", "a.vdb", "a.png")
    for folder in folders:
        folder.mkdir()
    bake(plan_for(toy, *outputs(folders[0], names), size=size), toy)
    plan = plan_for(toy, *outputs(folders[1], names), size=size)
    with pytest.raises(StopError):
        bake(plan, toy, stop_after(32), shard=(0, 48))
    bake(plan, toy, shard=(64, 80))
    with pytest.raises(StopError):
        bake(plan, toy, stop_after(16 + 48), resume=True)
    bake(plan, toy, shard=(96, 100))
    assert bake(plan, toy, resume=True).reused_slices == 16 + 32 + 16 + 4
    assert contents(folders[1]) == contents(folders[0])


def test_a_shard_without_slabs_is_done_at_once_whoever_works_beside_it(toy, tmp_path):
    plan = plan_for(toy, *outputs(tmp_path, ("a.vti",)))
    (output,) = plan.outputs
    with closing(open_staging(output.path, plan.work(output), SIZE[2], 0, (0, 16), fresh=False)):
        assert plan.shard(1, 3) == (0, 0)
        assert bake(plan, toy, shard=(0, 0)).files == []


def test_the_disk_must_have_room_for_what_a_merge_copies(toy, tmp_path):
    plan = plan_for(toy, *outputs(tmp_path, ("a.npy",)), size=(16, 16, 64))
    for number in (1, 2, 3, 4):
        bake(plan, toy, shard=plan.shard(number, 4))
    first = 16 * 16 * 16 * 12 + 128
    assert first < staged_bytes(tmp_path / "a.npy") < first + 8192  # journals and the plan besides


def test_many_shards_are_whole_slabs_and_cover_every_slice_once(toy):
    plan = plan_for(toy, size=(4, 4, 1000))
    for count in (1, 2, 7, 63, 64, 100):
        shards = [plan.shard(k, count) for k in range(1, count + 1)]
        assert [z for first, stop in shards for z in range(first, stop)] == list(range(1000))
        assert all(first % plan.slab == 0 for first, _ in shards)


def test_a_missing_shard_is_named(toy, tmp_path):
    plan = plan_for(toy, *outputs(tmp_path))
    bake(plan, toy, shard=(0, 16))
    with pytest.raises(BakeError, match="slices 16 to 18 are missing"):
        merge(plan, toy.workers)


def test_work_of_another_plan_is_never_reused_silently(toy, tmp_path):
    with pytest.raises(StopError):
        bake(plan_for(toy, *outputs(tmp_path, ("a.vti",))), toy, stop_after(16), resume=True)
    for changes in ({"size": (7, 5, 20)}, {"samples": 8}, {"tile": "x"}):
        with pytest.raises(BakeError, match=r"a\.vti: an unfinished bake of another plan.*different: "):
            bake(plan_for(toy, *outputs(tmp_path, ("a.vti",)), **changes), toy, resume=True)


@pytest.mark.parametrize("survivor", ["journal", "data", "finished"])
def test_leftovers_that_have_lost_their_name_are_not_believed(toy, tmp_path, survivor, monkeypatch):
    """As after a kill in the middle of removing them, in any order of files."""
    plan, other = (plan_for(toy, *outputs(tmp_path, ("a.vti", "a.####.exr")), **changes) for changes in ({}, {"samples": 8}))
    if survivor == "finished":
        monkeypatch.setattr("solidgrain.bake.staging.Staging.commit", lambda *_: stop_after(0)(0, 0))
    with pytest.raises(StopError):
        bake(other, toy, stop_after(SIZE[2] if survivor != "finished" else 99), resume=True)
    monkeypatch.undo()
    for folder in tmp_path.glob(".*.baking"):
        (folder / "work.json").unlink()
        for path in folder.glob("*.0*"):
            if survivor == "data" and path.name.startswith("journal"):
                path.unlink()
    bake(plan, toy, resume=True)
    undisturbed = tmp_path / "undisturbed"
    undisturbed.mkdir()
    bake(plan_for(toy, *outputs(undisturbed, ("a.vti", "a.####.exr"))), toy)
    files = contents(undisturbed)
    for path in undisturbed.iterdir():
        path.unlink()
    undisturbed.rmdir()
    assert contents(tmp_path) == files


def test_an_error_between_two_renames_keeps_what_is_needed_to_go_on(toy, tmp_path, undisturbed, monkeypatch):
    """Without `resume`, too: the files that are replaced already cannot be brought back."""
    plan, replaced, count = plan_for(toy, *outputs(tmp_path)), os.replace, 0

    def fail(source, target):
        nonlocal count
        count += Path(target).parent == tmp_path
        if count == 5:
            count += 1
            raise OSError(5, "Input/output error")
        replaced(source, target)

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(BakeError, match="Input/output error"):
        bake(plan, toy)
    monkeypatch.undo()
    bake(plan, toy, resume=True)
    assert contents(tmp_path) == undisturbed


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_waits_until_the_files_are_in_place(tmp_path, toy_folder, number):
    process = start(toy_folder, tmp_path, "--size", "4x4x1500", "--out", "a.####.exr", "--out", "b.npy")
    wait_for(lambda: list(tmp_path.glob("a.0*.exr")) or process.poll() is not None)
    process.send_signal(number)
    process.communicate(timeout=60)
    assert len(list(tmp_path.glob("a.*.exr"))) == 1500
    assert sorted(path.name for path in tmp_path.iterdir() if not path.name.startswith(("a.0", "a.1"))) == [
        "a.####.exr.bake.json", "a.vti", "a.vti.bake.json", "b.npy", "b.npy.bake.json",
    ]  # fmt: skip


def test_a_smaller_bake_leaves_no_slices_of_the_one_that_it_replaces(solidgrain, tmp_path, toy_folder):
    for depth in (12, 5):
        flags = ("--size", f"4x4x{depth}", "--out", tmp_path / "a.##.exr", "--overwrite", "--quiet")
        assert solidgrain("bake", toy_folder, *flags).code == 0
    assert [path.name for path in sorted(tmp_path.glob("a.*.exr"))] == [f"a.{k:02d}.exr" for k in range(1, 6)]


def test_two_spellings_of_a_frame_pattern_are_one_output(solidgrain, tmp_path, toy_folder):
    def run(command, name, *flags):
        outcome = solidgrain(command, *(() if command != "bake" else (toy_folder, "--out")), tmp_path / name, *flags)
        assert outcome.code == 0, outcome.err

    run("bake", "a.####.exr", "--size", "4x4x6")
    run("bake", "a.%04d.exr", "--size", "4x4x3", "--overwrite")
    assert {path.name for path in tmp_path.iterdir()} == {*(f"a.000{k}.exr" for k in (1, 2, 3)), "a.####.exr.bake.json"}
    for name in ("a.####.exr", "a.%04d.exr"):
        run("verify", name)
    run("bake", "b.####.exr", "--size", "4x4x20", "--shard", "1/2")
    run("bake", "b.%04d.exr", "--size", "4x4x20", "--shard", "2/2")
    run("merge", "b.%04d.exr")
    run("verify", "b.####.exr")


def test_a_folder_that_an_open_lock_keeps_is_removed_after_it(tmp_path, monkeypatch):
    """NFS gives an open file that is removed another name until it is closed."""
    staging = open_staging(tmp_path / "a.npy", {}, 4, 0, None, fresh=True)
    (lock,), other = staging._locks, staging.folder / ".nfs0001"

    def unlink(path, missing_ok=False, real=Path.unlink):
        return path.rename(other) if path.name == "lock" else real(path, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", unlink)
    staging._locks = [SimpleNamespace(close=lambda: (lock.close(), other.unlink()))]
    staging.clear()
    assert list(staging.folder.iterdir()) == [other]
    staging.close()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("known", "raised"), [(None, False), (signal.SIG_DFL, True)], ids=["of a host", "in another thread"])
def test_handlers_that_are_not_pythons_stay(monkeypatch, known, raised):
    """Applications that embed Python have handlers in C, or call it in a thread that `threading` takes for the main one."""

    def refuse(number, handler):
        if raised:
            raise ValueError("signal only works in main thread of the main interpreter")
        raise AssertionError("replaced")

    monkeypatch.setattr(signal, "getsignal", lambda number: known)
    monkeypatch.setattr(signal, "signal", refuse)
    with uninterrupted():
        pass


def test_replacing_files_can_be_resumed(solidgrain, tmp_path, toy, toy_folder):
    flags = ("bake", toy_folder, "--size", "6x5x40", "--out", tmp_path / "a.npy", "--quiet")
    assert solidgrain(*flags, "--seed", 1).code == 0
    assert "already exists" in solidgrain(*flags, "--shard", "1/2").error
    assert solidgrain(*flags, "--shard", "1/2", "--overwrite").code == 0
    report = json.loads(solidgrain(*flags, "--resume", "--overwrite", "--json").out)
    assert report["reused_slices"] == 16
    assert np.array_equal(np.load(tmp_path / "a.npy"), toy.grid((40, 5, 6)))


def interrupt(*_):
    raise KeyboardInterrupt


def test_what_another_plan_has_left_does_not_make_an_output_its_own(solidgrain, toy_folder, tmp_path, monkeypatch):
    file = tmp_path / "a.npy"
    assert solidgrain("bake", toy_folder, "--size", 4, "--out", file, "--quiet").code == 0
    before = file.read_bytes()
    with monkeypatch.context() as patch:  # stopped before the first file is in place
        patch.setattr("solidgrain.bake.staging.Staging.commit", interrupt)
        flags = ("--size", 4, "--seed", 2, "--resume", "--overwrite", "--quiet")
        assert solidgrain("bake", toy_folder, *flags, "--out", file).code == 130
    assert is_begun(file)
    assert solidgrain("bake", toy_folder, "--size", 4, "--seed", 3, "--out", file, "--no-clobber", "--quiet").code == 0
    assert file.read_bytes() == before


def test_two_processes_cannot_write_the_same_output(toy, tmp_path):
    plan = plan_for(toy, *outputs(tmp_path, ("a.vti",)))
    (output,) = plan.outputs
    owner = open_staging(output.path, plan.work(output), SIZE[2], 0, None, fresh=True)
    try:
        with pytest.raises(BakeError, match="another process is baking it"):
            bake(plan, toy)
        with pytest.raises(BakeError, match="another process is baking it"):
            bake(plan, toy, shard=(0, 16))
    finally:
        owner.close()
    bake(plan, toy)


def test_two_shards_can_be_baked_at_once_but_not_the_same_one(toy, tmp_path):
    plan = plan_for(toy, *outputs(tmp_path, ("a.vti",)))
    (output,) = plan.outputs
    owner = open_staging(output.path, plan.work(output), SIZE[2], 0, (0, 16), fresh=False)
    try:
        with pytest.raises(BakeError, match="another process is baking it"):
            bake(plan, toy, shard=(0, 16))
        with pytest.raises(BakeError, match="another process is baking it"):
            merge(plan, toy.workers)
        bake(plan, toy, shard=(16, 19))
    finally:
        owner.close()


def test_a_dead_owner_holds_no_lock(toy, tmp_path, toy_folder):
    process = start(toy_folder, tmp_path, "--size", "512")
    wait_for(lambda: list(tmp_path.glob(".a.vti.baking/journal.*")))
    process.send_signal(signal.SIGSTOP)
    refused = run(toy_folder, tmp_path, "--size", "512", "--resume")
    assert refused.returncode == 1
    assert "another process is baking it" in refused.stderr
    process.kill()
    process.communicate()
    assert staging_folder(tmp_path / "a.vti").exists()
    assert run(toy_folder, tmp_path, "--size", "8").returncode == 0  # another plan, without --resume: begins anew
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


@pytest.mark.parametrize("finals", [0, 1, 5, 19])
def test_a_kill_between_two_renames_leaves_the_rest_to_be_done(toy, tmp_path, undisturbed, monkeypatch, finals):
    plan = plan_for(toy, *outputs(tmp_path))
    replaced, count = os.replace, 0

    def fail(source, target):
        nonlocal count
        count += Path(target).parent == tmp_path
        if count > finals and Path(target).parent == tmp_path:
            raise StopError
        replaced(source, target)

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(StopError):
        bake(plan, toy, resume=True)
    monkeypatch.undo()
    bake(plan, toy, resume=True)
    assert contents(tmp_path) == undisturbed


def test_a_full_disk_fails_in_one_line_and_the_bake_goes_on_after_space_is_made(toy, tmp_path, undisturbed, monkeypatch):
    plan = plan_for(toy, *outputs(tmp_path))
    synced, left = os.fsync, 25

    def full(number):
        nonlocal left
        left -= 1
        if left < 0:
            raise OSError(28, "No space left on device")
        synced(number)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(BakeError, match="No space left on device"):
        bake(plan, toy, resume=True)
    monkeypatch.undo()
    bake(plan, toy, resume=True)
    assert contents(tmp_path) == undisturbed


FLAGS = [
    "--size",
    "24x24x160",
    "--out",
    "a.####.exr",
    "--out",
    "a.vti",
    "--out",
    "z.npy",
    "--mips",
    "--vti-compression",
    "zlib",
]


def test_kills_at_random_moments_end_in_the_same_files(tmp_path, toy_folder):
    campaign(tmp_path, toy_folder, kills=12)


@pytest.mark.slow
def test_a_thousand_kills_at_random_moments_end_in_the_same_files(tmp_path, toy_folder):
    campaign(tmp_path, toy_folder, kills=1000)


def campaign(folder: Path, bundle: Path, kills: int) -> None:
    """Kill resumed bakes with signal 9 until so many have died; each volume that gets finished must be the undisturbed one."""
    (folder / "expected").mkdir()
    command = [sys.executable, "-m", "solidgrain.bake.cli", "bake", str(bundle), "--quiet", *FLAGS]
    started = time.monotonic()
    subprocess.run(command, cwd=folder / "expected", check=True, env=quick())
    seconds = time.monotonic() - started
    expected = contents(folder / "expected")
    draw, killed, finished = random.Random(7), 0, 0
    while killed < kills or not finished:
        target = folder / f"try{finished}"
        target.mkdir(exist_ok=True)
        process = subprocess.Popen([*command, "--resume"], cwd=target, env=quick())
        try:
            code = process.wait(draw.uniform(0.3, 1.0) * seconds if killed < kills else 120)
            assert code == 0
            assert contents(target) == expected
            finished += 1
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            killed += 1


def quick() -> dict[str, str]:
    """One thread for libraries that would start more."""
    return {**os.environ, "OMP_NUM_THREADS": "1"}


def start(bundle: Path, folder: Path, *flags: str) -> subprocess.Popen[str]:
    program = [*HEEDING, sys.executable, "-m", "solidgrain.bake.cli"]
    command = [*program, "bake", str(bundle), "--quiet", "--out", "a.vti", *flags]
    return subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True)


def run(bundle: Path, folder: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    process = start(bundle, folder, *flags)
    _, err = process.communicate(timeout=60)
    return subprocess.CompletedProcess(process.args, process.returncode, "", err)


def wait_for(condition) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_resume_update_and_shards_on_the_command_line(solidgrain, tmp_path, toy_folder, monkeypatch):
    monkeypatch.chdir(tmp_path)
    flags = ("bake", toy_folder, "--size", "6x5x40", "--out", "a.####.exr", "--out", "a.npy")
    assert solidgrain(*flags, "--shard", "2/2").code == 0
    assert [path.name for path in tmp_path.iterdir() if not path.name.startswith(".")] == []
    assert solidgrain(*flags, "--resume").code == 0
    first = contents(tmp_path)
    assert "already exists" in solidgrain(*flags).error
    for again in ("--resume", "--update", "--shard=1/2"):
        report = json.loads(solidgrain(*flags, again, "--json", "--quiet").out)
        assert report["files"] == []
    (tmp_path / "a.0007.exr").write_bytes(b"damaged")
    assert "already exists" in solidgrain(*flags, "--resume").error
    assert solidgrain(*flags, "--update").code == 0
    assert contents(tmp_path) == first
    assert solidgrain("bake", toy_folder, "--size", "6x5x41", "--out", "a.npy", "--update").code == 0
    assert (tmp_path / "a.npy").stat().st_size == 128 + 6 * 5 * 41 * 12


def test_a_share_without_slabs_is_said_to_be_empty(solidgrain, tmp_path, toy_folder):
    flags = ("bake", toy_folder, "--size", "6x5x40", "--out", tmp_path / "a.vti", "--shard", "1/8")
    outcome = solidgrain(*flags, "--json")
    assert outcome.code == 0
    assert outcome.error == "toy: no slabs in this share"
    assert json.loads(outcome.out)["files"] == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("flag", ["--update", "--resume"])
def test_a_plan_that_is_done_leaves_the_shards_of_another_alone(solidgrain, tmp_path, toy_folder, flag):
    flags = ("bake", toy_folder, "--size", "6x5x40", "--out", tmp_path / "a.npy", "--quiet")
    assert solidgrain(*flags).code == 0
    assert solidgrain(*flags, "--seed", 1, "--shard", "1/2", "--overwrite").code == 0
    assert solidgrain(*flags, flag).code == 0
    report = json.loads(solidgrain(*flags, "--seed", 1, "--resume", "--overwrite", "--json").out)
    assert report["reused_slices"] == 16


def test_work_of_another_plan_gives_way_to_overwrite_resumed_or_not(solidgrain, tmp_path, toy_folder):
    flags = ("bake", toy_folder, "--size", "6x5x40", "--out", tmp_path / "a.npy", "--quiet", "--resume")
    assert solidgrain(*flags, "--seed", 1, "--shard", "1/2").code == 0
    assert "begin anew with --overwrite" in solidgrain(*flags).error
    assert solidgrain(*flags, "--overwrite").code == 0


def test_figures_are_those_of_the_shard(solidgrain, tmp_path, toy_folder, monkeypatch):
    flags = ("bake", toy_folder, "--size", "6x5x64", "--out", tmp_path / "a.npy", "--quiet", "--json")
    report = json.loads(solidgrain(*flags, "--shard", "1/4").out)
    assert report["voxels_per_second"] == pytest.approx(6 * 5 * 16 / report["seconds"], rel=0.1)
    report = json.loads(solidgrain(*flags, "--resume").out)
    assert report["reused_slices"] == 16
    assert report["voxels_per_second"] == pytest.approx(6 * 5 * 48 / report["seconds"], rel=0.1)
    monkeypatch.setattr(report_module, "measure_rate", lambda *_: 1000.0)
    for shard, slices in (("--seed=1", 64), ("--shard=1/4", 16)):
        assert json.loads(solidgrain(*flags, "--overwrite", "--dry-run", shard).out)["seconds"] == 0.03 * slices


def test_a_finished_output_is_merged_where_it_was_moved_to(solidgrain, tmp_path, toy_folder, monkeypatch):
    (tmp_path / "before").mkdir()
    monkeypatch.chdir(tmp_path / "before")
    assert solidgrain("bake", toy_folder, "--size", 4, "--out", "a.npy", "--out", "b.npy", "--quiet").code == 0
    monkeypatch.chdir(tmp_path)
    (tmp_path / "before").rename(tmp_path / "after")
    outcome = solidgrain("merge", tmp_path / "after" / "a.npy")
    assert (outcome.code, outcome.error) == (0, "toy: nothing to merge, its files are whole")


def test_a_bake_that_cannot_begin_leaves_nothing_behind(toy, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(staging_module, "replacing", full)
    with pytest.raises(BakeError, match="No space left on device"):
        bake(plan_for(toy, make_output(tmp_path / "a.npy")), toy)
    assert list(tmp_path.iterdir()) == []


def test_a_dry_run_removes_nothing(solidgrain, tmp_path, toy_folder):
    flags = ("bake", toy_folder, "--size", "6x5x40", "--out", tmp_path / "a.npy", "--quiet")
    assert solidgrain(*flags).code == 0
    plan = load_plan(tmp_path / "a.npy.bake.json")
    open_staging(tmp_path / "a.npy", plan.work(plan.outputs[0]), 40, 0, None, fresh=True).close()  # as a kill leaves it
    staging = staging_folder(tmp_path / "a.npy")
    assert solidgrain(*flags, "--update", "--dry-run").code == 0
    assert staging.exists()
    assert solidgrain(*flags, "--update").code == 0
    assert not staging.exists()
    assert solidgrain(*flags, "--seed", 1, "--shard", "1/2", "--overwrite").code == 0
    before = contents(staging)
    assert solidgrain(*flags, "--shard", "1/2", "--overwrite", "--seed", 2, "--dry-run").code == 0
    assert contents(staging) == before
    (tmp_path / "a.npy").unlink()
    assert "an unfinished bake of another plan" in solidgrain(*flags, "--seed", 2, "--shard", "1/2", "--dry-run").error


@pytest.fixture
def small_disk(tmp_path):
    """A file system of two megabytes."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", folder], capture_output=True, check=False)
    if mounted.returncode:
        pytest.skip(f"cannot mount a small file system: {mounted.stderr.decode().strip()}")
    yield folder
    subprocess.run(["umount", folder], check=True)


@pytest.mark.parametrize(
    "name", ["a.####.exr", "a.vti", "z.vti", "a.npy", "x.####.exr", "m.npy", "a.vdb", "a.dds", "a.atlas.png", "a.png"]
)
def test_a_disk_that_fills_up_leaves_a_bake_to_resume(toy, small_disk, tmp_path, name):
    size = (48, 40, 20)
    undisturbed, filler = tmp_path / "undisturbed", small_disk / "filler"
    undisturbed.mkdir()
    bake(plan_for(toy, *outputs(undisturbed, (name,)), size=size), toy)
    plan = plan_for(toy, *outputs(small_disk, (name,)), size=size)
    filler.write_bytes(bytes(2 * 2**20 - 60_000))
    with pytest.raises(BakeError, match=r"No space left|cannot write") as failure:
        bake(plan, toy, resume=True)
    assert "\n" not in str(failure.value)
    assert [path.name for path in small_disk.iterdir()] == [f".{name}.baking", "filler"]
    filler.unlink()
    bake(plan, toy, resume=True)
    assert contents(small_disk) == contents(undisturbed)
    for path in small_disk.iterdir():
        path.unlink()
    filler.write_bytes(bytes(2 * 2**20 - 60_000))
    with pytest.raises(BakeError):
        bake(plan, toy)
    assert [path.name for path in small_disk.iterdir()] == ["filler"]
