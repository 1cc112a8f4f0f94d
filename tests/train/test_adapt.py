"""Adapting moves what a texture owns, and nothing else, until its slices look more like a photograph to the critic."""

from __future__ import annotations

import json
import os
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from solidgrain.export.from_space_run import export_space_run
from solidgrain.runtime import BundleError, ExemplarError, TrainingError, load_space, load_texture
from solidgrain.runtime.bundle import CRITIC, open_bundle
from solidgrain.train import adapt as adapt_module
from solidgrain.train.adapt import (
    DEFAULT,
    Adaptation,
    Features,
    FrozenSampler,
    Theta,
    adapt,
    critic_features,
    vgg_features,
)
from solidgrain.train.adapt_command import make_budget
from solidgrain.train.companion import read_companion
from solidgrain.train.console import StopRequest
from solidgrain.train.loop import Trainer
from solidgrain.train.noise import look_up, runtime_noise
from solidgrain.train.settings import Budget
from solidgrain.train.slices import UNIT
from tests.toy_space import write_toy_critic
from tests.train.spaces import new_space, picture, write

CPU = torch.device("cpu")
# From a toy space, which knows nothing, the way is long: larger steps.
RECIPE = replace(DEFAULT, octave_rate=1e-2, style_rate=1e-2, noise_rate=1e-2, crops=8, warm_up=1, measured=2)
ARRAYS = ("transforms", "gamma", "delta", "noise_weights")


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def space(toy_space_folder):
    return load_space(toy_space_folder, threads=1)


@pytest.fixture(scope="module")
def clouds() -> np.ndarray:
    """Dark blue ones, of 150 x 130 pixels: nothing like what the toy space makes of anything."""
    return picture(130, 150, seed=3) * np.array([0.2, 0.3, 0.6], np.float32)


@pytest.fixture(scope="module")
def photo(clouds, tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("photographs") / "clouds.png", clouds)


@pytest.fixture(scope="module")
def companion(toy_space_folder):
    return read_companion(toy_space_folder / CRITIC, open_bundle(toy_space_folder))


@pytest.fixture(scope="module")
def run(space, companion, clouds):
    """Adapt the toy space's texture of the clouds; keywords replace arguments of `adapt`, or settings."""
    start = space.encode(clouds, "clouds").data

    def call(iterations=20, seed=0, features=None, patch=32, batch=2, **changes):
        settings = replace(companion.settings, patch=patch, batch=batch, precision="float32", seed=seed)
        sampler = FrozenSampler(space.bundle, start, CPU)
        features = features or critic_features(companion, CPU)
        arguments = {"recipe": RECIPE, "budget": Budget(iterations), **changes}
        budget = arguments.pop("budget")
        return adapt(start, sampler, clouds, features, settings, budget, CPU, **arguments)

    return call


@pytest.fixture(scope="module")
def adapted(run):
    return run(40)


def test_adapting_lowers_l_style(adapted, space, companion, clouds):
    assert adapted.end < 0.5 * adapted.start
    assert (adapted.iterations, adapted.ended) == (40, "budget")
    settings = replace(companion.settings, patch=32, batch=2, precision="float32", seed=99)
    unseen = []  # slices and crops that it was not adapted with
    for texture in (space.encode(clouds).data, adapted.texture):
        sampler, features = FrozenSampler(space.bundle, texture, CPU), critic_features(companion, CPU)
        state = Adaptation(texture, sampler, clouds, features, settings, RECIPE, CPU)
        unseen.append(state.measure(state.theta))
    assert unseen[1] < 0.5 * unseen[0]


def test_colours_come_close_to_the_photograph_s(adapted, space, clouds):
    def far(texture):
        return np.abs(space.open(texture).grid((1, 64, 64)).mean((0, 1, 2)) - clouds.mean((0, 1))).max()

    assert far(adapted.texture) < 0.5 * far(space.encode(clouds).data)


def test_a_bright_faint_material_is_not_rounded_away(space, companion, clouds):
    """Colours of 0.9 have steps of 1/256 in bfloat16, more than what a faint photograph's texture shows."""
    start = space.encode(clouds, "clouds").data
    sampler = FrozenSampler(space.bundle, start, CPU)
    theta = Theta(torch.empty(0), *(torch.tensor(getattr(start, name)) for name in ARRAYS[1:]))
    noise = torch.randn(1, 500, len(start.transforms), generator=torch.Generator().manual_seed(0))
    with torch.autocast("cpu", torch.bfloat16):
        rgb = sampler(noise, theta)
    assert rgb.dtype == torch.float32
    assert not torch.equal(rgb, rgb.bfloat16().float())


def test_a_budget_is_two_minutes_unless_told_otherwise():
    def budget(**given):
        return make_budget(Namespace(**{"iterations": None, "seconds": None, **given}))

    assert budget() == Budget(600, 2.0)
    assert budget(iterations=900) == Budget(900)
    assert budget(seconds=30.0) == Budget(None, 0.5)


def test_only_what_the_texture_owns_changes(space, companion, clouds):
    start, critic = space.encode(clouds, "clouds").data, companion.critic
    sampler = FrozenSampler(space.bundle, start, CPU)
    fixed = [sampler.first, *(part for layer in sampler.layers for part in layer), *critic.state_dict().values()]
    before = [tensor.clone() for tensor in fixed]
    settings = replace(companion.settings, patch=32, batch=2)
    found = adapt(start, sampler, clouds, critic_features(companion, CPU), settings, Budget(3), CPU, RECIPE).texture
    assert all(torch.equal(a, b) for a, b in zip(before, fixed, strict=True))
    assert all(tensor.grad is None for tensor in critic.parameters())
    assert [name for name in ARRAYS if np.array_equal(getattr(found, name), getattr(start, name))] == []
    assert (found.name, found.sampler_sha256) == (start.name, start.sampler_sha256)
    np.testing.assert_array_equal(found.latent, start.latent)


def test_the_same_seed_gives_the_same_texture(run):
    assert run(4).texture.sha256 == run(4).texture.sha256
    assert run(4, seed=1).texture.sha256 != run(4).texture.sha256


def test_the_rebuilt_sampler_says_what_the_runtime_says(space, clouds):
    draw = np.random.default_rng(0)
    start = space.encode(clouds).data
    moved = {name: getattr(start, name) * draw.uniform(0.8, 1.2, getattr(start, name).shape) for name in ARRAYS}
    texture = replace(start, **{name: value.astype(getattr(start, name).dtype) for name, value in moved.items()})
    points, octaves = draw.uniform(-64, 64, (4096, 3)), len(texture.transforms)
    transforms, where = torch.from_numpy(texture.transforms), torch.from_numpy(points)[None]
    eta = look_up(runtime_noise(3, octaves, where), transforms, where)
    theta = Theta(torch.empty(0), *(torch.from_numpy(getattr(texture, name)) for name in ARRAYS[1:]))
    rgb = FrozenSampler(space.bundle, texture, CPU)(eta.float(), theta)[0].numpy()
    np.testing.assert_allclose(rgb.clip(0, 1), space.open(texture).sample(points, seed=3), atol=1e-4)


def test_what_it_moves_starts_as_the_texture_that_it_was_given(space, companion, clouds):
    start = space.encode(clouds).data
    settings = replace(companion.settings, patch=32, batch=2)
    sampler = FrozenSampler(space.bundle, start, CPU)
    state = Adaptation(start, sampler, clouds, critic_features(companion, CPU), settings, RECIPE, CPU)
    found = state.texture(state.average)
    for name in ARRAYS:
        np.testing.assert_allclose(getattr(found, name), getattr(start, name), rtol=1e-6, atol=1e-9)
    assert UNIT * start.transforms[0] == pytest.approx((state.theta.directions * state.octave_scale)[0].detach().numpy())


def test_a_plateau_ends_it_early_and_slowly(run):
    """Nothing ever counts as a gain here: rates begin to fall after 4 iterations, and have fallen after 6."""
    found = run(60, recipe=replace(RECIPE, patience=4, gain=1.0))
    assert (found.iterations, found.ended) == (6, "plateau")


def test_a_budget_of_seconds_ends_it(run, monkeypatch):
    """By a clock of its own: what is reserved for the last measuring is as long as the first one took."""
    now = [0.0]

    def lasting(method, seconds):
        def timed(self, *arguments):
            now[0] += seconds
            return method(self, *arguments)

        return timed

    monkeypatch.setattr(adapt_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(adapt_module.Adaptation, "measure", lasting(adapt_module.Adaptation.measure, 0.1))
    monkeypatch.setattr(adapt_module.Adaptation, "step", lasting(adapt_module.Adaptation.step, 0.03))
    found = run(budget=Budget(minutes=0.5 / 60))
    assert found.ended == "budget"
    assert 0.5 < found.seconds < 30


def test_nan_ends_it_with_the_best_before(run, companion):
    """The critic answers NaN once, in the seventh iteration, after four batches of crops and two that were measured."""
    calls = []

    def activations(images):
        calls.append(None)
        found = companion.critic(images)[1]
        return [of_layer * float("nan") for of_layer in found] if len(calls) == 4 + 2 + 7 else found

    found = run(40, features=Features(activations, relative=False))
    assert (found.iterations, found.ended) == (7, "diverged")
    assert found.end < found.start
    assert all(np.isfinite(array).all() for array in found.texture.arrays().values())


def test_rates_that_are_far_too_high_leave_a_texture_that_is_no_worse(run):
    found = run(20, recipe=replace(RECIPE, octave_rate=10.0, style_rate=10.0, noise_rate=10.0, memory=2))
    assert found.ended == "diverged"
    assert found.end <= found.start


def test_a_critic_that_says_nothing_is_an_error(run):
    with pytest.raises(TrainingError, match="its L_style is not a number"):
        run(features=Features(lambda images: [images * float("nan")], relative=False))


def test_stopping_keeps_what_there_is(run):
    seen = []
    found = run(100, on_report=seen.append, should_stop=lambda: len(seen) == 5)
    assert (found.iterations, found.ended) == (5, "stopped")
    assert found.end < found.start


def test_vgg_features_in_the_place_of_the_critic_s(run):
    pytest.importorskip("stlpips_pytorch", reason="VGG-16 needs pip install 'solidgrain[evaluate]'")
    found = run(8, features=vgg_features(CPU))
    assert found.end < found.start


def test_the_texture_file_loads_and_bakes(solidgrain, toy_space_folder, photo, tmp_path):
    out = tmp_path / "clouds.sgt.npz"
    flags = ("--bundle", toy_space_folder, "--out", out, "--iterations", 2, "--threads", 1)
    outcome = solidgrain("adapt", photo, *flags, "--json")
    assert outcome.code == 0, outcome.err
    assert "L_style" in outcome.err
    report, texture = json.loads(outcome.out), load_texture(out, bundle=toy_space_folder)
    assert report["texture_sha256"] == texture.data.sha256
    assert (report["iterations"], report["features"], report["name"]) == (2, "critic", "clouds")
    assert report["style_end"] <= report["style_start"]
    encoded = load_space(toy_space_folder).encode(oiio.ImageBuf(os.fspath(photo)).get_pixels(oiio.FLOAT)).data
    np.testing.assert_array_equal(texture.data.latent, encoded.latent)
    assert not np.array_equal(texture.data.gamma, encoded.gamma)
    baked = tmp_path / "clouds.npy"
    assert solidgrain("bake", out, "--bundle", toy_space_folder, "--size", 4, "--out", baked, "--quiet").code == 0
    np.testing.assert_allclose(np.load(baked), texture.grid((4, 4, 4)), atol=1 / 255)
    assert solidgrain("adapt", photo, *flags).code == 1
    assert solidgrain("adapt", photo, *flags, "--overwrite", "--features", "vgg").code == 0


def test_a_photograph_smaller_than_the_space_s_patches_is_one_line(run):
    with pytest.raises(ExemplarError, match="150x130 pixels to adapt to: expected at least 160"):
        run(1, patch=160)


def test_any_batch_and_any_seed_will_do(run):
    assert run(1, batch=RECIPE.crops + 1).iterations == 1
    assert run(1, seed=2**64 - 1).iterations == 1


def test_interrupting_saves_what_there_is(solidgrain, toy_space_folder, photo, tmp_path, monkeypatch):
    """Ctrl-C in the second iteration; before the first there is nothing to save."""
    for asked, files in ((2, ["clouds.sgt.npz"]), (1, [])):
        folder = tmp_path / str(asked)
        folder.mkdir()
        answers = iter([False] * (asked - 1) + [True])
        monkeypatch.setattr(StopRequest, "requested", lambda self, answers=answers: next(answers))
        outcome = solidgrain("adapt", photo, "--bundle", toy_space_folder, "--out", folder / "clouds.sgt.npz", "--quiet")
        assert outcome.code == 130
        assert sorted(path.name for path in folder.iterdir()) == files


def test_a_crop_is_all_that_is_adapted_to(solidgrain, toy_space_folder, tmp_path, monkeypatch):
    """Without it the whole photograph is, scaled; E sees the same patch either way."""
    photograph = write(tmp_path / "wide.png", picture(280, 320, seed=4))
    seen = []

    def keep(start, sampler, pixels, *arguments, **keywords):
        seen.append((start, pixels))
        raise TrainingError("enough")

    monkeypatch.setattr("solidgrain.train.adapt.adapt", keep)
    flags = ("--bundle", toy_space_folder, "--out", tmp_path / "a.sgt.npz", "--patch-scale", 2)
    for crop in ((), ("--crop", "32,12")):
        assert solidgrain("adapt", photograph, *flags, *crop).code == 1
    (of_whole, whole), (of_crop, crop) = seen
    assert (whole.shape, crop.shape) == ((140, 160, 3), (128, 128, 3))
    np.testing.assert_allclose(whole[6:134, 16:144], crop, atol=1e-6)
    np.testing.assert_allclose(of_whole.latent, of_crop.latent, atol=1e-5)


def test_a_photograph_that_changes_across_itself_gets_a_warning_that_names_the_figure(solidgrain, toy_space_folder, tmp_path):
    ramp = write(tmp_path / "ramp.png", np.linspace(0, 1, 150)[:, None, None] * np.ones((150, 140, 3)))
    flags = ("--bundle", toy_space_folder, "--out", tmp_path / "a.sgt.npz", "--iterations", 1, "--threads", 1)
    assert "nonstationarity 0.9" in solidgrain("adapt", ramp, *flags).err


@pytest.mark.parametrize(
    ("flags", "code", "message"),
    [
        (("missing.png", "--out", "a.sgt.npz"), 1, "missing.png: no such file"),
        (("small.png", "--out", "a.sgt.npz"), 1, "100x127 pixels, expected at least 128x128"),
        (("damaged.png", "--out", "a.sgt.npz"), 1, "damaged.png"),
        (("photo.png", "--out", "a.sgt.npz", "--patch-scale", "2"), 1, "expected at least 256x256"),
        (("photo.png", "--out", "a.sgt.npz", "--crop", "60,0"), 1, "--crop 60,0"),
        (("photo.png", "--out", "a.npz"), 2, "expected a name that ends in .sgt.npz"),
        (("photo.png", "--out", "nowhere/a.sgt.npz"), 2, "no folder nowhere"),
        (("photo.png", "--out", "there.sgt.npz"), 1, "there.sgt.npz: already exists"),
        (("photo.png", "--out", "a.sgt.npz", "--iterations", "0"), 2, "expected a whole number above 0"),
        (("photo.png", "--out", "a.sgt.npz", "--seconds", "-1"), 2, "expected seconds above 0"),
        (("photo.png", "--out", "a.sgt.npz", "--critic", "none.npz"), 1, "none.npz: missing; adapting needs the critic"),
        (("photo.png", "--out", "a.sgt.npz", "--critic", "photo.png"), 1, "not a critic's file, or damaged"),
        (("photo.png", "--out", "a.sgt.npz", "--critic", "half.npz"), 1, "half.npz: not a critic's file, or damaged"),
        (("photo.png", "--out", "a.sgt.npz", "--critic", "there.sgt.npz"), 1, "expected solidgrain-critic version 1"),
        (("photo.png", "--out", "a.sgt.npz", "--critic", "other.npz"), 1, "is the critic of the bundle whose sampler.onnx"),
        (("photo.png", "--out", "a.sgt.npz", "--features", "vgg", "--critic", "other.npz"), 2, "leave --critic out"),
        (("photo.png", "--out", "a.sgt.npz", "--bundle", "granite"), 1, "holds one texture and no encoder"),
        (("photo.png", "--out", "a.sgt.npz", "--bundle", "bare"), 1, "export its run with --companion"),
        (("photo.png", "--out", "a.sgt.npz", "--bundle", "nowhere"), 1, "nowhere"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(solidgrain, surroundings, flags, code, message, monkeypatch):
    monkeypatch.chdir(surroundings)
    before = {path: path.stat().st_mtime_ns for path in surroundings.iterdir()}
    bundle = () if "--bundle" in flags else ("--bundle", "toyspace")
    outcome = solidgrain("adapt", *flags, *bundle, "--threads", "1")
    assert outcome.code == code, outcome.err
    assert message in outcome.error
    assert {path: path.stat().st_mtime_ns for path in surroundings.iterdir()} == before


@pytest.fixture(scope="module")
def surroundings(toy_space_folder, photo, clouds, space, tmp_path_factory) -> Path:
    """A folder with a good photograph and space, and with much that is wrong."""
    folder = tmp_path_factory.mktemp("surroundings")
    (folder / "toyspace").symlink_to(toy_space_folder)
    (folder / "bare").mkdir()
    for path in toy_space_folder.iterdir():
        if path.name != CRITIC:
            (folder / "bare" / path.name).symlink_to(path)
    (folder / "photo.png").write_bytes(photo.read_bytes())
    (folder / "damaged.png").write_bytes(photo.read_bytes()[:2000])
    write(folder / "small.png", clouds[:127, :100])
    (folder / "half.npz").write_bytes((toy_space_folder / CRITIC).read_bytes()[:100_000])
    space.encode(clouds).save(folder / "there.sgt.npz")
    write_toy_critic(folder / "other.npz", "0" * 64)
    return folder


def test_a_critic_is_written_to_the_same_bytes_and_read_in_half_precision(toy_space_folder, companion, tmp_path):
    again = tmp_path / CRITIC
    write_toy_critic(again, open_bundle(toy_space_folder).sampler_sha256)
    assert again.read_bytes() == (toy_space_folder / CRITIC).read_bytes()
    assert again.stat().st_size < 5e6
    assert (companion.settings.patch, companion.settings.grain) == (64, "none")
    assert not any(parameter.requires_grad for parameter in companion.critic.parameters())


@pytest.mark.parametrize("harm", ["missing", "shape", "nan", "type"])
def test_a_critic_with_a_wrong_array_is_refused(toy_space_folder, tmp_path, harm):
    with np.load(toy_space_folder / CRITIC) as archive:
        arrays = dict(archive)
    bias = arrays["logit.bias"]
    changed = {"shape": bias[:0], "nan": bias * np.float16("nan"), "type": bias.astype(np.float64)}
    arrays.pop("logit.bias")
    np.savez(tmp_path / CRITIC, **arrays, **({"logit.bias": changed[harm]} if harm in changed else {}))
    with pytest.raises(BundleError, match=r"logit.bias is not finite float16 of shape \(1,\); damaged, export it again"):
        read_companion(tmp_path / CRITIC, open_bundle(toy_space_folder))


def test_export_writes_the_critic_that_the_space_was_trained_against(tmp_path, solidgrain):
    training = new_space(tmp_path / "run", octaves=16, batch=4, grain="x")
    trainer = Trainer(training, CPU)
    trainer.save()
    assert solidgrain("export", training.folder, "--out", tmp_path / "plain").code == 0
    assert not (tmp_path / "plain" / CRITIC).exists()
    bundle = open_bundle(export_space_run(training.folder, tmp_path / "space", companion=True))
    found = read_companion(bundle.folder / CRITIC, bundle)
    assert CRITIC not in bundle.manifest["files"]
    assert (found.settings.patch, found.settings.batch, found.settings.grain) == (32, 4, "x")
    for name, tensor in trainer.critic.state_dict().items():
        torch.testing.assert_close(found.critic.state_dict()[name], tensor, rtol=1e-3, atol=1e-6)
    assert solidgrain("export", training.folder, "--out", tmp_path / "space", "--overwrite", "--companion").code == 0


def test_a_companion_is_for_spaces(solidgrain, photograph, tmp_path):
    flags = ("--out", tmp_path / "run", "--iterations", 1, "--patch", 32, "--batch", 2, "--threads", 1, "--quiet")
    assert solidgrain("train", photograph, *flags).code == 0
    outcome = solidgrain("export", tmp_path / "run", "--out", tmp_path / "one", "--companion")
    assert (outcome.code, (tmp_path / "one").exists()) == (2, False)
    assert "adapting needs a texture space" in outcome.error
