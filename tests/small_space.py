"""A space without training: a tiny random encoder and mapping around the toy sampler."""

from __future__ import annotations

import numpy as np

from solidgrain.export.bundle import SpaceWeights
from solidgrain.export.space_graphs import EncoderWeights, MappingWeights
from tests.toy import toy_weights

PATCH, LATENT = 8, 4


def small_space_weights(octaves: int = 16, width: int = 32, seed: int = 5) -> SpaceWeights:
    """Codes of different pictures are some units apart; a unit turns transforms by a tenth and changes every style."""
    toy, draw = toy_weights(octaves, width, seed), np.random.default_rng(seed + 1)

    def normal(*shape: int) -> np.ndarray:
        return draw.standard_normal(shape).astype(np.float32)

    largest = np.abs(toy.transforms).max((1, 2), keepdims=True).repeat(9).astype(np.float32)
    turned = (normal(16, 9 * octaves) * np.float32(0.05) * largest, toy.transforms.reshape(-1).astype(np.float32))
    one = np.repeat(np.array([1, 0], np.float32), width)
    return SpaceWeights(
        weights=toy.weights,
        biases=toy.biases,
        encoder=EncoderWeights([], [(normal(3 * PATCH**2, LATENT), normal(LATENT))], PATCH),
        mapping=MappingWeights(
            octaves=[(normal(LATENT, 16), normal(16)), turned],
            style=[(normal(LATENT, 16), normal(16)), (normal(16, 16), normal(16))],
            affine=[(normal(16, 2 * width) * np.float32(0.02), one) for _ in toy.biases[:-1]],
            noise_weights=toy.noise_weights,
        ),
    )
