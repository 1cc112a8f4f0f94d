"""Training goes on where it stopped, to the last bit; what it leaves behind can be exported and says where it came from."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from importlib.metadata import version

import numpy as np
import onnx
import OpenImageIO as oiio
import pytest
import torch

from solidgrain.export.evaluation import planes_of, scale_of
from solidgrain.export.from_run import check_agreement, export_run, sampler_weights
from solidgrain.runtime import BundleError, TrainingError, load
from solidgrain.runtime.bundle import open_bundle
from solidgrain.runtime.files import temporary_name
from solidgrain.train import command, loop
from solidgrain.train import run as run_module
from solidgrain.train.exemplar import edge_step
from solidgrain.train.loop import Trainer, train
from solidgrain.train.photograph import read_exemplar
from solidgrain.train.precision import use_bfloat16
from solidgrain.train.run import Source, create_run, held, open_run, pixels_sha256
from solidgrain.train.sampler import Sampler
from solidgrain.train.settings import Budget, preset
from solidgrain.train.slices import Planes
from solidgrain.train.streams import stream
from solidgrain.train.task import SingleExemplar, make_task
from tests.train.conftest import blotches

TINY = {
    "octaves": 4,
    "width": 32,
    "patch": 32,
    "batch": 2,
    "checkpoint_every": 4,
    "sample_every": 4,
    "report_every": 1,
    "precision": "float32",
    "critic_start": "",
    "sampler_start": "",
}
CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def new_run(folder, photograph, **changes):
    settings = preset("fast", **{**TINY, **changes})
    return create_run(
        folder, settings, read_exemplar(photograph, settings.patch), Source(photograph.name, "CC0-1.0", "nobody"), Budget()
    )


def losses(folder):
    """The statistics without the clock."""
    lines = [json.loads(line) for line in (folder / "stats.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if name != "seconds"} for line in lines]


def tensors(state, prefix=""):
    for name, value in state.items():
        if isinstance(value, dict):
            yield from tensors(value, f"{prefix}{name}.")
        elif isinstance(value, torch.Tensor):
            yield f"{prefix}{name}", value


def assert_same_checkpoint(first, second):
    a, b = dict(tensors(open_run(first).load_checkpoint())), dict(tensors(open_run(second).load_checkpoint()))
    assert a.keys() == b.keys()
    assert [name for name in a if not torch.equal(a[name], b[name])] == []


def endless_training(folder, until):
    """A run going on in a process of its own, for stopping, once it has written a file of that name."""
    flags = ["train", "--resume", str(folder), "--threads", "1", "--iterations", "10000"]
    process = subprocess.Popen([sys.executable, "-m", "solidgrain.bake.cli", *flags], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not (folder / until).exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    return process


@pytest.fixture(scope="module")
def whole(tmp_path_factory, photograph):
    """Ten iterations in one go."""
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("runs") / "whole"
    train(new_run(folder, photograph), Budget(iterations=10), CPU)
    return folder


def test_a_run_stopped_and_resumed_is_the_uninterrupted_one(whole, tmp_path, photograph):
    folder = tmp_path / "parts"
    train(new_run(folder, photograph), Budget(iterations=3), CPU)
    train(open_run(folder), Budget(iterations=7), CPU)
    train(open_run(folder), Budget(iterations=10), CPU)
    assert losses(folder) == losses(whole)
    assert_same_checkpoint(folder, whole)


def test_resuming_is_exact_in_bfloat16_and_on_two_threads_as_well(tmp_path, photograph):
    torch.set_num_threads(2)
    for name, parts in (("whole", [5]), ("parts", [2, 5])):
        new_run(tmp_path / name, photograph, precision="bfloat16")
        for iterations in parts:
            train(open_run(tmp_path / name), Budget(iterations=iterations), CPU)
    assert losses(tmp_path / "parts") == losses(tmp_path / "whole")
    assert_same_checkpoint(tmp_path / "parts", tmp_path / "whole")


def test_bfloat16_is_chosen_where_it_is_faster(monkeypatch):
    """With AMX, and with AMD's AVX-512 BF16; not with Intel's alone, which does not multiply faster; and where asked for."""
    for amx, avx512, cpu, faster in (
        (True, True, "Intel Xeon Processor", True),
        (False, True, "Intel Xeon Processor", False),
        (False, True, "AMD EPYC", True),
        (False, False, "AMD EPYC", False),
        (False, True, None, False),  # a torch that does not say whose processor it is
    ):
        monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda amx=amx: amx)
        capabilities = {"avx512_bf16": avx512} | ({"cpu_name": cpu} if cpu else {})
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda found=capabilities: found, raising=False)
        assert use_bfloat16(preset("fast"), CPU) is faster
        for precision in ("float32", "bfloat16"):
            assert use_bfloat16(replace(preset("fast"), precision=precision), CPU) is (precision == "bfloat16")


def test_later_patches_are_larger_where_the_exemplar_has_room(tmp_path, photograph):
    """And a run resumes across the change to the same numbers."""
    changes = {"later_patch": 40, "later_from": 4, "later_room": 2}
    whole, halves = (new_run(tmp_path / name, photograph, **changes) for name in ("whole", "halves"))
    assert min(whole.exemplar.shape[:2]) == 80
    task, sizes = make_task(whole, CPU), []
    for iteration in (0, 3, 4):
        (_, points), real, *_ = task.draw(iteration, torch.Generator().manual_seed(0))
        assert points.shape[1] == real.shape[2] * real.shape[3]
        sizes.append(real.shape[2])
    assert sizes == [32, 32, 40]
    train(whole, Budget(iterations=6), CPU)
    train(halves, Budget(iterations=3), CPU)
    train(halves, Budget(iterations=6), CPU)
    assert losses(whole.folder) == losses(halves.folder)
    for name, patch, room in (("large", 41, 2), ("many", 27, 3)):
        small = new_run(tmp_path / name, photograph, later_patch=patch, later_from=0, later_room=room)
        assert small.settings_at(9).patch == 32
    card = (export_run(whole.folder, tmp_path / "bundle") / "card.md").read_text()
    assert "2 of 32², 40² from iteration 4 on, pixels per iteration" in card


def test_the_sampler_learns_colours_and_its_octaves_do_not(tmp_path, photograph):
    runs = [new_run(tmp_path / f"weight-{weight:g}", photograph, color_weight=weight) for weight in (0.0, 1.0)]
    for run, counted in zip(runs, (False, True), strict=True):
        train(run, Budget(iterations=1), CPU)
        assert [isinstance(line["color"], float) for line in losses(run.folder)] == [counted]
    trainer = Trainer(new_run(tmp_path / "run", photograph), CPU)
    batch = trainer.task.draw(0, trainer.generator)
    trainer._color_loss(batch.colors).backward()
    assert trainer.sampler.output.weight.grad.abs().max() > 0
    assert trainer.sampler.directions.grad is None
    assert trainer.sampler.directions.requires_grad


def test_the_verdict_of_d_weighs_less_as_training_goes_on(tmp_path, photograph):
    """With a half-life of a hundredth of an iteration, alpha counts in the first iteration and in no other."""

    def gradient(name, first, **changes):
        trainer = Trainer(new_run(tmp_path / name, photograph, color_weight=0.0, **changes), CPU)
        trainer.iteration = first
        trainer.step()
        return trainer.sampler.output.weight.grad

    for first, like, unlike in ((0, "stays", "none"), (10, "none", "stays")):
        found = {
            "stays": gradient(f"stays-{first}", first, alpha=1.0, alpha_half_life=0.0),
            "falls": gradient(f"falls-{first}", first, alpha=1.0, alpha_half_life=0.01),
            "none": gradient(f"none-{first}", first, alpha=0.0),
        }
        assert torch.equal(found["falls"], found[like])
        assert not torch.equal(found["falls"], found[unlike])


def test_a_run_with_a_checkpoint_is_not_begun_again(tmp_path, photograph, monkeypatch):
    run = new_run(tmp_path / "run", photograph)
    train(run, Budget(iterations=1), CPU)
    monkeypatch.setattr(SingleExemplar, "begin", lambda *_: pytest.fail("begun again"))
    train(run, Budget(iterations=2), CPU)


def test_a_killed_run_resumes_to_the_same_numbers(tmp_path, photograph):
    """Signal 9 in the middle, after the first checkpoint: statistics past it are rewound and written again."""
    folder = tmp_path / "killed"
    new_run(folder, photograph)
    process = endless_training(folder, until="checkpoint.pt")
    time.sleep(0.3)
    process.kill()
    process.communicate()
    further = Budget(iterations=open_run(folder).load_checkpoint()["iteration"] + 3)
    train(open_run(folder), further, CPU)
    train(new_run(tmp_path / "whole", photograph), further, CPU)
    assert losses(folder) == losses(tmp_path / "whole")
    assert_same_checkpoint(folder, tmp_path / "whole")


def test_two_processes_cannot_train_the_same_run(tmp_path, photograph, solidgrain):
    folder = tmp_path / "run"
    new_run(folder, photograph)
    process = endless_training(folder, until="checkpoint.pt")
    for second in (("--resume", folder), (photograph, "--out", folder)):
        outcome = solidgrain("train", *second, "--iterations", 1, "--threads", 1)
        assert (outcome.code, outcome.err) == (
            1, f"solidgrain: {folder}: another process is training it; wait for it, or choose another --out\n"
        )  # fmt: skip
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert "stopped and saved" in said
    assert not (folder / "lock").exists()
    numbers = [line["iteration"] for line in losses(folder)]
    assert numbers == list(range(1, len(numbers) + 1))


def test_what_kills_have_left_is_removed_when_the_run_goes_on(tmp_path, photograph, solidgrain):
    folder = tmp_path / "run"
    run = new_run(folder, photograph)
    left = [temporary_name(folder / name) for name in ("checkpoint.pt", "stats.jsonl", "samples/000004.png")]
    mine = [folder / ".notes.tmp", folder / ".0123456789abcdef.tmp.pt", tmp_path / temporary_name(folder).name]
    for path in (*left, *mine):
        path.touch()
    with held(run.folder):
        assert not any(path.exists() for path in left)
        assert all(path.exists() for path in mine)


def test_samples_have_a_folder_again_and_any_name(tmp_path, photograph):
    run = new_run(tmp_path / os.fsdecode(b"run\xff"), photograph)
    (run.folder / "samples").rmdir()
    train(run, Budget(iterations=1), CPU)
    assert [path.name for path in (run.folder / "samples").iterdir()] == ["000001.png"]


def test_every_seed_is_another_training():
    seeds = ((0,), (1,), (2**32,), (2**32 + 1,), (2**64 - 1,), (0, 1), (1, 1), (0, 1, 1), (2**32, 1))
    streams = [stream(CPU, *numbers) for numbers in seeds]
    assert len({int(torch.randint(2**62, (), generator=one)) for one in streams}) == len(streams)
    again, plain = stream(CPU, 7), torch.Generator().manual_seed(7)
    assert torch.equal(torch.randn(9, generator=again), torch.randn(9, generator=plain))


@pytest.mark.parametrize("name", ["checkpoint.pt", "exemplar.npy", "samples/000500.png"])
def test_what_another_run_has_left_is_not_taken_for_this_one_s(tmp_path, photograph, name):
    left = tmp_path / "run" / name
    left.parent.mkdir(parents=True)
    left.write_text("mine")
    with pytest.raises(TrainingError, match="is there already, without a run; remove it or choose another --out"):
        new_run(tmp_path / "run", photograph)
    assert left.read_text() == "mine"


def test_a_file_in_the_place_of_a_run_is_named(tmp_path, photograph, solidgrain):
    (tmp_path / "run").write_text("mine")
    outcome = solidgrain("train", photograph, "--out", tmp_path / "run", "--iterations", 1)
    assert (outcome.code, outcome.err) == (
        1, f"solidgrain: {tmp_path / 'run'}: cannot write the run directory (File exists)\n"
    )  # fmt: skip
    assert (tmp_path / "run").read_text() == "mine"


def test_half_a_line_of_statistics_is_dropped_on_resume(tmp_path, photograph):
    folder = tmp_path / "run"
    train(new_run(folder, photograph), Budget(iterations=4), CPU)
    with open(folder / "stats.jsonl", "a") as file:
        file.write('{"iteration": 5, "sec')
    train(open_run(folder), Budget(iterations=5), CPU)
    assert [line["iteration"] for line in losses(folder)] == [1, 2, 3, 4, 5]


def test_a_run_leaves_samples_with_the_exemplar_an_axis_slice_and_an_oblique_one(whole, photograph):
    names = sorted(path.name for path in (whole / "samples").iterdir())
    assert names == ["000004.png", "000008.png", "000010.png"]
    picture = oiio.ImageBuf(os.fspath(whole / "samples" / names[-1])).get_pixels(oiio.FLOAT)
    assert picture.shape == (256, 768, 3)
    np.testing.assert_allclose(picture[:80, :96], read_exemplar(photograph, 64), atol=1 / 255)
    assert np.abs(picture[:, 256:512] - picture[:, 512:]).mean() > 0.005


def test_training_learns_the_colours_of_the_exemplar(tmp_path, photograph):
    shares = np.linspace(0, 1, 33)
    wanted = np.quantile(read_exemplar(photograph, 64), shares, axis=(0, 1))
    run, errors = new_run(tmp_path / "run", photograph, average_decay=0.9, principal_colors=False), []
    for iterations in (1, 80):
        train(run, Budget(iterations=iterations), CPU)
        texture = load(export_run(run.folder, tmp_path / f"after-{iterations}"))
        slices = np.stack([texture.grid((1, 64, 64), seed=seed) for seed in range(8)])
        errors.append(np.abs(np.quantile(slices, shares, axis=(0, 1, 2, 3)) - wanted).mean())
    assert errors[1] < errors[0] / 2


@pytest.mark.parametrize(("name", "span"), [("fast", 7.0), ("paper", 15.0)])
def test_torch_and_onnx_runtime_agree_near_and_far(name, span):
    sampler = Sampler(preset(name), torch.Generator().manual_seed(1))
    assert check_agreement(sampler, sampler_weights(sampler)) <= 1e-4


def test_an_exported_bundle_says_where_it_came_from(whole, tmp_path):
    bundle = load(export_run(whole, tmp_path / "blotches")).bundle
    training = bundle.manifest["training"]
    assert training["iterations"] == 10
    assert training["exemplars"][0]["exemplar"] == "blotches.png"
    assert training["exemplars"][0]["license"] == "CC0-1.0"
    assert training["settings"]["patch"] == 32
    assert bundle.manifest["opset"] == onnx.load(bundle.folder / "sampler.onnx").opset_import[0].version
    assert "CC0-1.0" in (bundle.folder / "card.md").read_text()


def test_export_refuses_what_is_no_finished_run(whole, tmp_path, photograph, solidgrain):
    new_run(tmp_path / "fresh", photograph)
    with pytest.raises(TrainingError, match="no checkpoint yet"):
        export_run(tmp_path / "fresh", tmp_path / "a")
    assert "not a run directory" in solidgrain("export", tmp_path, "--out", tmp_path / "a").error
    with pytest.raises(BundleError, match="already exists"):
        export_run(whole, tmp_path / "fresh")
    (tmp_path / "fresh" / "checkpoint.pt").write_bytes(b"hello")
    assert "damaged checkpoint" in solidgrain("export", tmp_path / "fresh", "--out", tmp_path / "a").error
    assert not (tmp_path / "a").exists()


def test_a_diverging_run_says_so_and_keeps_its_last_checkpoint(tmp_path, photograph):
    folder = tmp_path / "run"
    train(new_run(folder, photograph, principal_colors=False), Budget(iterations=4), CPU)
    before = (folder / "checkpoint.pt").read_bytes()
    run = open_run(folder)
    run.exemplar[:] = np.nan
    with pytest.raises(TrainingError, match="diverged at iteration 5"):
        train(run, Budget(iterations=8), CPU)
    assert (folder / "checkpoint.pt").read_bytes() == before


def test_ctrl_c_saves_and_says_how_to_go_on(tmp_path, photograph):
    folder = tmp_path / "run"
    new_run(folder, photograph)
    process = endless_training(folder, until="stats.jsonl")
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert f"solidgrain train --resume {folder}" in err
    done = open_run(folder).load_checkpoint()["iteration"]
    assert losses(folder)[-1]["iteration"] == done


def test_who_cannot_wait_for_the_last_save_is_told_how_to_go_on(tmp_path, photograph, solidgrain, monkeypatch):
    new_run(tmp_path / "run", photograph)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(loop, "train", interrupted)
    outcome = solidgrain("train", "--resume", tmp_path / "run", "--threads", 1)
    assert outcome.code == 130
    assert outcome.err.endswith(
        f"interrupted; go on from its last checkpoint with: solidgrain train --resume {tmp_path / 'run'}\n"
    )


def test_below_the_checkout_of_another_project_the_revision_is_the_version_alone(tmp_path, monkeypatch):
    installed = tmp_path / ".venv" / "run.py"
    installed.parent.mkdir()
    installed.touch()
    author = ("-c", "user.name=a", "-c", "user.email=a@b")
    for words in (("init", "-q"), (*author, "commit", "-q", "--allow-empty", "-m", "a")):
        subprocess.run(["git", "-C", tmp_path, *words], check=True)
    monkeypatch.setattr(run_module, "__file__", str(installed))
    assert run_module.source_revision() == version("solidgrain")
    subprocess.run(["git", "-C", tmp_path, "add", installed], check=True)
    assert re.fullmatch(r"\S+ \([0-9a-f]{7,}-dirty\)", run_module.source_revision())


def test_a_training_that_was_finished_is_not_called_stopped(tmp_path, photograph, solidgrain, monkeypatch):
    """Ctrl-C while its last checkpoint is written."""
    new_run(tmp_path / "run", photograph)
    asked = iter([False, False])
    monkeypatch.setattr(command.StopRequest, "requested", lambda self: next(asked, True))
    outcome = solidgrain("train", "--resume", tmp_path / "run", "--iterations", 2, "--threads", 1)
    assert outcome.code == 0
    assert f"done; next: solidgrain export {tmp_path / 'run'}" in outcome.err


def test_who_resumes_with_another_budget_is_told_it_again(tmp_path, photograph, solidgrain, monkeypatch):
    new_run(tmp_path / "run", photograph)
    monkeypatch.setattr(command.StopRequest, "requested", lambda self: True)
    outcome = solidgrain("train", "--resume", tmp_path / "run", "--minutes", 1.5, "--threads", 1)
    assert outcome.code == 130
    assert outcome.err.splitlines()[-1].endswith(f"solidgrain train --resume {tmp_path / 'run'} --minutes 1.5")


def test_the_command_line_trains_and_exports(solidgrain, tmp_path, photograph):
    outcome = solidgrain(
        "train", photograph, "--out", tmp_path / "run", "--iterations", 2, "--patch", 32, "--batch", 1, "--threads", 1,
        "--license", "CC0-1.0", "--credit", "nobody",
    )  # fmt: skip
    assert outcome.code == 0, outcome.err
    assert "solidgrain export" in outcome.err
    assert open_run(tmp_path / "run").settings.later_patch == 0  # the flag's side all along
    assert solidgrain("export", tmp_path / "run", "--out", tmp_path / "bundle").code == 0
    assert solidgrain("bake", tmp_path / "bundle", "--size", 4, "--out", tmp_path / "a.npy").code == 0


def test_a_photograph_can_be_reduced_and_its_bundle_remembers_by_how_much(solidgrain, tmp_path):
    grey = np.kron(blotches(70, 65).mean(2, keepdims=True), np.ones((2, 2, 3), np.float32))  # 140 x 130
    oiio.ImageBuf(np.ascontiguousarray(grey, np.float32)).write(os.fspath(tmp_path / "large.png"), oiio.UINT8)
    flags = ["--iterations", 1, "--patch", 32, "--batch", 1, "--threads", 1, "--patch-scale", 2]
    assert solidgrain("train", tmp_path / "large.png", "--out", tmp_path / "run", *flags).code == 0
    run = open_run(tmp_path / "run")
    assert run.exemplar.shape == (70, 65, 3)
    np.testing.assert_allclose(run.exemplar, grey[::2, ::2], atol=1 / 255)
    assert solidgrain("export", tmp_path / "run", "--out", tmp_path / "bundle").code == 0
    bundle = open_bundle(tmp_path / "bundle")
    assert scale_of(bundle) == 2
    (entry,) = bundle.manifest["training"]["exemplars"]
    assert entry["photograph_sha256"] == pixels_sha256(read_exemplar(tmp_path / "large.png", 64))
    assert "one pixel for every 2" in (bundle.folder / "card.md").read_text()


@pytest.mark.parametrize(
    ("flags", "code", "message"),
    [
        (["--iterations", "0"], 2, "--iterations"),
        (["--minutes", "-1"], 2, "--minutes"),
        (["--minutes", "nan"], 2, "--minutes"),
        (["--minutes", "inf"], 2, "--minutes"),
        (["--seed", "1" + 25 * "0"], 2, "--seed"),
        (["--threads", "-5"], 2, "--threads"),
        (["--patch", "8"], 2, "--patch 8"),
        (["--patch", "81"], 1, "expected at least 81x81"),
        (["--patch-scale", "2"], 1, "expected at least 128x128"),
        (["--patch-scale", "0.5"], 2, "never enlarged"),
        (["--batch", "0"], 2, "--batch"),
        (["--preset", "slow"], 2, "--preset"),
        (["--anisotropic", "z"], 2, "--anisotropic: expected auto, x or y, found 'z'; put what is no axis before the flag"),
        (["--upright"], 2, "--upright: slices that stay upright turn about one axis; add --anisotropic"),
    ],
)
def test_flags_that_make_no_sense_are_refused_in_one_line(solidgrain, tmp_path, photograph, flags, code, message):
    outcome = solidgrain("train", photograph, "--out", tmp_path / "run", *flags)
    assert outcome.code == code
    assert message in outcome.error
    assert list(tmp_path.iterdir()) == []


def test_what_was_trained_upright_says_so_and_is_measured_so(solidgrain, tmp_path, photograph):
    flags = ["--anisotropic", "y", "--upright", "--patch", 32, "--batch", 1, "--iterations", 1]
    assert solidgrain("train", photograph, "--out", tmp_path / "run", *flags).code == 0
    assert solidgrain("export", tmp_path / "run", "--out", tmp_path / "bundle").code == 0
    assert planes_of(open_bundle(tmp_path / "bundle")) == Planes("y", upright=True)
    assert "turned about the y axis only, upright, from xy to zy" in (tmp_path / "bundle" / "card.md").read_text()


def test_the_photographs_of_a_space_are_not_reduced(solidgrain, tmp_path):
    outcome = solidgrain("train", "--space", tmp_path, "--patch-scale", 2, "--out", tmp_path / "run")
    assert outcome.code == 2
    assert "--patch-scale: is about one photograph" in outcome.error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_without_a_device_is_an_error_not_a_fall_back(solidgrain, tmp_path, photograph):
    outcome = solidgrain("train", photograph, "--out", tmp_path / "run", "--device", "cuda")
    assert outcome.code == 1
    assert "sees no CUDA device" in outcome.error
    assert list(tmp_path.iterdir()) == []


def test_resuming_keeps_the_run_s_budget_and_refuses_other_settings(solidgrain, tmp_path, photograph):
    folder = tmp_path / "run"
    flags = ["--patch", 32, "--batch", 1, "--threads", 1]
    assert solidgrain("train", photograph, "--out", folder, "--iterations", 2, *flags).code == 0
    assert open_run(folder).budget == Budget(iterations=2)
    assert solidgrain("train", "--resume", folder, "--threads", 1).code == 0  # spent: nothing to do
    assert open_run(folder).load_checkpoint()["iteration"] == 2
    refused = solidgrain("train", "--resume", folder, "--patch", 64, "--seed", 9)
    assert refused.code == 2
    assert "--patch, --seed" in refused.error
    assert solidgrain("train", photograph, "--resume", folder).code == 2
    assert solidgrain("train", "--out", tmp_path / "other").code == 2


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("options.json", b"{}", "damaged run directory"),
        ("options.json", b"hello", "damaged run directory"),
        ("exemplar.npy", b"", "damaged run directory"),
        ("exemplar.npy", None, "damaged run directory"),
        ("exemplar.npy", b"\x93NUMPY\1\0v\0" + b"{'descr': '<f4', (".ljust(117) + b"\n", "damaged run directory"),
        ("checkpoint.pt", b"", "damaged checkpoint"),
    ],
)
def test_a_damaged_run_is_refused_in_one_line(solidgrain, tmp_path, photograph, name, content, message):
    folder = tmp_path / "run"
    new_run(folder, photograph)
    if content is None:
        (folder / name).unlink()
    else:
        (folder / name).write_bytes(content)
    outcome = solidgrain("train", "--resume", folder, "--iterations", 1, "--threads", 1)
    assert outcome.code == 1
    assert message in outcome.error


def test_a_checkpoint_of_other_settings_is_refused(tmp_path, photograph):
    train(new_run(tmp_path / "small", photograph), Budget(iterations=1), CPU)
    large = new_run(tmp_path / "large", photograph, width=48)
    (large.folder / "checkpoint.pt").write_bytes((tmp_path / "small" / "checkpoint.pt").read_bytes())
    for use in (lambda: train(large, Budget(iterations=2), CPU), lambda: export_run(large.folder, tmp_path / "bundle")):
        with pytest.raises(TrainingError, match="does not fit"):
            use()


def test_a_full_disk_keeps_the_checkpoint_and_says_how_to_go_on(tmp_path, photograph, monkeypatch):
    run = new_run(tmp_path / "run", photograph)
    train(run, Budget(iterations=1), CPU)
    before = (run.folder / "checkpoint.pt").read_bytes()

    def full(number):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(TrainingError, match=r"No space left on device.*--resume"):
        train(run, Budget(iterations=2), CPU)
    assert (run.folder / "checkpoint.pt").read_bytes() == before
    assert not list(run.folder.glob(".*tmp*"))


def test_a_disk_that_is_full_from_the_start_is_said_to_be(tmp_path, photograph, solidgrain, monkeypatch):
    def full(*_):
        raise OSError("270000 requested and 49968 written")  # NumPy's, without a number of the system's

    monkeypatch.setattr(np, "save", full)
    outcome = solidgrain("train", photograph, "--out", tmp_path / "run", "--iterations", 1)
    assert (outcome.code, "cannot write the run directory (270000 requested" in outcome.error) == (1, True)
    assert not (tmp_path / "run").exists()


def test_an_existing_run_is_not_overwritten(solidgrain, whole, photograph):
    before = (whole / "options.json").read_bytes()
    outcome = solidgrain("train", photograph, "--out", whole)
    assert outcome.code == 1
    assert "--resume" in outcome.error
    assert (whole / "options.json").read_bytes() == before


def test_a_gradient_gets_a_warning_that_names_the_figure(solidgrain, tmp_path):
    ramp = np.linspace(0, 1, 96, dtype=np.float32)[:, None, None] * np.ones((96, 96, 3), np.float32)
    oiio.ImageBuf(ramp).write(os.fspath(tmp_path / "ramp.png"), oiio.UINT8)
    outcome = solidgrain(
        "train", tmp_path / "ramp.png", "--out", tmp_path / "run", "--iterations", 1, "--patch", 32, "--batch", 1
    )
    assert "nonstationarity 0.9" in outcome.err


def test_a_frame_gets_a_warning_that_names_the_figure(solidgrain, tmp_path):
    framed = np.pad(0.4 + 0.2 * blotches(92, 92), ((2, 2), (2, 2), (0, 0)))
    oiio.ImageBuf(framed).write(os.fspath(tmp_path / "framed.png"), oiio.UINT8)
    flags = ["--out", tmp_path / "run", "--iterations", 1, "--patch", 32, "--batch", 1]
    outcome = solidgrain("train", tmp_path / "framed.png", *flags)
    said = re.search(r"framed.png seems to have a frame \(edge step (.*), above 3\); crop it off", outcome.err)
    assert float(said[1]) == pytest.approx(edge_step(framed), abs=0.1)


def test_a_mirrored_photograph_gets_a_warning_that_names_the_figure(solidgrain, tmp_path):
    side = blotches(60, 90)
    oiio.ImageBuf(np.concatenate([side, side[::-1]])).write(os.fspath(tmp_path / "tile.jpg"), oiio.UINT8)
    flags = ["--out", tmp_path / "run", "--iterations", 1, "--patch", 32, "--batch", 1]
    said = solidgrain("train", tmp_path / "tile.jpg", *flags).err
    assert re.search(
        r"tile.jpg is its own mirror image \(symmetry about its middle \d\.\d\d, above 0.1\); crop to one side", said
    )


def test_a_training_that_leaves_nothing_fails(tmp_path, photograph, solidgrain, monkeypatch):
    new_run(tmp_path / "run", photograph)
    monkeypatch.setattr(Trainer, "flaw", lambda self: "a weight is not finite")
    outcome = solidgrain("train", "--resume", tmp_path / "run", "--iterations", 1, "--threads", 1)
    assert outcome.code == 1
    assert "iteration 1 is not saved (a weight is not finite)\n" in outcome.err
    assert "nothing is worth keeping" in outcome.err


def test_text_that_no_card_could_hold_is_refused_at_once(tmp_path, solidgrain):
    outcome = solidgrain("train", "a.png", "--out", tmp_path / "run", "--credit", "J\udcfcrgen")
    assert (outcome.code, "--credit: expected printable characters in UTF-8, found 'J\\udcfcrgen'" in outcome.error) == (
        2,
        True,
    )
