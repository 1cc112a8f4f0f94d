"""A texture space trains on the exemplars that it was given and no others, and goes on where it stopped, to the last bit."""

from __future__ import annotations

import json
import os
import resource
import time

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from solidgrain.runtime import TrainingError
from solidgrain.train import collection, critic, preview, settings, space_run
from solidgrain.train.collection import LEVELS
from solidgrain.train.loop import Trainer, train
from solidgrain.train.run import open_run
from solidgrain.train.settings import Budget, preset
from solidgrain.train.space_run import open_space_run
from solidgrain.train.task import TextureSpace
from tests.train.conftest import blotches
from tests.train.spaces import TINY_SPACE, new_space, photographs, picture, write
from tests.train.test_collection import damage
from tests.train.test_training import CPU, endless_training, losses, new_run, tensors

SMALL = ["--patch", 32, "--batch", 2, "--threads", 1, "--quiet"]


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Small pictures, and a critic of three layers: what is tested here does not depend on either."""
    torch.set_num_threads(1)
    monkeypatch.setattr(preview, "SIZE", 32)
    monkeypatch.setattr(critic, "CONVOLUTIONS", ((3, 16, 3, True), (16, 32, 3, True), (32, 256, 3, True)))


@pytest.fixture
def small_presets(monkeypatch):
    """The presets that the command line knows, at the size of a toy."""
    tiny = {name: preset(name, **TINY_SPACE) for name in ("fast space", "paper space")}
    monkeypatch.setattr(settings, "PRESETS", settings.PRESETS | tiny)


def assert_same_checkpoint(first, second):
    a, b = (dict(tensors(open_space_run(folder).load_checkpoint())) for folder in (first, second))
    assert a.keys() == b.keys()
    assert [name for name in a if not torch.equal(a[name], b[name])] == []


def numbers(patches):
    """Of which numbered members patches [B, 3, H, W] are."""
    levels = patches[:, 2].mul(LEVELS).round().int()
    assert (levels == levels[:, :1, :1]).all()  # each is of one member throughout
    return levels[:, 0, 0].tolist()


def test_a_space_stopped_and_resumed_is_the_uninterrupted_one(tmp_path):
    folder = photographs(tmp_path / "stones", 3)
    train(new_space(tmp_path / "whole", folder), Budget(iterations=5), CPU)
    train(new_space(tmp_path / "parts", folder), Budget(iterations=1), CPU)
    train(open_space_run(tmp_path / "parts"), Budget(iterations=3), CPU)
    train(open_space_run(tmp_path / "parts"), Budget(iterations=5), CPU)
    assert losses(tmp_path / "parts") == losses(tmp_path / "whole")
    assert_same_checkpoint(tmp_path / "parts", tmp_path / "whole")


def test_a_killed_space_resumes_to_the_same_numbers(tmp_path, monkeypatch):
    """Signal 9 in the middle, after the first checkpoint; with the whole critic, which the killed process has."""
    monkeypatch.undo()
    monkeypatch.setattr(preview, "SIZE", 32)
    folder = tmp_path / "killed"
    new_space(folder)
    process = endless_training(folder, until="checkpoint.pt")
    time.sleep(0.2)
    process.kill()
    process.communicate()
    further = Budget(iterations=open_space_run(folder).load_checkpoint()["iteration"] + 2)
    train(open_space_run(folder), further, CPU)
    train(new_space(tmp_path / "whole"), further, CPU)
    assert losses(folder) == losses(tmp_path / "whole")
    assert_same_checkpoint(folder, tmp_path / "whole")


def test_held_out_exemplars_are_never_drawn(tmp_path):
    run = new_space(tmp_path / "run", members=6, held_out=["1.png", "4.png"])
    task, generator, drawn = TextureSpace(run, CPU), torch.Generator().manual_seed(0), set()
    for _ in range(40):
        batch = task.draw(0, generator)
        drawn |= {*numbers(batch.real), *numbers(batch.inputs[-1])}
    assert drawn == {0, 2, 3, 5}
    assert set(numbers(task.probe().inputs[-1])) <= drawn
    assert [source.exemplar for source in run.sources] == ["0.png", "2.png", "3.png", "5.png"]


def test_samples_show_exemplars_of_both_kinds(tmp_path):
    run = new_space(tmp_path / "run", members=8, held_out=["1.png", "4.png", "6.png"])
    shown = torch.stack([exemplar for exemplar, _ in TextureSpace(run, CPU).shown()])
    assert numbers(shown) == [0, 3, 1, 4]  # two that it learns from, far apart, and two that it never sees
    train(run, Budget(iterations=1), CPU)
    picture = oiio.ImageBuf(os.fspath(run.folder / "samples" / "000001.png")).spec()
    assert (picture.height, picture.width) == (4 * 32, 3 * 32)


@pytest.mark.parametrize(("count", "distinct"), [(6, 4), (3, 3)])
def test_a_batch_is_of_as_many_exemplars_as_it_can_hold_and_the_encoder_sees_those_that_the_critic_sees(
    tmp_path, count, distinct
):
    task = TextureSpace(new_space(tmp_path / "run", members=count, batch=4), CPU)
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        (_, points, seen), real, *_ = task.draw(0, generator)
        assert len(points) == len(real) == 4
        assert seen.shape == (4, 3, 128, 128)
        assert numbers(real) == numbers(seen)
        assert len(set(numbers(real))) == distinct


def test_the_encoder_and_the_critic_see_different_patches_of_an_exemplar(tmp_path):
    task = TextureSpace(new_space(tmp_path / "run", patch=128), CPU)
    (*_, seen), real, *_ = task.draw(0, torch.Generator().manual_seed(0))
    assert not torch.equal(seen, real)


def test_a_step_teaches_every_part_of_the_space(tmp_path):
    trainer = Trainer(new_space(tmp_path / "run", photographs(tmp_path / "stones", 2)), CPU)
    before = {name: weight.clone() for name, weight in trainer.sampler.state_dict().items()}
    for _ in range(2):
        trainer.step()
    after = trainer.sampler.state_dict()
    given = {f"sampler.{name}" for name in ("octave_scale", "color_mean", "color_axes")}  # not learned
    assert {name for name in before if torch.equal(before[name], after[name])} == given


def test_octaves_and_what_makes_them_move_at_their_own_rate(tmp_path):
    """Adam's first step is as long as its rate, whatever the gradient."""
    trainer = Trainer(new_space(tmp_path / "run", photographs(tmp_path / "stones", 2), octave_rate=0.1), CPU)
    before = {name: weight.detach().clone() for name, weight in trainer.sampler.named_parameters()}
    trainer.step()
    after = trainer.sampler.state_dict()
    moved = {name: float((after[name] - weight).abs().max()) for name, weight in before.items()}
    slow = {name for name in moved if name == "sampler.directions" or name.startswith("mapping.octaves.")}
    assert len(slow) == 5
    for name, distance in moved.items():
        share = 0.1 if name in slow else 1.0
        assert distance == pytest.approx(share * trainer.settings.sampler_rate, rel=0.01), name


def test_what_was_held_out_and_what_tiles_is_recorded(tmp_path):
    folder = photographs(tmp_path / "stones", 3)
    write(folder / "a photograph.png", picture(150, 160, 9, (False, True)))
    run = new_space(tmp_path / "run", folder, held_out=1)
    assert open_space_run(tmp_path / "run").held_out == run.held_out
    options = json.loads((tmp_path / "run" / "options.json").read_text())
    entries = {entry["exemplar"]: entry for entry in options["exemplars"]}
    assert entries["a photograph.png"]["wraps"] == [False, True]
    assert entries["stone0.png"]["wraps"] == [True, True]
    assert [name for name, entry in entries.items() if entry["held_out"]] == list(run.held_out)
    assert len(run.trained_on) == 3
    assert {source.license for source in run.sources} == {"CC0-1.0"}


def test_a_folder_of_photographs_becomes_a_run_from_the_command_line(solidgrain, tmp_path, small_presets):
    (tmp_path / "unseen.txt").write_text("stone1.png\n\n")
    flags = ["--space", photographs(tmp_path / "stones", 4), "--out", tmp_path / "run", *SMALL]
    damage(tmp_path / "stones", "cut short")
    refused = solidgrain("train", *flags, "--hold-out", tmp_path / "unseen.txt", "--skip-unreadable")
    assert "there is no readable photograph stone1.png" in refused.err.splitlines()[-1]
    assert not (tmp_path / "run").exists()
    (tmp_path / "unseen.txt").write_text("stone2.png\n\n")
    outcome = solidgrain(
        "train", *flags, "--hold-out", tmp_path / "unseen.txt", "--skip-unreadable", "--iterations", 1, "--license", "CC0-1.0"
    )
    assert outcome.code == 0, outcome.err
    left_out, uneven = [line for line in outcome.err.splitlines() if "warning" in line]
    assert "stone1.png" in left_out
    assert uneven.startswith("warning: 1 of 2 photographs change across themselves")
    run = open_space_run(tmp_path / "run")
    assert [member.name for member in run.members] == ["stone0.png", "stone2.png", "stone3.png"]
    assert run.held_out == {"stone2.png"}
    assert run.budget == Budget(iterations=1)
    assert run.settings.preset == "fast"
    assert solidgrain("train", "--resume", tmp_path / "run", "--iterations", 2, "--threads", 1).code == 0
    assert run.load_checkpoint()["iteration"] == 2


def test_photographs_that_change_across_themselves_are_named(solidgrain, tmp_path, small_presets):
    folder = photographs(tmp_path / "stones", 2)
    write(folder / "evening sky.png", np.linspace(0, 1, 150)[:, None, None] * np.ones((150, 140, 3)))
    outcome = solidgrain("train", "--space", folder, "--out", tmp_path / "run", *SMALL, "--iterations", 1)
    assert outcome.code == 0, outcome.err
    (warning,) = [line for line in outcome.err.splitlines() if "of 3 photographs change across themselves" in line]
    assert "(nonstationarity above 0.3): evening sky.png (0.9" in warning


def test_photographs_with_a_frame_are_named(solidgrain, tmp_path, small_presets):
    folder = photographs(tmp_path / "stones", 2)
    write(folder / "framed.png", np.pad(0.4 + 0.2 * blotches(150, 140), ((1, 1), (1, 1), (0, 0))))
    outcome = solidgrain("train", "--space", folder, "--out", tmp_path / "run", *SMALL, "--iterations", 1)
    assert outcome.code == 0, outcome.err
    (warning,) = [line for line in outcome.err.splitlines() if "of 3 photographs seem to have a frame" in line]
    assert "(edge step above 3): framed.png (" in warning


def test_held_out_photographs_that_the_warm_start_has_seen_are_named(solidgrain, tmp_path, small_presets):
    flags = ["--space", photographs(tmp_path / "stones", 3), *SMALL, "--iterations", 1]
    (tmp_path / "unseen.txt").write_text("stone1.png\n")
    assert solidgrain("train", *flags, "--out", tmp_path / "first").code == 0
    flags += ["--warm-start", tmp_path / "first", "--hold-out", tmp_path / "unseen.txt"]
    outcome = solidgrain("train", *flags, "--out", tmp_path / "second")
    assert f"1 held-out photographs were trained on by {tmp_path / 'first'}: stone1.png; hold out others" in outcome.err
    begin = ("--warm-start", tmp_path / "first" / "checkpoint.pt", "--iterations", 1, "--threads", 1)
    outcome = solidgrain("train", "--space", tmp_path / "stones", "--hold-out", 1, "--out", tmp_path / "fourth", *begin)
    assert "what it was trained on is not known; held-out photographs may be among it" in outcome.err
    assert open_space_run(tmp_path / "second").settings.warm_start == "first"
    flags[-3] = tmp_path / "second"  # which began with another one itself
    outcome = solidgrain("train", *flags, "--out", tmp_path / "fifth")
    assert f"{tmp_path / 'second'}: what it began with was trained on is not known" in outcome.err
    assert "held-out photographs" not in solidgrain("train", *flags[:-4], "--out", tmp_path / "third").err


def test_a_held_out_photograph_that_a_single_exemplar_s_run_was_of_is_named(solidgrain, tmp_path, small_presets):
    folder = photographs(tmp_path / "stones", 3)
    (tmp_path / "unseen.txt").write_text("stone1.png\n")
    train(new_run(tmp_path / "single", folder / "stone1.png", width=TINY_SPACE["width"]), Budget(iterations=1), CPU)
    flags = [*SMALL, "--hold-out", tmp_path / "unseen.txt", "--warm-start", tmp_path / "single"]
    outcome = solidgrain("train", "--space", folder, "--out", tmp_path / "run", *flags, "--iterations", 1)
    assert f"1 held-out photographs were trained on by {tmp_path / 'single'}: stone1.png" in outcome.err


def test_a_misspelt_held_out_name_is_refused_before_photographs_are_read(solidgrain, tmp_path, monkeypatch):
    monkeypatch.setattr(collection, "read_photograph", lambda *_: pytest.fail("was read"))
    (tmp_path / "unseen.txt").write_text("ston1.png\n")
    flags = ["--out", tmp_path / "run", "--hold-out", tmp_path / "unseen.txt"]
    outcome = solidgrain("train", "--space", photographs(tmp_path / "stones", 3), *flags)
    assert outcome.code == 1
    assert "there is no readable photograph ston1.png" in outcome.error
    assert not (tmp_path / "run").exists()


def test_no_plateau_is_told_of_a_space(tmp_path):
    run = new_space(tmp_path / "run", sample_every=1000)
    with pytest.raises(TrainingError, match="a plateau is told of a single exemplar"):
        train(run, Budget(iterations=30, until_plateau=True), CPU)


def test_a_space_has_budgets_and_settings_of_its_own(solidgrain, tmp_path, monkeypatch):
    """Many more iterations, 32 octaves, slower rates; the paper's octaves spread as 2^(i/2)."""
    from solidgrain.train import loop

    monkeypatch.setattr(loop, "train", lambda *_: loop.Ending(0, saved=False, stopped=False))
    folder = photographs(tmp_path / "stones", 2)
    for name, iterations, span in (("fast", 30_000, 7.0), ("paper", 300_000, 15.5)):
        solidgrain("train", "--space", folder, "--out", tmp_path / name, "--preset", name, "--anisotropic", "x", "--upright")
        run = open_space_run(tmp_path / name)
        assert run.settings.upright
        assert run.budget == Budget(iterations=iterations)
        assert (run.settings.octaves, run.settings.octave_span, run.settings.grain) == (32, span, "x")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["photo.png"], "leave photo.png out"),
        (["--anisotropic"], "--anisotropic: say x or y"),
        (["--hold-out", "none.txt"], "--hold-out none.txt: expected a number, or a file with a name per line"),
        (["--patch", "16"], "--patch 16: expected at least 32"),
    ],
)
def test_flags_that_contradict_a_space_are_refused_in_one_line(solidgrain, tmp_path, flags, message):
    outcome = solidgrain("train", *flags, "--space", photographs(tmp_path / "stones", 2), "--out", tmp_path / "run")
    assert outcome.code == 2
    assert message in outcome.error
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("flags", [["--hold-out", "3"], ["--skip-unreadable"]])
def test_flags_that_need_a_space_are_refused_without_one(solidgrain, tmp_path, photograph, flags):
    outcome = solidgrain("train", photograph, "--out", tmp_path / "run", *flags)
    assert outcome.code == 2
    assert f"{flags[0]}: is about the photographs of a --space" in outcome.error
    assert list(tmp_path.iterdir()) == []


def test_a_resumed_space_refuses_what_it_has_settled(solidgrain, tmp_path):
    new_space(tmp_path / "run")
    for flags in (["--space", tmp_path], ["--hold-out", "1"], ["--skip-unreadable"], ["--warm-start", tmp_path]):
        outcome = solidgrain("train", "--resume", tmp_path / "run", *flags)
        assert outcome.code == 2
        assert f"has settled {flags[0]} already" in outcome.error


def inside(folder):
    """Every file below a folder, with its bytes."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("flags", "kind", "message"),
    [
        ([], "no image", "stone1.png"),
        (["--hold-out", "none.png.txt"], None, "there is no readable photograph none.png"),
        (["--hold-out", "3"], None, "expected at least 2 to train on"),
    ],
)
def test_a_space_that_cannot_be_trained_leaves_nothing_behind(solidgrain, tmp_path, monkeypatch, flags, kind, message):
    """Whether the run directory, and the one above it, were there before or not."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "none.png.txt").write_text("none.png")
    folder = photographs(tmp_path / "stones", 4)
    if kind:
        damage(folder, kind)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "log.txt").write_text("a log of my own")
    before = inside(tmp_path)
    for out in ("new/run", "mine", "stones"):
        outcome = solidgrain("train", "--space", folder, "--out", tmp_path / out, *SMALL, *flags)
        assert outcome.code == 1
        assert message in outcome.error
    assert inside(tmp_path) == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "none.png.txt", "stones"]
    assert not (tmp_path / "stones" / "samples").exists()


@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_an_interrupted_beginning_leaves_nothing_behind(tmp_path, monkeypatch, failure):
    saved = []

    def save(*arguments):
        saved.append(arguments)
        if len(saved) == 3:
            raise failure

    monkeypatch.setattr(space_run.np, "save", save)
    with pytest.raises((KeyboardInterrupt, TrainingError)):
        new_space(tmp_path / "run")
    assert len(saved) == 3
    assert not (tmp_path / "run").exists()


def test_exemplars_that_are_there_already_are_not_overwritten(tmp_path):
    mine = tmp_path / "run" / "exemplars" / "0000.npy"
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    with pytest.raises(TrainingError, match="exemplars: is there already, without a run; remove it or choose another --out"):
        new_space(tmp_path / "run")
    assert inside(tmp_path / "run") == {mine.relative_to(tmp_path / "run"): b"mine"}


def test_as_many_exemplars_can_be_open_as_the_system_allows():
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (64, before[1]))
        space_run.allow_open_files(80)
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] >= min(80, before[1])
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[1] == before[1]
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_a_run_that_is_there_already_is_not_to_be_removed(tmp_path):
    new_space(tmp_path / "run")
    with pytest.raises(TrainingError, match="already holds a run; continue it with --resume"):
        new_space(tmp_path / "run")


def swap(path):
    pixels = np.load(path)
    np.save(path, pixels[::-1])


def zip_up(path):
    with path.open("wb") as file:
        np.savez(file, np.zeros(3))


def break_header(path):
    """So that NumPy raises what its tokenizer does."""
    path.write_bytes(path.read_bytes().replace(b"}", b" ", 1))


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (lambda path: path.unlink(), "missing or damaged"),
        (lambda path: path.write_bytes(b""), "missing or damaged"),
        (lambda path: path.write_bytes(path.read_bytes()[:-1000]), "missing or damaged"),
        (lambda path: path.write_bytes(b"hello" * 1000), "missing or damaged"),
        (swap, "not the pixels that the run was started with"),
        (lambda path: np.save(path, np.zeros((130, 130, 3))), "not the pixels that the run was started with"),
        (zip_up, "missing or damaged"),
        (break_header, "missing or damaged"),
    ],
)
def test_an_exemplar_that_was_tampered_with_is_named_in_one_line(solidgrain, tmp_path, harm, message):
    new_space(tmp_path / "run")
    harm(tmp_path / "run" / "exemplars" / "0003.npy")
    outcome = solidgrain("train", "--resume", tmp_path / "run")
    assert outcome.code == 1
    assert f"exemplars/0003.npy: {message}" in outcome.error


def test_runs_of_either_kind_are_told_apart(tmp_path, photograph):
    new_space(tmp_path / "space")
    new_run(tmp_path / "single", photograph)
    with pytest.raises(TrainingError, match="the run of a texture space; expected one of a single exemplar"):
        open_run(tmp_path / "space")
    with pytest.raises(TrainingError, match="the run of a single exemplar; expected one of a texture space"):
        open_space_run(tmp_path / "single")


def test_a_space_of_black_photographs_is_trained(tmp_path, small_presets, solidgrain):
    """Colours that do not deviate have no axes of their own."""
    (tmp_path / "stones").mkdir()
    for name in ("black", "night"):
        write(tmp_path / "stones" / f"{name}.png", np.zeros((130, 130, 3)))
    outcome = solidgrain("train", "--space", tmp_path / "stones", "--out", tmp_path / "run", *SMALL, "--iterations", 1)
    assert outcome.code == 0, outcome.err
    assert open_space_run(tmp_path / "run").load_checkpoint()["iteration"] == 1
