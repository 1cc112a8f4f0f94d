"""Parzen windows against a slow reference, and where the answer is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from tests.bench import likelihood
from tests.bench.likelihood import BANDWIDTHS, log_likelihoods, take_patches


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def slow_log_likelihood(patch: np.ndarray, truth: np.ndarray, sigma: float) -> float:
    """The definition, one Gaussian at a time."""
    d = len(patch)
    total = 0.0
    for kernel in truth:
        total += math.exp(-((patch - kernel) ** 2).sum() / (2 * sigma**2)) / (sigma * math.sqrt(2 * math.pi)) ** d
    return math.log(total / len(truth))


def test_it_is_the_mean_of_gaussians_around_the_truth(monkeypatch):
    monkeypatch.setattr(likelihood, "BLOCK", 40)  # some blocks, the last of them short
    patches, truth = 3 * normal(11, 6) + 100, 3 * normal(17, 6, seed=1) + 101
    found = log_likelihoods(patches, truth, [1.5, 4.0])
    slow = [[slow_log_likelihood(patch, truth.numpy(), sigma) for patch in patches.numpy()] for sigma in (1.5, 4.0)]
    torch.testing.assert_close(found, torch.tensor(slow, dtype=torch.float64), rtol=0, atol=1e-5)


def test_one_kernel_is_a_gaussian_however_far_the_patch_is_from_it():
    at = torch.tensor([[0.0, 0.0], [3.0, 4.0], [3000.0, 4000.0]])
    expected = [-math.log(2 * math.pi * 4) - square / 8 for square in (0, 25, 25e6)]
    assert log_likelihoods(at, torch.zeros(1, 2), [2.0])[0].tolist() == pytest.approx(expected, rel=1e-9)


def test_samples_of_a_normal_distribution_have_the_likelihood_that_theory_says():
    s, sigma = 20.0, 8.0  # a normal distribution seen through a Gaussian window is one of variance s² + sigma²
    patches, truth = s * normal(2000, 2), s * normal(5000, 2, seed=1)
    expected = -math.log(2 * math.pi * (s**2 + sigma**2)) - s**2 / (s**2 + sigma**2)
    assert log_likelihoods(patches, truth, [sigma]).mean() == pytest.approx(expected, abs=0.05)


def test_held_out_truth_is_most_probable_with_silverman_s_bandwidth():
    s, count = 20.0, 1000
    silverman = 1.06 * s * count**-0.2
    grid = [silverman * factor for factor in (0.2, 0.5, 1, 2, 5)]
    assert int(log_likelihoods(s * normal(2000, 1), s * normal(count, 1, seed=1), grid).mean(1).argmax()) == 2


def test_artefacts_are_less_probable_than_truth():
    truth = 5 * normal(2000, 12)
    held_out, artefacts = 5 * normal(500, 12, seed=1), 5 * normal(500, 12, seed=2)
    artefacts[::10] += 60
    best = log_likelihoods(held_out, truth, BANDWIDTHS).mean(1).argmax()
    of_truth, of_artefacts = (log_likelihoods(each, truth, BANDWIDTHS)[best].mean() for each in (held_out, artefacts))
    assert of_truth > of_artefacts + 5


def test_patches_are_those_of_the_picture_in_levels_and_none_is_taken_twice():
    image = torch.arange(5 * 6, dtype=torch.float32).reshape(1, 1, 5, 6).expand(1, 3, 5, 6) / 255
    patches = take_patches(image, 3, 100, torch.Generator().manual_seed(0))
    assert patches.shape == (3 * 4, 27)
    corners = sorted(patches[:, 0].round().int().tolist())
    assert corners == [row * 6 + column for row in range(3) for column in range(4)]
    ramp = (patches[:1] - patches[:1, :1]).expand(12, 27)
    torch.testing.assert_close(patches - patches[:, :1], ramp, rtol=0, atol=1e-4)
    assert take_patches(image, 3, 4, torch.Generator().manual_seed(0)).shape == (4, 27)
