"""What S begins a training as: the sampler of another material, but for its colours.

Most of a short training goes into octaves and hidden layers that make any spots and veins at all, and another material's are
nearer to this one's than random ones. They come from an embedded texture. Its output layer speaks of its own colours, and
stays behind.
"""

from __future__ import annotations

import torch

from solidgrain.runtime.bundle import SAMPLER, TEXTURE, embedded_folder, open_bundle
from solidgrain.runtime.errors import BundleError, TrainingError
from solidgrain.runtime.fold import read_weights
from solidgrain.runtime.texture_file import read_texture
from solidgrain.train.layers import Linear
from solidgrain.train.sampler import Sampler
from solidgrain.train.slices import UNIT


@torch.no_grad()
def begin_as(sampler: Sampler, name: str) -> None:
    """Give a sampler the octaves and the hidden layers of an embedded texture. A grain of the sampler's own stretches them.

    Raises BundleError if there is no such texture, TrainingError if it is of another size.
    """
    folder = open_bundle(embedded_folder(name)).folder
    if not (folder / TEXTURE).is_file():
        raise BundleError(f"sampler_start {name}: is a space; expected an embedded texture")
    texture = read_texture(folder / TEXTURE)
    wanted, found = sampler.noise_weights.shape, texture.noise_weights.shape
    if found != wanted:
        sizes = " and ".join(f"{bins * octaves} octaves, {width} units a layer" for bins, octaves, width in (found, wanted))
        raise TrainingError(f"sampler_start {name}: it and this training have {sizes}; expected the same, or no start")
    first, *others = read_weights((folder / SAMPLER).read_bytes(), texture)
    unstretched = sampler.octave_scale[..., 2:]  # no grain runs along z
    sampler.directions.copy_(torch.from_numpy(texture.transforms * UNIT) / unstretched)
    sampler.noise_weights.copy_(torch.from_numpy(texture.noise_weights))
    below, *hidden = (layer for layer in sampler.hidden if isinstance(layer, Linear))
    below.bias.copy_(torch.tensor(first) - below.effective_weight() @ sampler.constant)
    for layer, weight, bias in zip(hidden, others[0:-2:2], others[1:-2:2], strict=True):
        layer.weight.copy_(torch.tensor(weight).T / layer.gain)
        layer.bias.copy_(torch.tensor(bias))
