"""A training that diverges says so, goes back to its last good checkpoint, and never overwrites it with a bad state."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from solidgrain.runtime import TrainingError
from solidgrain.train import critic, loop, settings, watch
from solidgrain.train.loop import Trainer, train
from solidgrain.train.noise import draw_noise
from solidgrain.train.run import open_run
from solidgrain.train.sampler import Sampler
from solidgrain.train.settings import PRESETS, Budget, preset
from solidgrain.train.space import Space
from solidgrain.train.watch import LIMIT, MEMORY, PATIENCE, Watch, flaw
from tests.train.test_training import CPU, assert_same_checkpoint, losses, new_run

CHEAP = {"batch": 1, "resolution": 16}


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def little_work(monkeypatch):
    """No pictures, and a critic of three layers: what is tested here does not depend on either."""
    monkeypatch.setattr(loop, "_write_sample", lambda trainer: None)
    monkeypatch.setattr(critic, "CONVOLUTIONS", ((3, 16, 3, True), (16, 32, 3, True), (32, 256, 3, True)))
    monkeypatch.setattr(settings, "PRESETS", settings.PRESETS | {"fast": preset("fast", critic_start="", sampler_start="")})
    monkeypatch.setattr(loop, "SETTLING", 0)


@pytest.fixture
def hasty(monkeypatch):
    """Explosions count after five iterations, so that tests need few."""
    monkeypatch.setattr(watch, "PATIENCE", 5)


def poison(monkeypatch, iteration, harm, times):
    """Do harm to a trainer after an iteration, the first so many times that it gets there."""
    step, left = Trainer.step, [times]

    def harmed(trainer):
        report = step(trainer)
        if trainer.iteration == iteration and left[0]:
            left[0] -= 1
            return harm(trainer, report) or report
        return report

    monkeypatch.setattr(Trainer, "step", harmed)


@torch.no_grad()
def nan_in_a_weight(trainer, report):
    trainer.sampler.output.weight[0, 0] = math.nan


@torch.no_grad()
def nan_in_the_average(trainer, report):
    trainer.average.output.bias[0] = math.nan


def nan_in_a_loss(trainer, report):
    return dataclasses.replace(report, style=math.nan)


@torch.no_grad()
def explosion(trainer, report):
    for convolution in trainer.critic.convolutions:
        convolution.weight *= 30


@torch.no_grad()
def collapse(trainer, report):
    trainer.average.output.weight.zero_()


def trained(folder, photograph, iterations):
    """A run, and the warnings that it gave."""
    warnings = []
    train(new_run(folder, photograph, **CHEAP), Budget(iterations=iterations), CPU, on_warning=warnings.append)
    return warnings


@pytest.mark.parametrize(
    ("harm", "iteration", "message"),
    [
        (nan_in_a_weight, 5, "iteration 6: the training diverged (a loss is not finite); it goes on from iteration 4"),
        (nan_in_the_average, 8, "iteration 8: the training diverged (a weight is not finite); it goes on from iteration 4"),
        (nan_in_a_weight, 2, "iteration 3: the training diverged (a loss is not finite); it goes on from iteration 0"),
        (collapse, 8, "iteration 8: the training diverged (the average has collapsed"),
    ],
)
def test_a_run_that_goes_wrong_once_goes_back_and_on(tmp_path, photograph, monkeypatch, harm, iteration, message):
    poison(monkeypatch, iteration, harm, times=1)
    (warning,) = trained(tmp_path / "run", photograph, 10)
    assert warning.startswith(message)
    assert [line["iteration"] for line in losses(tmp_path / "run")] == list(range(1, 11))
    state = open_run(tmp_path / "run").load_checkpoint()
    assert (state["iteration"], state["setbacks"]) == (10, 1)
    assert all(torch.isfinite(weight).all() for weight in state["average"].values())


def test_after_a_setback_rates_are_halved_and_other_patches_are_drawn(tmp_path, photograph, monkeypatch):
    trained(tmp_path / "sound", photograph, 6)
    poison(monkeypatch, 5, nan_in_a_weight, times=1)
    trained(tmp_path / "harmed", photograph, 6)
    sound, harmed = (open_run(tmp_path / name).load_checkpoint() for name in ("sound", "harmed"))
    rates = [state["sampler_optimiser"]["param_groups"][0]["lr"] for state in (sound, harmed)]
    assert rates[1] == rates[0] / 2
    assert losses(tmp_path / "sound")[:4] == losses(tmp_path / "harmed")[:4]
    assert losses(tmp_path / "sound")[4] != losses(tmp_path / "harmed")[4]


def test_a_run_that_keeps_diverging_stops_and_names_the_iteration_and_the_checkpoint(tmp_path, photograph, monkeypatch):
    folder = tmp_path / "run"
    trained(folder, photograph, 4)
    before = (folder / "checkpoint.pt").read_bytes()
    poison(monkeypatch, 6, nan_in_a_loss, times=99)
    warnings = []
    with pytest.raises(TrainingError, match=r"diverged at iteration 6 .*checkpoint\.pt holds iteration 4: export it"):
        train(open_run(folder), Budget(iterations=10), CPU, on_warning=warnings.append)
    assert len(warnings) == loop.MOST_SETBACKS
    assert (folder / "checkpoint.pt").read_bytes() == before


def test_a_run_that_diverges_before_its_first_checkpoint_says_that_there_is_none(tmp_path, photograph, monkeypatch):
    poison(monkeypatch, 2, nan_in_a_loss, times=99)
    with pytest.raises(TrainingError, match=r"diverged at iteration 2 .*no checkpoint yet: train again"):
        trained(tmp_path / "run", photograph, 10)
    assert not (tmp_path / "run" / "checkpoint.pt").exists()


def test_an_exploding_critic_is_noticed_and_its_checkpoints_are_not_kept(tmp_path, photograph, monkeypatch, hasty):
    """The losses stay finite: only their size tells. Checkpoints fall due at 16 and 20, while it explodes."""
    poison(monkeypatch, 14, explosion, times=1)
    (warning,) = trained(tmp_path / "run", photograph, 24)
    assert "times its lowest mean" in warning
    assert "it goes on from iteration 12" in warning
    state = open_run(tmp_path / "run").load_checkpoint()
    assert (state["iteration"], state["setbacks"]) == (24, 1)
    assert losses(tmp_path / "run")[-1]["style"] < 5


def test_a_run_that_ends_in_doubt_keeps_its_last_good_checkpoint(tmp_path, photograph, monkeypatch):
    poison(monkeypatch, 14, explosion, times=1)
    (warning,) = trained(tmp_path / "run", photograph, 18)
    assert warning.startswith("iteration 18 is not saved (")
    assert open_run(tmp_path / "run").load_checkpoint()["iteration"] == 12


def test_a_run_killed_or_stopped_after_a_setback_resumes_to_the_same_numbers(tmp_path, photograph, monkeypatch):
    """It goes back from iteration 6 to 4; killed at 5 after that it makes the whole detour again, stopped at 7 it need not."""

    def sitting(name, iterations, killed_at=None):
        with monkeypatch.context() as patched:
            poison(patched, 6, nan_in_a_loss, times=1)
            went = []

            def show(report):
                went.append(report.iteration)
                if killed_at and went.count(killed_at) == 2:
                    raise KeyboardInterrupt

            train(open_run(tmp_path / name), Budget(iterations=iterations), CPU, show)

    for name in ("whole", "killed", "stopped"):
        new_run(tmp_path / name, photograph, **CHEAP)
    sitting("whole", 8)
    with pytest.raises(KeyboardInterrupt):
        sitting("killed", 8, killed_at=5)
    sitting("killed", 8)
    sitting("stopped", 7)
    sitting("stopped", 8)
    for name in ("killed", "stopped"):
        assert losses(tmp_path / name) == losses(tmp_path / "whole")
        assert_same_checkpoint(tmp_path / name, tmp_path / "whole")


def test_a_checkpoint_of_a_version_without_a_watch_is_taken_up(tmp_path, photograph):
    run = new_run(tmp_path / "run", photograph, **CHEAP)
    train(run, Budget(iterations=4), CPU)
    state = run.load_checkpoint()
    del state["watch"], state["setbacks"]
    run.save_checkpoint(state)
    assert train(run, Budget(iterations=5), CPU).iteration == 5


def test_the_command_prints_a_setback_as_one_line_and_goes_on(solidgrain, tmp_path, photograph, monkeypatch):
    poison(monkeypatch, 2, nan_in_a_weight, times=1)
    flags = ["--iterations", 4, "--patch", 32, "--batch", 1, "--threads", 1, "--quiet"]
    outcome = solidgrain("train", photograph, "--out", tmp_path / "run", *flags)
    assert outcome.code == 0
    (line,) = [line for line in outcome.err.splitlines() if "warning" in line]
    assert "iteration 3: the training diverged" in line


def verdicts(styles, critics=None, settles=0):
    observed = Watch(settles=settles)
    return [observed.see(style, critic) for style, critic in zip(styles, critics or [1.0] * len(styles), strict=True)]


def test_noisy_losses_and_single_spikes_are_no_divergence():
    draw = torch.Generator().manual_seed(0)
    styles = (0.05 * torch.exp(torch.randn(2000, generator=draw))).tolist()
    styles[700] = 50.0
    critics = torch.randn(2000, generator=draw).mul(3).tolist()
    critics[900] = 5000.0
    assert set(verdicts(styles, critics)) == {""}


def test_a_critic_from_noise_may_scale_its_features_up_at_first_and_no_longer():
    """What the paper's preset does in its first twenty iterations: L_style from 0.5 to 280, L_D from 1 to -230."""
    grown = [0.5 * 1.37**k for k in range(20)] + [280.0] * 400
    critics = [-(1.31**k) for k in range(20)] + [-230.0] * 400
    assert verdicts(grown, critics)[-1] != ""
    assert set(verdicts(grown, critics, settles=30)) == {""}
    assert verdicts([*grown, *[280.0 * 2 * LIMIT] * 200], [*critics, *[-230.0] * 200], settles=30)[-1].startswith("L_style")
    assert verdicts([0.5, math.nan], settles=30)[-1] == "a loss is not finite"


@pytest.mark.parametrize("of", ["L_style", "L_D"])
def test_a_loss_beyond_its_limit_for_long_enough_is_a_divergence(of):
    losses_of = {"L_style": [0.1] * 300, "L_D": [1.0] * 300}
    losses_of[of] += [10 * LIMIT] * (PATIENCE + MEMORY)
    losses_of["L_D" if of == "L_style" else "L_style"] += [0.1] * (PATIENCE + MEMORY)
    found = verdicts(losses_of["L_style"], losses_of["L_D"])
    assert not any(found[: 300 + PATIENCE - 1])
    assert found[-1].startswith(of)
    assert int(found[-1].split(" times its lowest mean")[0].split()[-1]) >= LIMIT


def test_what_is_said_of_a_loss_is_what_was_beyond_its_limit():
    said = next(filter(None, verdicts([0.1] * 100 + [10 * LIMIT] * (PATIENCE - 1) + [0.5])))
    assert int(said.split("L_style is ")[1].split(" times")[0]) > LIMIT


def test_a_loss_that_comes_back_in_time_is_no_divergence():
    styles = ([0.1] * 100 + [50.0] * (PATIENCE - MEMORY)) * 3 + [0.1] * 100
    assert set(verdicts(styles)) == {""}


def test_a_slow_explosion_is_noticed_too():
    styles = [0.13 * math.exp(max(0, k - 200) / 66) for k in range(800)]  # to 1000 times, over 600 iterations
    said = next(filter(None, verdicts(styles)))
    assert int(said.split("L_style is ")[1].split(" times")[0]) > LIMIT


@torch.no_grad()
@pytest.mark.parametrize("name", PRESETS)
def test_fresh_networks_have_no_flaw_whatever_the_preset(name):
    draw = torch.Generator().manual_seed(0)
    settings = preset(name)
    noise, points = draw_noise(settings.octaves, 64, draw), 64 * torch.rand(2, 500, 3, generator=draw)
    exemplars = [torch.rand(3, 128, 128, generator=draw) for _ in range(2)]
    model = Space(settings, draw) if settings.latent else Sampler(settings, draw)
    colors = model(noise, points, torch.stack(exemplars)) if settings.latent else model(noise, points)
    assert flaw([model], colors, exemplars) == ""


def test_a_flaw_of_one_texture_in_many_is_not_one_of_the_space():
    exemplars = [torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(k)) for k in range(4)]
    colors = torch.stack([exemplar.flatten(1).T for exemplar in exemplars])
    colors[0] = 0.5
    assert flaw([], colors, exemplars) == ""
    colors[:] = 0.5
    assert flaw([], colors, exemplars).startswith("the average has collapsed")
