"""The mean colour of a sampler is brought to an exemplar's, and nothing else of it changes."""

from __future__ import annotations

import copy

import pytest
import torch

from solidgrain.train.colors import mean_color, settle_mean
from solidgrain.train.sampler import make_sampler
from solidgrain.train.settings import preset
from solidgrain.train.variants import vary
from tests.train.conftest import blotches

COLORS = blotches(48, 64)


def sampler_of(variant, exemplar):
    """A random sampler that speaks along the exemplar's axes."""
    sampler = make_sampler(vary(preset("fast", octaves=4, width=32), variant), torch.Generator().manual_seed(1))
    pixels = torch.from_numpy(exemplar).reshape(-1, 3).T.double()
    sampler.take_colors(pixels.mean(1), torch.cov(pixels))
    return sampler


def test_axes_are_part_of_the_state_and_those_of_earlier_versions_the_reader_s_own():
    """The sign of an eigenvector is up to the machine: who reads a state must not compute its own axes."""
    written, read = sampler_of("paper", COLORS), sampler_of("paper", COLORS[:, :, ::-1].copy())
    state = written.state_dict()
    state["color_axes"] = -state["color_axes"]
    own = read.color_axes.clone()
    read.load_state_dict({name: value for name, value in state.items() if not name.startswith("color_")})
    torch.testing.assert_close(read.color_axes, own)
    read.load_state_dict(state)
    torch.testing.assert_close(read.color_axes, -written.color_axes)


@pytest.mark.parametrize("variant", ["paper", "noise-at-input"])
def test_the_mean_becomes_the_exemplar_s(variant):
    sampler = sampler_of(variant, COLORS)
    before = copy.deepcopy(sampler.state_dict())
    wanted = torch.tensor([0.2, 0.6, 0.4], dtype=torch.float64)
    with torch.no_grad():
        assert (mean_color(sampler) - wanted).abs().max() > 0.05
        settle_mean(sampler, 0 * COLORS + wanted.float().numpy())
        torch.testing.assert_close(mean_color(sampler), wanted, atol=1e-5, rtol=0)
    changed = {name for name, value in sampler.state_dict().items() if not torch.equal(value, before[name])}
    assert changed == {"output.bias"}


def test_a_sampler_without_axes_of_its_own_and_one_of_a_single_colour():
    plain = make_sampler(preset("fast", octaves=4, width=32), torch.Generator().manual_seed(1))
    flat = sampler_of("paper", 0 * COLORS + 0.5)
    for sampler in (plain, flat):
        settle_mean(sampler, COLORS)
        assert sampler.output.bias.isfinite().all()
    torch.testing.assert_close(mean_color(plain), torch.from_numpy(COLORS).reshape(-1, 3).double().mean(0), atol=1e-5, rtol=0)
