"""What S begins a training as: the texture that a space, which has seen many materials, makes of the photograph.

Most of a short training would go into octaves and hidden layers that make any grains and veins at all. Only the colours are not
taken as the space guesses them (colors.py).
"""

from __future__ import annotations

import numpy as np
import torch

from solidgrain.runtime.bundle import SAMPLER, embedded_folder
from solidgrain.runtime.errors import TrainingError
from solidgrain.runtime.fold import DoubleArray, read_weights, unstyled
from solidgrain.runtime.space import Space, load_space
from solidgrain.train.colors import settle_covariance
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.layers import Linear
from solidgrain.train.sampler import Sampler
from solidgrain.train.slices import UNIT

ROWS = 3  # of as many crops of the photograph, whose latent codes are averaged


@torch.no_grad()
def begin_as(sampler: Sampler, name: str, exemplar: FloatArray) -> None:
    """Make a sampler what an embedded space makes of an exemplar [H, W, 3]. A grain of the sampler's own stretches its octaves.

    Raises BundleError if there is no such space, TrainingError if its sampler has another size.
    """
    space = load_space(embedded_folder(name))
    texture = space.mapped(mean_code(space, exemplar))
    wanted, found = sampler.noise_weights.shape, texture.noise_weights.shape
    if found != wanted:
        sizes = (f"{bins * octaves} octaves and {width} units a layer" for bins, octaves, width in (found, wanted))
        raise TrainingError(f'sampler_start {name}: has {", this training ".join(sizes)}; give it as many, or sampler_start=""')
    weights = read_weights((space.bundle.folder / SAMPLER).read_bytes(), texture)
    scale = sampler.octave_scale[..., 2:].double().cpu()  # no grain runs along z
    sampler.directions.copy_(torch.from_numpy(texture.transforms * UNIT) / scale)
    sampler.noise_weights.copy_(torch.from_numpy(texture.noise_weights))
    below, *above = (layer for layer in (*sampler.hidden, sampler.output) if isinstance(layer, Linear))
    below.bias.copy_(torch.tensor(weights[0]).to(below.bias) - below.effective_weight() @ sampler.constant)
    *hidden, (to_rgb, rgb) = unstyled(weights, texture)
    inverse = torch.linalg.pinv(sampler.color_axes.double().cpu()).numpy()
    for layer, (weight, bias) in zip(above, [*hidden, (to_rgb @ inverse, rgb @ inverse)], strict=True):
        _set(layer, weight, bias)
    settle_covariance(sampler, exemplar)


def mean_code(space: Space, exemplar: FloatArray) -> FloatArray:
    """The latent code of a photograph as a whole; one that is smaller than the encoder's patch is mirrored at its edges."""
    missing = [max(0, space.patch - extent) for extent in exemplar.shape[:2]]
    padded = np.pad(exemplar, [(0, missing[0]), (0, missing[1]), (0, 0)], mode="symmetric")
    tops, lefts = (np.linspace(0, extent - space.patch, ROWS).astype(int) for extent in padded.shape[:2])
    codes = [space.code(padded[top:, left:][: space.patch, : space.patch]) for top in tops for left in lefts]
    mean: FloatArray = np.mean(codes, 0)
    return mean


def _set(layer: Linear, weight: DoubleArray, bias: DoubleArray) -> None:
    """weight [inputs, outputs] and bias as they are used, x W + b."""
    layer.weight.copy_(torch.from_numpy(weight.T / layer.gain))
    layer.bias.copy_(torch.from_numpy(bias))
