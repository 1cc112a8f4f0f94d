"""The colours of a sampler brought to its exemplar's, by its last layer; the paper does not do this.

Before a training, mean and covariance. After it, the mean alone: a GAN ends a shade off, and neither loss says so as exactly
as the photograph does. Contrasts then stay as they were learned: matched as well, they were seen to raise noise along with
them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from solidgrain.train.exemplar import FloatArray
from solidgrain.train.noise import draw_noise
from solidgrain.train.sampler import NARROWEST, NoiseAtInputSampler, Sampler
from solidgrain.train.slices import scatter

INSTANCES, PLACES = 4, 1 << 15  # of noise; in each
LEAST = 1e-6  # deviation of colours that are not all the same
RESOLUTION = 64  # texels along each axis of a noise table


@torch.no_grad()
def settle_mean(sampler: Sampler | NoiseAtInputSampler, exemplar: FloatArray) -> None:
    """Let the sampler's mean colour be that of an exemplar [H, W, 3], in place."""
    missing = _pixels(exemplar).mean(0) - mean_color(sampler)
    axes = sampler.color_axes.double().cpu()  # rgb = color_mean + output axes; all zero in old runs of one colour
    sampler.output.bias.add_((missing @ torch.linalg.pinv(axes)).to(sampler.output.bias))


@torch.no_grad()
def settle_covariance(sampler: Sampler, exemplar: FloatArray) -> None:
    """Let the sampler's colours have the mean and the covariance of an exemplar [H, W, 3], in place.

    Of the linear maps that do so, the one that moves colours least: between normal distributions, optimal transport.
    """
    inverse = torch.linalg.pinv(sampler.color_axes.double().cpu())
    wanted, found = (torch.cov((colors @ inverse).T) for colors in (_pixels(exemplar), colors_of(sampler)))
    root = _root(found)
    undone = torch.linalg.inv(root)
    moved = (undone @ _root(root @ wanted @ root) @ undone).to(sampler.output.bias)  # symmetric
    sampler.output.weight.copy_(moved @ sampler.output.weight)
    sampler.output.bias.copy_(moved @ sampler.output.bias)
    settle_mean(sampler, exemplar)


def _root(covariance: Tensor) -> Tensor:
    """The square root of a covariance, in no direction less than `NARROWEST` of what it is in its widest."""
    variances, axes = torch.linalg.eigh(covariance)
    deviations = variances.clamp(min=0).sqrt()
    least = NARROWEST * max(float(deviations.max()), LEAST)
    root: Tensor = axes @ torch.diag(deviations.clamp(min=least)) @ axes.T
    return root


def mean_color(sampler: Sampler | NoiseAtInputSampler) -> Tensor:
    """The mean colour [3] of the solid, everywhere; float64."""
    return colors_of(sampler).mean(0)


def colors_of(sampler: Sampler | NoiseAtInputSampler) -> Tensor:
    """Colours [N, 3] of the solid, from everywhere, as they are before they are clipped; float64."""
    generator = torch.Generator(sampler.directions.device).manual_seed(7)
    colors = []
    for _ in range(INSTANCES):
        noise = draw_noise(len(sampler.directions), RESOLUTION, generator)
        colors.append(sampler(noise, scatter(1, PLACES, generator))[0].double())
    return torch.cat(colors).cpu()


def _pixels(exemplar: FloatArray) -> Tensor:
    return torch.from_numpy(exemplar).reshape(-1, 3).double()
