"""The mean colour of a trained sampler, brought to its exemplar's by its last bias.

A GAN ends a shade off, and neither loss says so as exactly as the photograph does. The paper does not do this. Contrasts stay
as they were learned: matched as well, they were seen to raise noise along with them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from solidgrain.train.exemplar import FloatArray
from solidgrain.train.noise import draw_tables
from solidgrain.train.sampler import NoiseAtInputSampler, Sampler

INSTANCES, PLACES = 4, 1 << 15  # of noise; in each, so far apart that all are as good as independent
REACH = 64.0  # units of 64 pixels
RESOLUTION = 64  # texels along each axis of a noise table


@torch.no_grad()
def settle_mean(sampler: Sampler | NoiseAtInputSampler, exemplar: FloatArray) -> None:
    """Let the sampler's mean colour be that of an exemplar [H, W, 3], in place."""
    missing = torch.from_numpy(exemplar).reshape(-1, 3).double().mean(0) - mean_color(sampler)
    axes = sampler.color_axes.double().cpu()  # rgb = origin + output axes; all zero if the exemplar has one colour
    sampler.output.bias.add_((missing @ torch.linalg.pinv(axes)).to(sampler.output.bias))


def mean_color(sampler: Sampler | NoiseAtInputSampler) -> Tensor:
    """The mean colour [3] of the solid, everywhere; float64."""
    device = sampler.directions.device
    generator = torch.Generator(device).manual_seed(7)
    means = []
    for _ in range(INSTANCES):
        tables = draw_tables(len(sampler.directions), RESOLUTION, generator)
        points = REACH * torch.rand(1, PLACES, 3, generator=generator, device=device)
        means.append(sampler(tables, points)[0].double().mean(0))
    return torch.stack(means).mean(0).cpu()
