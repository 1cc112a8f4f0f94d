"""`--dask`: shards on a real cluster of processes, of which some are killed, end in the bytes of an undisturbed bake."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from distributed import Client, LocalCluster

from solidgrain import runtime
from solidgrain.bake import baker, distributed
from solidgrain.bake.baker import bake
from solidgrain.bake.distributed import bake_on_cluster, bake_shard
from solidgrain.bake.plan import Plan
from solidgrain.bake.staging import open_staging, staging_folder
from solidgrain.bake.writers import make_output
from solidgrain.export.bundle import Details, write_bundle
from solidgrain.runtime import load
from solidgrain.runtime.errors import BakeError, EvaluationError
from tests.bake.test_writers import plan_for
from tests.toy import toy_weights

SIZE = (96, 80, 160)  # ten slabs


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0", memory_limit=0, silence_logs=50
    ) as started:
        yield started


@pytest.fixture(scope="module")
def whole(toy, tmp_path_factory) -> Path:
    """The files of a bake that nothing disturbed."""
    folder = tmp_path_factory.mktemp("whole")
    bake(plan_in(folder, toy, toy_folder=""), toy)
    return folder


def plan_in(folder: Path, toy, toy_folder: object) -> Plan:
    outputs = [make_output(folder / "a.###.exr"), make_output(folder / "a.vti", compression="zlib")]
    return replace(plan_for(toy, *outputs), source=str(toy_folder), size=SIZE, spacing=(0.5, 0.5, 0.5))


def assert_same_files(folder: Path, whole: Path) -> None:
    """Manifests name their folders, so they are left out."""
    names = sorted(path.name for path in whole.iterdir())
    assert sorted(path.name for path in folder.iterdir()) == names
    for name in names:
        if not name.endswith(".bake.json"):
            assert (folder / name).read_bytes() == (whole / name).read_bytes(), name


def test_a_cluster_bakes_the_same_bytes_and_tells_who_did_what(cluster, toy, toy_folder, whole, tmp_path):
    seen: list[tuple[int, int]] = []
    plan = plan_in(tmp_path, toy, toy_folder)
    baked, told = bake_on_cluster(plan, toy, cluster.scheduler_address, 5, lambda *slices: seen.append(slices))
    assert_same_files(tmp_path, whole)
    assert len(baked.files) == 161
    assert [one["shard"] for one in told] == [1, 2, 3, 4, 5]
    assert {one["slices"] for one in told} == {32}
    assert os.getpid() not in {one["process"] for one in told}
    assert seen == [(32 * done, 160) for done in range(6)]


def in_mid_shard(folder: Path, processes: list[int]) -> int | None:
    """A process that holds a shard's lock and has written a slab of it."""
    for process in processes:
        for link in Path(f"/proc/{process}/fd").glob("*"):
            with suppress(OSError):
                held = link.readlink()
                journal = folder / held.name.replace("lock", "journal")
                if held.parent == folder and held.name.startswith("lock.") and journal.stat().st_size:
                    return process
    return None


def kill_in_mid_bake(folder: Path, address: str, killed: list[int]) -> None:
    """Kill a worker with signal 9 as soon as it is in the middle of a shard."""
    with Client(address, set_as_default=False) as client:
        processes = list(client.run(os.getpid).values())
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline and not killed:
        if process := in_mid_shard(folder, processes):
            os.kill(process, signal.SIGKILL)
            killed.append(process)
        time.sleep(0.001)


def test_a_worker_killed_in_mid_bake_changes_no_byte(toy, toy_folder, whole, tmp_path):
    plan, killed = plan_in(tmp_path, toy, toy_folder), []
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0", memory_limit=0, silence_logs=50
    ) as cluster:
        address = cluster.scheduler_address
        hand = threading.Thread(target=kill_in_mid_bake, args=(staging_folder(tmp_path / "a.vti"), address, killed))
        hand.start()
        _, told = bake_on_cluster(plan, toy, address, 2)
        hand.join()
    assert len(killed) == 1
    assert killed[0] not in {one["process"] for one in told}
    assert sum(one["reused_slices"] for one in told) > 0
    assert_same_files(tmp_path, whole)


def test_a_shard_that_is_still_held_is_tried_again(cluster, toy, toy_folder, whole, tmp_path):
    """Someone holds the first shard for longer than Dask's first try."""
    plan = plan_in(tmp_path, toy, toy_folder)
    output = plan.outputs[0]
    held = open_staging(output.path, plan.work(output), SIZE[2], 0, (0, 32), fresh=False)
    free = threading.Timer(1.0, held.close)
    free.start()
    bake_on_cluster(plan, toy, cluster.scheduler_address, 5)
    free.join()
    assert_same_files(tmp_path, whole)


def test_what_shards_have_left_is_taken_up_and_what_other_plans_have_left_only_goes_when_asked(
    cluster, toy, toy_folder, whole, tmp_path
):
    plan = plan_in(tmp_path, toy, toy_folder)
    bake(plan, toy, shard=plan.shard(2, 5))
    baked, _ = bake_on_cluster(plan, toy, cluster.scheduler_address, 5)
    assert baked.reused_slices == 32
    other = replace(plan, seed=8)
    for path in tmp_path.iterdir():
        path.unlink()
    bake(other, toy, shard=other.shard(1, 5))
    with pytest.raises(BakeError, match=r"unfinished bake of another plan lies in"):
        bake_on_cluster(plan, toy, cluster.scheduler_address, 1)
    baked, _ = bake_on_cluster(plan, toy, cluster.scheduler_address, 5, overwrite=True)
    assert baked.reused_slices == 0
    assert_same_files(tmp_path, whole)


def test_a_worker_of_many_threads_loads_once_and_bakes_a_shard_at_a_time(toy, toy_folder, whole, tmp_path, monkeypatch):
    """Dask starts as many tasks as a worker has threads, all at once."""
    plan, together, at_work, seen = plan_in(tmp_path, toy, toy_folder), threading.Barrier(4), [], []

    def watched(function):
        def call(*arguments, **keywords):
            at_work.append(function)
            time.sleep(0.05)
            seen.append(list(at_work))
            try:
                return function(*arguments, **keywords)
            finally:
                at_work.remove(function)

        return call

    def task(number: int) -> dict:
        together.wait()
        return bake_shard(plan.to_json(), number, 4, "auto", 2)

    distributed._texture.cache_clear()
    monkeypatch.setattr(runtime, "load_texture", watched(runtime.load_texture))
    monkeypatch.setattr(baker, "bake", watched(baker.bake))
    with ThreadPoolExecutor(4) as threads:
        told = list(threads.map(task, range(1, 5)))
    assert [len(running) for running in seen] == [1] * (1 + 4)
    assert {one["process"] for one in told} == {os.getpid()}
    baker.merge(plan, toy.workers)
    assert_same_files(tmp_path, whole)


def test_the_command_line_bakes_on_local_processes(solidgrain, toy_folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # relative names hold in the workers, too
    flags = ("bake", toy_folder, "--size", "9x7x40", "--seed", 5, "--tile", "z")
    assert solidgrain(*flags, "--out", "a.npy").code == 0
    outcome = solidgrain(*flags, "--out", "b.npy", "--dask", "local:2", "--threads", 3, "--json", "--quiet")
    assert outcome.code == 0
    assert outcome.err == ""
    report = json.loads(outcome.out)
    assert report["files"] == [str(tmp_path / "b.npy")]
    assert [one["slices"] for one in report["shards"]] == [16, 16, 8]
    assert (tmp_path / "a.npy").read_bytes() == (tmp_path / "b.npy").read_bytes()
    assert len(list(tmp_path.iterdir())) == 4
    assert solidgrain(*flags, "--out", "b.npy", "--dask", "local:2", "--update", "--json").code == 0


def test_what_a_shard_cannot_do_is_one_error_of_the_bake(cluster, toy, tmp_path):
    weights = toy_weights()
    weights.weights[2][0, 0] = float("nan")
    folder = write_bundle(tmp_path / "nan", weights, Details(name="nan", patch=64))
    nan = load(folder)
    with pytest.raises(BakeError, match=r"worker .* now has"):
        bake_on_cluster(plan_in(tmp_path, toy, folder), toy, cluster.scheduler_address, 1)
    with pytest.raises(EvaluationError, match="returned NaN"):
        bake_on_cluster(plan_in(tmp_path, nan, folder), nan, cluster.scheduler_address, 1)


def silent_listener() -> socket.socket:
    """Takes connections and never says a word."""
    return socket.create_server(("127.0.0.1", 0))


@pytest.mark.parametrize("kind", ["nobody", "silence", "nowhere"])
def test_a_scheduler_that_does_not_answer_is_one_error_in_time(solidgrain, toy_folder, tmp_path, monkeypatch, kind):
    monkeypatch.setattr(distributed, "PATIENCE", 1.5)
    with silent_listener() as listener:
        port = listener.getsockname()[1]
        address = {"nobody": "tcp://127.0.0.1:1", "silence": f"127.0.0.1:{port}", "nowhere": "foo://x:1"}[kind]
        started = time.monotonic()
        outcome = solidgrain("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.npy", "--dask", address)
    assert time.monotonic() - started < 5
    assert outcome.code == 1
    assert f"--dask {address}: no Dask scheduler there" in outcome.error
    assert not (tmp_path / "a.npy").exists()


def begun(folder: Path) -> int:
    """Of how many outputs some shard has written a slab."""
    shards = Counter(journal.name for journal in folder.glob(".*.baking/journal.*") if journal.stat().st_size)
    return max(shards.values(), default=0)


def test_an_interrupted_bake_goes_on_to_the_same_bytes(cluster, toy, toy_folder, whole, tmp_path):
    """Ctrl-C in a terminal reaches the workers, too."""
    plan = plan_in(tmp_path, toy, toy_folder)
    (tmp_path / "plan.json").write_text(json.dumps(plan.to_json()))
    command = [sys.executable, "-m", "solidgrain.bake.cli", "bake", "--plan", "plan.json", "--dask", "local:2", "--shards", "2"]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True)
    deadline = time.monotonic() + 120  # seconds: starting a cluster takes half of it on a busy core
    while begun(tmp_path) < len(plan.outputs) and time.monotonic() < deadline:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130, err
    assert err.strip() == "interrupted; go on with the same flags"
    (tmp_path / "plan.json").unlink()
    baked, _ = bake_on_cluster(plan, toy, cluster.scheduler_address, 2)
    assert baked.reused_slices > 0
    assert_same_files(tmp_path, whole)
