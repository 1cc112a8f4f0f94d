"""A training may begin with what an embedded texture's sampler has learned, all but its colours."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from solidgrain.runtime import load
from solidgrain.runtime.bundle import SAMPLER, TEXTURE, embedded_folder
from solidgrain.runtime.errors import BundleError, TrainingError
from solidgrain.runtime.fold import read_weights
from solidgrain.runtime.noise import noise_offsets, noise_tables
from solidgrain.runtime.texture_file import read_texture
from solidgrain.train.first_sampler import begin_as
from solidgrain.train.sampler import Sampler
from solidgrain.train.settings import FAST, PRESETS, preset
from solidgrain.train.slices import UNIT
from tests.train.test_training import new_run


def fresh(**changes) -> Sampler:
    return Sampler(preset("fast", **changes), torch.Generator().manual_seed(3))


@torch.no_grad()
def test_with_its_output_layer_the_sampler_is_the_texture():
    texture, sampler, points = load("granite"), fresh(), np.random.default_rng(1).uniform(-200, 200, (400, 3))
    before = sampler.output.weight.clone()
    begin_as(sampler, "granite")
    assert torch.equal(sampler.output.weight, before)
    folder = embedded_folder("granite")
    *_, weight, bias = read_weights((folder / SAMPLER).read_bytes(), read_texture(folder / TEXTURE))
    sampler.output.weight.copy_(torch.tensor(weight).T / sampler.output.gain)
    sampler.output.bias.copy_(torch.tensor(bias))
    sampler.offsets = torch.from_numpy(noise_offsets(7, 16))
    rgb = sampler.double()(torch.from_numpy(noise_tables(7, 16)).double(), torch.from_numpy(points / UNIT)[None])[0]
    np.testing.assert_allclose(rgb.numpy(), texture.sample(points, seed=7), atol=1e-4)


def test_a_grain_stretches_the_octaves():
    plain, grained = fresh(), fresh(grain="x", grain_ratio=0.25)
    begin_as(plain, "granite")
    begin_as(grained, "granite")
    expected = plain.transforms() * torch.tensor([0.25, 1.0, 1.0])
    torch.testing.assert_close(grained.transforms(), expected)


@pytest.mark.parametrize("changes", [{"octaves": 8}, {"width": 64}])
def test_a_sampler_of_another_size_is_one_line(changes):
    with pytest.raises(TrainingError, match=r"^sampler_start granite: .* 16 octaves, 128 units a layer and "):
        begin_as(fresh(**changes), "granite")


def test_what_is_no_texture_is_one_line():
    with pytest.raises(BundleError, match="is a space"):
        begin_as(fresh(), "stone")
    with pytest.raises(BundleError, match="no such texture"):
        begin_as(fresh(), "granit")


def test_only_the_fast_preset_of_a_single_exemplar_begins_so(tmp_path, photograph):
    from solidgrain.train.task import make_task

    assert {name: settings.sampler_start for name, settings in PRESETS.items()} == {
        "fast": "granite", "paper": "", "fast space": "", "paper space": "",
    }  # fmt: skip
    models = []
    for start in ("granite", ""):
        run = new_run(tmp_path / (start or "none"), photograph, octaves=16, width=128, sampler_start=start)
        models.append(make_task(run, torch.device("cpu")).make_model(torch.Generator().manual_seed(0)))
    given = fresh()
    begin_as(given, "granite")
    assert torch.equal(models[0].directions, given.directions)
    assert not torch.equal(models[1].directions, given.directions)
    assert torch.equal(models[0].color_axes, models[1].color_axes)
    assert FAST.octaves == 16
