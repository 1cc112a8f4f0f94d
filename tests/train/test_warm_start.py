"""A training may begin with what another has learned: all of its weights that fit, and nothing else of it."""

from __future__ import annotations

import shutil

import pytest
import torch

from solidgrain.runtime import BundleError, TrainingError
from solidgrain.runtime.bundle import embedded_folder, open_bundle
from solidgrain.train import companion, critic, loop, settings
from solidgrain.train.companion import find_companion, read_companion
from solidgrain.train.loop import Trainer, train
from solidgrain.train.run import open_run
from solidgrain.train.settings import Budget, preset
from solidgrain.train.space_run import open_space_run
from solidgrain.train.warm_start import learned, warm_start
from tests.train.spaces import TINY_SPACE, new_space, photographs
from tests.train.test_training import CPU, new_run

SAME_WIDTH = {name: TINY_SPACE[name] for name in ("width", "resolution", "batch")}
FLAGS = ["--iterations", 1, "--threads", 1, "--quiet"]


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """No pictures, a critic of three layers, presets of toys: what is tested here does not depend on them."""
    torch.set_num_threads(1)
    monkeypatch.setattr(loop, "_write_sample", lambda trainer: None)
    monkeypatch.setattr(critic, "CONVOLUTIONS", ((3, 16, 3, True), (16, 32, 3, True), (32, 256, 3, True)))
    tiny = {
        "fast": preset("fast", patch=32, critic_start="", sampler_start="", **SAME_WIDTH),
        "fast space": preset("fast space", **TINY_SPACE),
    }
    monkeypatch.setattr(settings, "PRESETS", settings.PRESETS | tiny)


@pytest.fixture
def single(tmp_path, photograph):
    """A run of a single exemplar with twice the octaves of a tiny space."""
    run = new_run(tmp_path / "single", photograph, octaves=8, **SAME_WIDTH)
    train(run, Budget(iterations=2), CPU)
    return run


@pytest.fixture
def space(tmp_path):
    run = new_space(tmp_path / "space", members=3)
    train(run, Budget(iterations=2), CPU)
    return run


def taken_over(run, other):
    """Names of the new run's tensors that are the other's, and of those that are not."""
    state, found = run.load_checkpoint(), other.load_checkpoint()
    assert all(torch.equal(state["critic"][name], found["critic"][name]) for name in found["critic"])
    assert [name for name, value in state["average"].items() if not torch.equal(value, state["sampler"][name])] == []
    theirs = {name.removeprefix("sampler."): value for name, value in found["average"].items()}
    same = {
        name
        for name, value in state["average"].items()
        if torch.equal(value, theirs.get(name.removeprefix("sampler."), torch.tensor([])))
    }
    return same, set(state["average"]) - same


def test_a_space_begins_with_a_single_exemplar_s_critic_and_the_layers_of_its_sampler(tmp_path, single):
    run = new_space(tmp_path / "run")
    fresh = Trainer(run, CPU).sampler.state_dict()
    taken, left = warm_start(run, learned(single.folder), CPU)
    same, different = taken_over(run, single)
    layers = {f"sampler.hidden.{layer}.{part}" for layer in range(5) for part in ("weight", "bias")}
    assert same == layers | {"sampler.constant", "sampler.output.weight", "sampler.output.bias"}
    state = run.load_checkpoint()
    assert all(torch.equal(state["average"][name], fresh[name]) for name in different)
    assert taken == len(same) + len(state["critic"])
    assert left == len(different)


def test_a_space_begins_with_all_of_another_space(tmp_path, space):
    run = new_space(tmp_path / "run", members=2)
    _, left = warm_start(run, learned(space.folder), CPU)
    assert taken_over(run, space)[1] == set()
    assert left == 0


def test_a_single_exemplar_begins_with_a_space_s_sampler_as_far_as_it_fits(tmp_path, space, photograph):
    run = new_run(tmp_path / "run", photograph, octaves=8, **SAME_WIDTH)
    warm_start(run, learned(space.folder), CPU)
    assert taken_over(run, space)[1] == {"directions", "noise_weights", "octave_scale", "color_mean", "color_axes"}


def test_a_single_exemplar_begins_with_all_of_another_and_its_octaves_as_they_became(tmp_path, single, photograph):
    """Scale and direction of an octave go together: another spread in the settings must not tear them apart."""
    run = new_run(tmp_path / "run", photograph, octaves=8, octave_span=3.0, **SAME_WIDTH)
    warm_start(run, learned(single.folder), CPU)
    assert taken_over(run, single)[1] == set()


def test_a_checkpoint_file_of_weights_alone_in_half_precision_will_do(tmp_path, space):
    state = space.load_checkpoint()
    weights = {part: {name: value.half() for name, value in state[part].items()} for part in ("critic", "average")}
    torch.save(weights, tmp_path / "weights.pt")
    run = new_space(tmp_path / "run", members=3)
    warm_start(run, learned(tmp_path / "weights.pt"), CPU)
    begun = run.load_checkpoint()
    for part in ("critic", "average"):
        assert all(torch.equal(value, weights[part][name].float()) for name, value in begun[part].items())


def test_a_warm_start_is_a_start_all_the_same(tmp_path, single):
    """Iteration 0, no moments, no memory of losses; and the first step goes on from what was taken."""
    run = new_space(tmp_path / "run")
    warm_start(run, learned(single.folder), CPU)
    state = run.load_checkpoint()
    assert (state["iteration"], state["seconds"], state["setbacks"]) == (0, 0.0, 0)
    assert state["sampler_optimiser"]["state"] == {}
    assert state["watch"]["seen"] == 0
    assert train(run, Budget(iterations=1), CPU).iteration == 1
    after = run.load_checkpoint()["critic"]["logit.weight"]
    assert 0 < (after - state["critic"]["logit.weight"]).abs().max() < 3 * run.settings.critic_rate


def test_a_run_of_another_width_is_refused(tmp_path, single):
    with pytest.raises(TrainingError, match="no layer of its sampler fits; expected a run of the same width"):
        warm_start(new_space(tmp_path / "run", width=32), learned(single.folder), CPU)


def test_the_command_line_says_how_much_it_took_over(solidgrain, tmp_path, single, space, photograph):
    stones = photographs(tmp_path / "stones", 2)
    for name, source, what in (("a", single, ["--space", stones]), ("c", single, [photograph]), ("d", space, [photograph])):
        outcome = solidgrain("train", *what, "--out", tmp_path / name, "--warm-start", source.folder, *FLAGS)
        assert outcome.code == 0, outcome.err
        assert f"{source.folder}: took over " in outcome.err
    tensors = len(space.load_checkpoint()["average"]) + len(space.load_checkpoint()["critic"])
    outcome = solidgrain("train", "--space", stones, "--out", tmp_path / "e", "--warm-start", space.folder, *FLAGS)
    assert f"took over {tensors} of {tensors} parameter tensors" in outcome.err
    assert open_space_run(tmp_path / "e").load_checkpoint()["iteration"] == 1
    assert open_run(tmp_path / "c").load_checkpoint()["iteration"] == 1


@pytest.mark.parametrize(
    "what", ["no run", "no checkpoint", "a damaged checkpoint", "no checkpoint at all", "another width", "itself"]
)
def test_a_failed_warm_start_is_one_line_and_leaves_no_run_behind(solidgrain, tmp_path, single, what):
    other, message = single.folder, "no layer of its sampler fits"
    if what == "no run":
        other, message = tmp_path / "nothing", f"{tmp_path / 'nothing'}: not a run directory"
    elif what == "no checkpoint":
        (other / "checkpoint.pt").unlink()
        message = f"--warm-start {other}: no checkpoint yet"
    elif what == "a damaged checkpoint":
        (other / "checkpoint.pt").write_bytes(b"hello")
        message = "damaged checkpoint"
    elif what == "no checkpoint at all":
        other = single.folder / "exemplar.npy"
        message = f"--warm-start {other}: no checkpoint, or a damaged one; expected a run, or its checkpoint.pt"
    else:
        settings.PRESETS["fast space"] = preset("fast space", width=32)
    out = other if what == "itself" else tmp_path / "run"
    before = {path: path.stat().st_mtime_ns for path in single.folder.rglob("*")}
    outcome = solidgrain("train", "--space", photographs(tmp_path / "stones", 2), "--out", out, "--warm-start", other, *FLAGS)
    assert outcome.code == 1
    assert ("already holds a run" if what == "itself" else message) in outcome.error
    assert not (tmp_path / "run").exists()
    assert {path: path.stat().st_mtime_ns for path in single.folder.rglob("*")} == before


def test_a_fast_training_begins_with_the_critic_of_the_embedded_space(monkeypatch, tmp_path, photograph):
    monkeypatch.undo()  # D at its full size
    learned = read_companion(find_companion(open_bundle(embedded_folder("stone")), None), open_bundle(embedded_folder("stone")))
    warm = Trainer(new_run(tmp_path / "warm", photograph, critic_start="stone"), CPU).critic
    fresh = Trainer(new_run(tmp_path / "fresh", photograph), CPU).critic
    for name, value in learned.critic.state_dict().items():
        torch.testing.assert_close(warm.state_dict()[name], value, rtol=0, atol=0)
    assert all(parameter.requires_grad for parameter in warm.parameters())
    assert not torch.equal(fresh.dense.weight, warm.dense.weight)
    assert [preset(name).critic_start for name in ("fast", "fast space", "paper", "paper space")] == ["stone", "stone", "", ""]


def test_a_critic_that_is_not_there_is_one_line(monkeypatch, tmp_path, photograph):
    with pytest.raises(BundleError, match="no such texture"):
        Trainer(new_run(tmp_path / "run", photograph, critic_start="stones"), CPU)


def test_an_installation_without_the_critic_says_what_to_do(monkeypatch, tmp_path, photograph):
    stone = shutil.copytree(embedded_folder("stone"), tmp_path / "stone")
    (stone / "critic.npz").unlink()
    monkeypatch.setattr(companion, "embedded_folder", lambda name: stone)
    with pytest.raises(BundleError, match=r"critic.npz: missing; .* install solidgrain again"):
        Trainer(new_run(tmp_path / "run", photograph, critic_start="stone"), CPU)


@pytest.mark.parametrize("wanted", ["paper", "noise-at-input"])
@pytest.mark.parametrize("given", ["paper", "noise-at-input"])
def test_kinds_of_runs_and_of_samplers_may_differ(tmp_path, photograph, given, wanted):
    """Whatever enters the noise at the input shares its hidden layers but the first, and its output, with the method."""
    single = new_run(tmp_path / "single", photograph, octaves=8, noise_at_input=given == "noise-at-input", **SAME_WIDTH)
    train(single, Budget(iterations=1), CPU)
    space = new_space(tmp_path / "space", noise_at_input=wanted == "noise-at-input")
    warm_start(space, learned(single.folder), CPU)
    layer = single.load_checkpoint()["average"]["hidden.1.weight"]
    torch.testing.assert_close(space.load_checkpoint()["average"]["sampler.hidden.1.weight"], layer)


def test_a_run_that_was_killed_before_it_had_the_weights_is_not_resumed_without_them(single, space, tmp_path, solidgrain):
    out = tmp_path / "new"
    stones = photographs(tmp_path / "stones", 2)
    assert solidgrain("train", "--space", stones, "--out", out, "--warm-start", single.folder, *FLAGS).code == 0
    (out / "checkpoint.pt").unlink()
    outcome = solidgrain("train", "--resume", out, "--threads", 1)
    assert outcome.code == 1
    assert f"{out}: was stopped before it had the weights of single" in outcome.error
