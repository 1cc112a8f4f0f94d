"""Colours of a sampler are brought to an exemplar's mean and covariance, and nothing else of it changes."""

from __future__ import annotations

import copy

import pytest
import torch

from solidgrain.train import colors
from solidgrain.train.colors import MOST, least_change, moments, power, sampled_colors, settle_colors
from solidgrain.train.sampler import make_sampler
from solidgrain.train.settings import preset
from solidgrain.train.variants import vary
from tests.train.conftest import blotches

COLORS = blotches(48, 64)


def sampler_of(variant="paper", near=True):
    """A random sampler that speaks along the colours' axes, its contrast about theirs."""
    sampler = make_sampler(vary(preset("fast", octaves=4, width=32), variant), torch.Generator().manual_seed(1))
    sampler.take_colors(*moments(torch.from_numpy(COLORS).reshape(-1, 3)))
    _, covariance = moments(sampled_colors(sampler))
    if near:
        with torch.no_grad():
            sampler.output.weight *= float(
                (moments(torch.from_numpy(COLORS).reshape(-1, 3))[1].trace() / covariance.trace()).sqrt()
            )
    return sampler


@pytest.mark.parametrize("variant", ["paper", "noise-at-input"])
def test_mean_and_covariance_become_the_exemplar_s(variant, monkeypatch):
    monkeypatch.setattr(colors, "MOST", 1000.0)  # random samplers are further off than trained ones
    sampler = sampler_of(variant)
    before = copy.deepcopy(sampler.state_dict())
    settle_colors(sampler, COLORS)
    mean, covariance = moments(sampled_colors(sampler))
    wanted_mean, wanted_covariance = moments(torch.from_numpy(COLORS).reshape(-1, 3))
    torch.testing.assert_close(mean, wanted_mean, atol=1e-4, rtol=0)
    assert (covariance - wanted_covariance).norm() < 0.02 * wanted_covariance.norm()
    assert {name for name, value in sampler.state_dict().items() if not torch.equal(value, before[name])} == {
        *("output.weight", "output.bias")
    }


def test_what_is_right_stays():
    sampler = sampler_of()
    settle_colors(sampler, COLORS)
    once = copy.deepcopy(sampler.output.state_dict())
    settle_colors(sampler, COLORS)
    for name, value in sampler.output.state_dict().items():
        torch.testing.assert_close(value, once[name], atol=1e-3, rtol=1e-3)


def test_the_change_is_symmetric_exact_and_bounded():
    draw = torch.randn(2, 3, 3, generator=torch.Generator().manual_seed(3)).double()
    found, near = draw[0] @ draw[0].T + torch.eye(3), draw[0] @ draw[0].T + 1.5 * torch.eye(3)
    change = least_change(found, near)
    torch.testing.assert_close(change, change.T)
    torch.testing.assert_close(change @ found @ change, near)
    assert torch.linalg.eigvalsh(least_change(found, 1e4 * found)).max() == pytest.approx(MOST)
    torch.testing.assert_close(power(found, 0.5) @ power(found, 0.5), found)


def test_a_flat_exemplar_or_a_flat_sampler_is_no_division_by_zero():
    sampler = sampler_of(near=False)
    settle_colors(sampler, 0 * COLORS + 0.5)
    with torch.no_grad():
        sampler.output.weight.zero_()
    settle_colors(sampler, COLORS)
    assert all(value.isfinite().all() for value in sampler.state_dict().values())
