"""The toy space: a random encoder, mapping and sampler, and the critic that adapting needs, made by code.

It says nothing of photographs but is one in all other respects: 16 octaves, 128 units, patches of 128² pixels, 32 numbers.
"""

from __future__ import annotations

import importlib.util
import itertools
from pathlib import Path

import numpy as np

from solidgrain.export.bundle import Details, SpaceWeights, write_bundle
from solidgrain.export.space_graphs import EncoderWeights, Layer, MappingWeights
from solidgrain.runtime.bundle import CRITIC, SAMPLER, file_sha256
from solidgrain.train.settings import preset, to_json
from tests.toy import toy_weights

OCTAVES, WIDTH, LATENT = 16, 128, 32
CHANNELS = (3, 8, 8, 16, 16, 16, 16, 16)  # of the encoder; seven pools bring 128² pixels down to one


def toy_space_weights(seed: int = 5) -> SpaceWeights:
    toy, draw = toy_weights(OCTAVES, WIDTH, seed), np.random.default_rng(seed + 1)

    def layer(*shape: int, fan_in: int, gain: float = 1.4) -> np.ndarray:
        return (gain / fan_in**0.5 * draw.standard_normal(shape)).astype(np.float32)

    def dense(inputs: int, outputs: int, gain: float = 1.4) -> Layer:
        return layer(inputs, outputs, fan_in=inputs, gain=gain), layer(outputs, fan_in=1, gain=0.1)

    def convolution(inputs: int, outputs: int) -> Layer:
        return layer(outputs, inputs, 3, 3, fan_in=9 * inputs), layer(outputs, fan_in=1, gain=0.1)

    sizes = np.abs(toy.transforms).max((1, 2)).repeat(9).astype(np.float32)
    turned = (dense(WIDTH, 9 * OCTAVES, gain=0.02)[0] * sizes, toy.transforms.reshape(-1).astype(np.float32))
    one = np.repeat(np.array([1, 0], np.float32), WIDTH)
    convolutions = [convolution(inputs, outputs) for inputs, outputs in itertools.pairwise(CHANNELS)]
    return SpaceWeights(
        weights=toy.weights,
        biases=toy.biases,
        encoder=EncoderWeights(convolutions, [dense(CHANNELS[-1], 64), dense(64, LATENT, gain=6)], patch=128),
        mapping=MappingWeights(
            octaves=[dense(LATENT, WIDTH), turned],
            style=[dense(LATENT, WIDTH), dense(WIDTH, WIDTH)],
            affine=[(dense(WIDTH, 2 * WIDTH, gain=0.05)[0], one) for _ in toy.biases[:-1]],
            noise_weights=toy.noise_weights,
        ),
    )


def write_toy_space(folder: Path, seed: int = 5) -> Path:
    """The bundle; its critic comes with it where there is torch to make one."""
    settings = preset("fast space", octaves=OCTAVES)
    training = {"exemplars": [], "held_out": [], "iterations": 0, "minutes": 0.0, "settings": to_json(settings)}
    write_bundle(folder, toy_space_weights(seed), Details(name=folder.name, patch=settings.patch, training=training))
    if importlib.util.find_spec("torch") is not None:
        write_toy_critic(folder / CRITIC, file_sha256(folder / SAMPLER))
    return folder


def write_toy_critic(path: Path, sampler_sha256: str) -> None:
    import torch

    from solidgrain.export.companion import write_companion
    from solidgrain.train.critic import Critic

    critic = Critic(torch.Generator().manual_seed(0)).state_dict()
    write_companion(path, critic, preset("fast space"), sampler_sha256)
