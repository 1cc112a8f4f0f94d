"""Several processes train one space: the same weights in each, the gradient of all their batches, and one that talks."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from solidgrain.runtime import TrainingError
from solidgrain.train.loop import Trainer, train
from solidgrain.train.processes import Processes, joined, local_device
from solidgrain.train.settings import Budget
from solidgrain.train.space_run import open_space_run
from solidgrain.train.warm_start import learned, warm_start
from tests.train import together
from tests.train.spaces import new_space, photographs
from tests.train.test_training import CPU, losses, tensors

TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
TRAIN = [*TORCHRUN, "-m", "solidgrain.bake.cli", "train", "--threads", "1", "--quiet"]

pytestmark = pytest.mark.skipif(not torch.distributed.is_available(), reason="this torch has no torch.distributed")


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """As `together.small`, in this process."""
    torch.set_num_threads(1)
    monkeypatch.setattr(together.loop, "_write_sample", together.loop._write_sample)
    monkeypatch.setattr(together.critic, "CONVOLUTIONS", together.critic.CONVOLUTIONS)
    monkeypatch.setattr(together.settings, "PRESETS", together.settings.PRESETS)
    together.small()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where two processes have been through `together.main`."""
    folder = tmp_path_factory.mktemp("together")
    for name in ("whole", "parts"):
        new_space(folder / name, held_out=1)
    photographs(folder / "stones", 3)
    root = os.fspath(Path(__file__).resolve().parents[2])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([root, *os.environ.get("PYTHONPATH", "").split(os.pathsep)])}
    command = [*TORCHRUN, "-m", "tests.train.together", os.fspath(folder)]
    done = subprocess.run(command, check=False, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    (folder / "stderr").write_text(done.stderr)
    return folder


@pytest.fixture(scope="module")
def found(folder):
    return [torch.load(folder / f"found.{rank}.pt") for rank in (0, 1)]


def differing(first, second):
    a, b = dict(tensors(first)), dict(tensors(second))
    assert a.keys() == b.keys()
    assert len(a) > 0
    return [name for name in a if not torch.equal(a[name], b[name])]


def test_the_averaged_gradient_is_that_of_all_batches_in_one_process(found):
    for process in found:
        for alone, averaged in zip(process["alone"], process["together"], strict=True):
            torch.testing.assert_close(averaged, alone)
    assert all(torch.equal(a, b) for a, b in zip(found[0]["together"], found[1]["together"], strict=True))


def test_all_processes_hold_the_same_weights_and_report_the_same_losses(found):
    first, second = (process["whole"] for process in found)
    assert differing(first["weights"], second["weights"]) == []
    assert first["seconds"] == second["seconds"]


def test_all_processes_begin_with_what_the_first_one_has(found):
    for process in found:
        assert all(not tensor.any() for tensor in process["shared"])


def test_each_process_draws_batches_of_its_own(found):
    assert not torch.equal(found[0]["whole"]["stream"], found[1]["whole"]["stream"])


def test_two_processes_stopped_and_resumed_are_the_uninterrupted_ones(folder, found):
    for process in found:
        assert differing(process["parts"]["weights"], process["whole"]["weights"]) == []
        assert torch.equal(process["parts"]["stream"], process["whole"]["stream"])
    assert losses(folder / "parts") == losses(folder / "whole")


def test_the_first_process_alone_writes(folder):
    """The other one fails if it tries (`together.forbid_writing`)."""
    assert [line["iteration"] for line in losses(folder / "whole")] == [1, 2, 3, 4]
    assert list(folder.rglob(".*")) == []


def test_what_fails_in_one_process_ends_the_others_without_another_word(found):
    first, second = found
    assert first["fails in 0"] == "SolidgrainError: process 0 fails"
    assert second["fails in 0"].startswith("ElsewhereError")
    assert first["fails in 1"].startswith("ElsewhereError")
    assert second["fails in 1"] == "SolidgrainError: process 1 fails"
    assert [process["fails nowhere"] for process in found] == ["made", "made"]
    assert [process["any"] for process in found] == 2 * [[False, True]]


def test_a_run_of_two_processes_is_not_resumed_by_one_nor_the_other_way_round(folder, tmp_path):
    with pytest.raises(TrainingError, match="2 processes when it was saved, 1 now; expected as many"):
        train(open_space_run(folder / "whole"), Budget(iterations=5), CPU)
    run = new_space(tmp_path / "run")
    train(run, Budget(iterations=1), CPU)
    with pytest.raises(TrainingError, match="1 processes when it was saved, 2 now; expected as many"):
        Trainer(run, CPU, Processes(1, 2)).load()


def test_a_warm_start_serves_any_number_of_processes(folder, tmp_path):
    """It is made by one of them, before anything is drawn."""
    run = new_space(tmp_path / "run")
    warm_start(run, learned(folder / "whole"), CPU)
    streams = []
    for rank in range(3):
        trainer = Trainer(run, CPU, Processes(rank, 3))
        trainer.load()
        streams.append(trainer.generator.get_state())
        assert torch.equal(trainer.critic.logit.weight, run.load_checkpoint()["critic"]["logit.weight"])
    assert not torch.equal(streams[0], streams[1])
    assert not torch.equal(streams[1], streams[2])


def test_processes_that_do_not_find_each_other_say_so(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    for name in ("RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(TrainingError, match=r"WORLD_SIZE is 2, but .*; start them with torchrun"), joined(CPU):
        pass
    with pytest.raises(TrainingError, match="start them with torchrun"), joined(torch.device("cuda")):  # of no number
        pass


def said(stderr):
    """The lines that are ours: torchrun has much to say itself."""
    ours = ("solidgrain:", "interrupted", "finishing", "stopped", "warning:", "/")
    return [line for line in stderr.splitlines() if line.startswith(ours)]


def test_the_command_line_makes_one_run_for_both_processes_and_says_so_once(folder, found):
    assert [process["exit code"] for process in found] == [0, 0]
    took, uneven, done, *_ = said((folder / "stderr").read_text())
    assert uneven.startswith("warning: 1 of 2 photographs change across themselves")
    assert re.fullmatch(rf"{folder}/whole: took over (\d+) of \1 parameter tensors", took)
    assert done == f"{folder}/run: done; next: solidgrain export {folder}/run --out BUNDLE"
    assert open_space_run(folder / "run").budget == Budget(iterations=2)
    assert len(open_space_run(folder / "run").held_out) == 1


def test_an_interrupt_of_any_process_stops_all_of_them_at_one_iteration(folder, found):
    assert [process["interrupted"] for process in found] == [130, 130]
    stopped = said((folder / "stderr").read_text())[3:]
    assert stopped == [
        f"stopped and saved; go on in 2 processes, each with: solidgrain train --resume {folder}/run --iterations 1000"
    ]
    assert open_space_run(folder / "run").load_checkpoint()["iteration"] == 3


def test_an_error_of_the_first_process_ends_both_at_once_with_one_line(tmp_path):
    started = time.monotonic()
    flags = ["--space", str(tmp_path / "nothing"), "--out", str(tmp_path / "run")]
    done = subprocess.run([*TRAIN, *flags], check=False, capture_output=True, text=True, timeout=120)
    assert done.returncode != 0
    assert said(done.stderr) == [
        f"solidgrain: {tmp_path}/nothing: no such folder; expected a folder of photographs (PNG, JPEG, TIFF, EXR, ...)"
    ]
    assert "Signal 9" not in done.stderr
    assert time.monotonic() - started < 60  # torchrun kills what hangs after half a minute
    assert list(tmp_path.iterdir()) == []


def test_a_signal_to_torchrun_stops_both_processes_and_leaves_a_checkpoint(tmp_path):
    folder = tmp_path / "run"
    new_space(folder, members=2)
    stats, flags = folder / "stats.jsonl", ["--resume", str(folder), "--iterations", "10000"]
    process = subprocess.Popen([*TRAIN, *flags], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 240
    while not (stats.exists() and stats.read_text()):
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    _, stderr = process.communicate(timeout=120)
    assert process.returncode != 0
    assert said(stderr) == [
        "finishing this iteration; once more to stop at once",
        f"stopped and saved; go on in 2 processes, each with: solidgrain train --resume {folder} --iterations 10000",
    ]
    state = open_space_run(folder).load_checkpoint()
    assert len(state["other_generators"]) == 1
    assert losses(folder)[-1]["iteration"] == state["iteration"]


def test_each_process_has_the_gpu_of_its_number(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    cuda = torch.device("cuda")
    assert local_device(cuda) == cuda
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert local_device(cuda) == torch.device("cuda", 1)
    assert local_device(CPU) == CPU
    monkeypatch.setenv("LOCAL_RANK", "2")
    with pytest.raises(TrainingError, match=r"process 2 of this machine has no GPU: torch sees 2; .* --device cpu"):
        local_device(cuda)
