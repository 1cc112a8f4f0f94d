"""Each comparison of the paper is what its sentence says, trains, and is told apart from the method."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

pytest.importorskip("stlpips_pytorch", reason="two variants compare features of VGG-16: pip install 'solidgrain[evaluate]'")

from solidgrain.runtime import SolidgrainError, TrainingError
from solidgrain.train import preview
from solidgrain.train import vgg as vgg_module
from solidgrain.train.critic import Critic
from solidgrain.train.cuts import as_image
from solidgrain.train.loop import Trainer, train
from solidgrain.train.losses import make_judge, style_loss
from solidgrain.train.noise import draw_noise
from solidgrain.train.photograph import read_exemplar
from solidgrain.train.run import Source, create_run, open_run
from solidgrain.train.sampler import NoiseAtInputSampler, Sampler, make_sampler
from solidgrain.train.settings import FAST, PAPER, Budget, Settings, from_json, preset, to_json
from solidgrain.train.slices import Planes, draw_rotations, draw_slices
from solidgrain.train.space_run import open_space_run
from solidgrain.train.variants import CHANGES, canonical, vary
from solidgrain.train.vgg import Vgg
from tests.bench import cells
from tests.train.spaces import photographs, picture
from tests.train.test_training import CPU, TINY, losses


@pytest.fixture(autouse=True)
def small(monkeypatch):
    torch.set_num_threads(1)
    monkeypatch.setattr(preview, "SIZE", 32)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def new_run(folder, photograph, name):
    settings = vary(preset("fast", **{**TINY, "penalty_every": 2}), name)
    return create_run(folder, settings, read_exemplar(photograph, 32), Source(photograph.name, "CC0-1.0", "nobody"), Budget())


def changed(name: str, base: Settings = FAST) -> set[str]:
    varied = asdict(vary(base, name))
    return {field for field, value in asdict(base).items() if varied[field] != value} - {"variant"}


def test_a_variant_changes_what_its_name_says_and_nothing_else():
    assert changed("paper") == changed("paper", PAPER) == set()
    assert changed("noise-at-input") == {"noise_at_input", "sampler_start", "sampler_rate", "sampler_rate_floor"}
    assert changed("gan+vgg") == {"style_features"}
    assert changed("a1b0") == {"alpha", "alpha_half_life", "beta", "color_weight"}
    assert changed("a0b1") == {"alpha", "color_weight"}
    assert changed("henzler", PAPER) == {"noise_at_input", "rotations", "style_features", "alpha"}


def test_noise_at_input_learns_five_times_slower_as_in_the_paper():
    assert vary(PAPER, "noise-at-input").sampler_rate == pytest.approx(1e-4)


def test_the_paper_s_greek_names_are_taken():
    assert [canonical(name) for name in ("α1β0", "α:0, β:1", "GAN+VGG", "a1b0")] == ["a1b0", "a0b1", "gan+vgg", "a1b0"]


@pytest.mark.parametrize("name", CHANGES)
def test_settings_of_every_variant_come_back_from_json(name):
    assert from_json(to_json(vary(FAST, name))) == vary(FAST, name)


def test_options_that_predate_variants_are_the_method():
    values = to_json(FAST)
    for added in ("variant", "noise_at_input", "style_features"):
        del values[added]
    assert from_json(values) == FAST
    del values["color_weight"]
    assert from_json(values) == replace(FAST, color_weight=0.0)


def test_settings_that_are_gone_are_dropped_where_they_changed_nothing_and_refused_where_they_did():
    retired = {"keep_best": True, "group": 1, "pooled_gram": False, "noise_weight_start": 0.5}
    assert from_json(to_json(FAST) | retired) == FAST
    space = preset("fast space")
    assert from_json(to_json(space) | retired | {"pooled_gram": True}) == space
    for changed in {"group": 2}, {"pooled_gram": True}:
        with pytest.raises(TrainingError, match="written by an earlier version"):
            from_json(to_json(FAST) | retired | changed)


def test_noise_at_the_input_is_a_plain_perceptron_on_the_noise():
    sampler = make_sampler(vary(FAST, "noise-at-input"), generator())
    assert isinstance(sampler, NoiseAtInputSampler)
    assert [tuple(layer.weight.shape) for layer in sampler.hidden] == [(128, 32)] + 4 * [(128, 128)]
    noise, points = draw_noise(32, 64, generator()), torch.rand(1, 9, 3, generator=generator())
    x = sampler.eta(noise, points)
    for layer in sampler.hidden:
        x = torch.nn.functional.leaky_relu(layer(x), 0.2)
    torch.testing.assert_close(sampler(noise, points), sampler.output(x))


def test_every_variant_but_two_has_the_paper_s_sampler():
    found = {name for name in CHANGES if isinstance(make_sampler(vary(FAST, name), generator()), Sampler)}
    assert found == {"paper", "gan+vgg", "a1b0", "a0b1"}


def test_the_baseline_slices_along_the_axes_only():
    turned = draw_rotations(vary(preset("fast", batch=300), "henzler"), generator())
    normals = turned[:, :, 2].abs().round(decimals=5)
    torch.testing.assert_close(normals.sort(1).values, torch.tensor([0.0, 0, 1]).expand_as(normals))
    assert (normals.mean(0) > 0.25).all()
    torch.testing.assert_close(torch.linalg.det(turned), torch.ones(300))


@pytest.mark.parametrize(("grain", "along", "step"), [("x", 2, [1, 0, 0]), ("y", 1, [0, 1, 0])])
def test_slices_along_the_axes_keep_the_grain_in_the_image(grain, along, step):
    settings = vary(preset("fast", batch=16, patch=32, grain=grain), "henzler")
    moved = draw_slices(settings, generator()).reshape(16, 32, 32, 3).diff(dim=along) * 64
    torch.testing.assert_close(moved, torch.tensor(step, dtype=torch.float32).expand_as(moved), atol=1e-4, rtol=0)
    assert len(Planes(grain).along_axes()) == 2


def test_the_method_s_features_are_the_critic_itself():
    critic = Critic(generator())
    assert make_judge(FAST, critic, CPU) is critic


def test_with_vgg_the_verdict_stays_the_critic_s_and_without_a_critic_there_is_none():
    critic, images = Critic(generator()), torch.rand(2, 3, 64, 64, generator=generator())
    logits, activations = make_judge(vary(FAST, "gan+vgg"), critic, CPU)(images)
    torch.testing.assert_close(logits, critic(images)[0])
    assert [tuple(a.shape[1:]) for a in activations] == [(64, 64, 64), (128, 32, 32), (256, 16, 16), (512, 8, 8)]
    assert make_judge(vary(FAST, "henzler"), critic, CPU)(images)[0].abs().max() == 0


def test_vgg_without_padding_sees_nothing_beyond_the_border():
    shapes = [tuple(a.shape[2:]) for a in Vgg().features(torch.rand(1, 3, 32, 32))]
    assert shapes == [(30, 30), (28, 28), (12, 12), (10, 10), (3, 3), (1, 1)]


def test_a_relative_style_loss_does_not_know_the_scale_of_the_features():
    real, fake = torch.randn(2, 2, 5, 8, 8, generator=generator())
    assert style_loss([real], [0 * real], relative=True).item() == pytest.approx(1)
    scaled = style_loss([9 * real], [9 * fake], relative=True)
    torch.testing.assert_close(scaled, style_loss([real], [fake], relative=True))


@pytest.mark.parametrize("name", ["noise-at-input", "gan+vgg", "henzler"])
def test_a_variant_stopped_and_resumed_is_the_uninterrupted_one(name, tmp_path, photograph):
    train(new_run(tmp_path / "whole", photograph, name), Budget(iterations=3), CPU)
    for iterations in (2, 3):
        run = open_run(tmp_path / "parts") if iterations > 2 else new_run(tmp_path / "parts", photograph, name)
        train(run, Budget(iterations=iterations), CPU)
    assert losses(tmp_path / "parts") == losses(tmp_path / "whole")
    assert losses(tmp_path / "whole")[-1]["style"] > 0


@pytest.mark.parametrize("name", ["noise-at-input", "henzler"])
def test_a_space_with_noise_at_the_input_tells_exemplars_apart_and_is_no_bundle(name, tmp_path, solidgrain):
    stones = photographs(tmp_path / "stones", 3)
    flags = ["--out", tmp_path / "run", "--patch", 32, "--batch", 2, "--iterations", 2, "--threads", 1]
    assert solidgrain("train", "--space", stones, "--variant", name, *flags).code == 0
    run = open_space_run(tmp_path / "run")
    assert (run.settings.variant, run.settings.latent, run.settings.noise_at_input) == (name, 32, True)
    colours = [
        cells.sampling(run, CPU, as_image(picture(128, 128, seed)))(cells.plane(16, torch.eye(3), np.zeros(3)), 0)
        for seed in (0, 1)
    ]
    assert np.isfinite(colours).all() and np.abs(colours[0] - colours[1]).max() > 0.02
    outcome = solidgrain("export", tmp_path / "run", "--out", tmp_path / "bundle")
    assert outcome.code == 1 and "feeds noise at the input, which a bundle cannot hold" in outcome.error
    assert not (tmp_path / "bundle").exists()


def test_the_critic_learns_unless_no_term_needs_it(tmp_path, photograph):
    for name in CHANGES:
        trainer = Trainer(new_run(tmp_path / canonical(name).replace("+", ""), photograph, name), CPU)
        before = trainer.critic.logit.weight.clone()
        report = trainer.step()
        learned = not torch.equal(before, trainer.critic.logit.weight)
        assert learned == (report.critic_loss != 0) == (name != "henzler")


def test_the_command_line_records_the_variant_and_refuses_others(solidgrain, tmp_path, photograph):
    folder, flags = tmp_path / "run", ["--patch", 32, "--batch", 1, "--threads", 1]
    outcome = solidgrain("train", photograph, "--out", folder, "--variant", "α0β1", "--iterations", 1, *flags)
    assert outcome.code == 0, outcome.err
    settings = open_run(folder).settings
    assert (settings.variant, settings.alpha, settings.beta) == ("a0b1", 0.0, 1.0)
    assert "--variant" in solidgrain("train", "--resume", folder, "--variant", "paper").error
    assert solidgrain("train", photograph, "--out", tmp_path / "other", "--variant", "a2b2").code == 2


def test_missing_vgg_weights_are_an_error_before_there_is_a_run(solidgrain, tmp_path, photograph, monkeypatch):
    monkeypatch.setattr(vgg_module.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SolidgrainError, match=r"solidgrain\[evaluate\]"):
        Vgg()
    for what in ([photograph], ["--space", photographs(tmp_path / "stones", 2)]):
        outcome = solidgrain("train", *what, "--out", tmp_path / "run", "--variant", "henzler", "--patch", 32)
        assert outcome.code == 1
        assert "solidgrain[evaluate]" in outcome.error
        assert not (tmp_path / "run").exists()


def test_export_refuses_a_sampler_that_a_bundle_cannot_hold(tmp_path, photograph):
    from solidgrain.export.from_run import export_run

    train(new_run(tmp_path / "run", photograph, "noise-at-input"), Budget(iterations=1), CPU)
    with pytest.raises(TrainingError, match="cannot hold"):
        export_run(tmp_path / "run", tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()
