"""A training begins as what the embedded space makes of its photograph, in the photograph's colours."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from solidgrain.runtime import load
from solidgrain.runtime.errors import BundleError, TrainingError
from solidgrain.train.first_sampler import begin_as, mean_code
from solidgrain.train.loop import Trainer
from solidgrain.train.noise import runtime_noise
from solidgrain.train.sampler import Sampler
from solidgrain.train.settings import PRESETS, preset
from solidgrain.train.slices import UNIT
from tests.train.conftest import blotches
from tests.train.test_training import new_run

FULL = {"octaves": 32, "width": 128}


def fresh(exemplar=None, **changes) -> Sampler:
    sampler = Sampler(preset("fast", **changes), torch.Generator().manual_seed(3))
    if exemplar is not None:
        pixels = torch.from_numpy(exemplar).reshape(-1, 3).double().T
        sampler.take_colors(pixels.mean(1), torch.cov(pixels))
    return sampler


@torch.no_grad()
def colors(sampler: Sampler, points) -> np.ndarray:
    points = torch.from_numpy(points / UNIT)[None]
    return sampler.double()(runtime_noise(7, 32, points), points)[0].numpy()


@pytest.mark.parametrize("principal", [True, False], ids=["principal", "plain"])
def test_it_is_the_space_s_texture_in_the_exemplar_s_colours(principal):
    exemplar = blotches(150, 200)
    sampler = fresh(exemplar if principal else None)
    begin_as(sampler, "stone", exemplar)
    points = np.random.default_rng(1).uniform(-2000, 2000, (6000, 3))
    rgb = colors(sampler, points)
    np.testing.assert_allclose(rgb.mean(0), exemplar.mean((0, 1)), atol=0.01)
    np.testing.assert_allclose(np.cov(rgb.T), np.cov(exemplar.reshape(-1, 3).T), atol=0.05 * exemplar.var())
    space = load("stone")
    texture = space.texture(mean_code(space, exemplar)).sample(points, seed=7)
    inside = np.all((texture > 0) & (texture < 1), 1)  # the runtime clips
    assert inside.mean() > 0.8
    affine = np.c_[texture, np.ones(len(texture))][inside]  # one linear map and one shift of all colours, no more
    fitted = affine @ np.linalg.lstsq(affine, rgb[inside])[0]
    np.testing.assert_allclose(rgb[inside], fitted, atol=1e-3)


def test_a_bundle_of_that_name_in_the_working_directory_is_not_the_embedded_space(tmp_path, monkeypatch):
    (tmp_path / "stone").mkdir()
    (tmp_path / "stone" / "manifest.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    begin_as(fresh(), "stone", blotches(140, 140))


def test_a_grain_stretches_the_octaves():
    plain, grained, exemplar = fresh(), fresh(grain="x", grain_ratio=0.25), blotches(140, 140)
    begin_as(plain, "stone", exemplar)
    begin_as(grained, "stone", exemplar)
    torch.testing.assert_close(grained.transforms(), plain.transforms() * torch.tensor([0.25, 1.0, 1.0]))


def test_the_whole_photograph_is_encoded_and_a_small_one_mirrored():
    space, exemplar = load("stone"), blotches(128, 400)
    halves = [exemplar.copy(), exemplar.copy()]
    halves[0][:, :100], halves[1][:, -100:] = 0.0, 1.0
    codes = [mean_code(space, one) for one in (exemplar, *halves)]
    assert not np.allclose(codes[0], codes[1]) and not np.allclose(codes[0], codes[2])
    np.testing.assert_allclose(mean_code(space, exemplar[:, :128]), space.code(exemplar[:, :128]), atol=1e-5)
    assert np.isfinite(mean_code(space, exemplar[:33, :40])).all()


@pytest.mark.parametrize("changes", [{"octaves": 16}, {"width": 64}])
def test_a_sampler_of_another_size_is_one_line(changes):
    message = r"^sampler_start stone: has 32 octaves and 128 units a layer, this training \d+ octaves and"
    with pytest.raises(TrainingError, match=message):
        begin_as(fresh(**changes), "stone", blotches(128, 128))


def test_what_is_no_space_is_one_line():
    with pytest.raises(BundleError, match="holds one texture and no encoder"):
        begin_as(fresh(), "granite", blotches(128, 128))
    with pytest.raises(BundleError, match="no such texture"):
        begin_as(fresh(), "stones", blotches(128, 128))


def test_only_the_fast_preset_of_a_single_exemplar_begins_so(tmp_path, photograph):
    starts = {name: settings.sampler_start for name, settings in PRESETS.items()}
    assert starts == {"fast": "stone", "paper": "", "fast space": "", "paper space": ""}
    runs = [new_run(tmp_path / f"run{start}", photograph, sampler_start=start, **FULL) for start in ("stone", "")]
    begun, random = (Trainer(run, torch.device("cpu")).sampler for run in runs)
    expected = fresh(runs[0].exemplar)
    begin_as(expected, "stone", runs[0].exemplar)
    for name, value in expected.state_dict().items():
        if name not in ("constant", "hidden.0.weight", "hidden.0.bias"):  # whose sum is the same, but for rounding
            torch.testing.assert_close(begun.state_dict()[name], value, rtol=1e-4, atol=1e-5)
    first, wanted = (sampler.hidden[0](sampler.constant) for sampler in (begun, expected))
    torch.testing.assert_close(first, wanted, rtol=1e-4, atol=1e-5)
    assert not torch.equal(random.directions, expected.directions)
