"""The colours of a trained sampler, brought to those of its exemplar: mean and covariance, by its last layer alone.

A GAN ends a little off, a shade too dark or a tenth too pale, and neither loss says so as exactly as the photograph does. The
paper does not do this.
"""

from __future__ import annotations

import torch
from torch import Tensor

from solidgrain.train.exemplar import FloatArray
from solidgrain.train.noise import draw_tables
from solidgrain.train.sampler import NoiseAtInputSampler, Sampler

INSTANCES, PLACES = 4, 1 << 15  # of noise; in each, so far apart that all are as good as independent
REACH = 64.0  # units of 64 pixels
MOST = 2.0  # times that a contrast is raised or lowered: what is further off is no drift


@torch.no_grad()
def settle_colors(sampler: Sampler | NoiseAtInputSampler, exemplar: FloatArray) -> None:
    """Let the sampler's colours have the mean and the covariance of an exemplar [H, W, 3], in place.

    The change is the linear map between the two normal distributions that moves colours the least (Dowson and Landau 1982).
    """
    mean, covariance = moments(sampled_colors(sampler))
    wanted_mean, wanted_covariance = moments(torch.from_numpy(exemplar).reshape(-1, 3))
    change = least_change(covariance, wanted_covariance)  # rgb -> wanted_mean + (rgb - mean) change

    axes, origin = sampler.color_axes.double().cpu(), sampler.color_mean.double().cpu()  # rgb = origin + output axes
    turned = axes @ change @ torch.linalg.inv(axes)
    shift = (wanted_mean + (origin - mean) @ change - origin) @ torch.linalg.inv(axes)
    layer = sampler.output
    layer.weight.copy_(turned.T @ layer.weight.double().cpu())
    layer.bias.copy_(layer.bias.double().cpu() @ turned + shift)


def sampled_colors(sampler: Sampler | NoiseAtInputSampler) -> Tensor:
    """Colours [P, 3] of the solid, everywhere."""
    device = sampler.directions.device
    generator = torch.Generator(device).manual_seed(7)
    colors = []
    for _ in range(INSTANCES):
        tables = draw_tables(len(sampler.directions), 64, generator)
        points = REACH * torch.rand(1, PLACES, 3, generator=generator, device=device)
        colors.append(sampler(tables, points)[0])
    return torch.cat(colors).cpu()


def moments(colors: Tensor) -> tuple[Tensor, Tensor]:
    """Mean [3] and covariance [3, 3] of colours [P, 3], in float64."""
    return colors.double().mean(0), torch.cov(colors.double().T)


def least_change(found: Tensor, wanted: Tensor) -> Tensor:
    """The symmetric matrix that turns one covariance into another, no contrast changing more than `MOST` times."""
    root, inverse = power(found, 0.5), power(found, -0.5)
    factors, axes = torch.linalg.eigh(inverse @ power(root @ wanted @ root, 0.5) @ inverse)
    change: Tensor = axes @ torch.diag(factors.clamp(1 / MOST, MOST)) @ axes.T
    return change


def power(covariance: Tensor, exponent: float) -> Tensor:
    """A power of a symmetric matrix, its variances no smaller than a millionth of the largest."""
    variances, axes = torch.linalg.eigh(covariance)
    variances = variances.clamp(min=max(1e-12, 1e-6 * float(variances.max())))
    raised: Tensor = axes @ torch.diag(variances**exponent) @ axes.T
    return raised
