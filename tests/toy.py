"""The toy sampler: tiny, random, made by code; it stands in for a trained one wherever only the plumbing matters."""

from __future__ import annotations

import numpy as np

from solidgrain.export.bundle import SamplerWeights


def toy_weights(octaves: int = 16, width: int = 32, seed: int = 5) -> SamplerWeights:
    """A random sampler of tiny width, with a style, whose colours stay well inside [0, 1]."""
    draw = np.random.default_rng(seed)

    def normal(*shape: int) -> np.ndarray:
        return draw.standard_normal(shape).astype(np.float32)

    layers = 5
    orthogonal = np.linalg.qr(draw.standard_normal((octaves, 3, 3)))[0]
    scale = 2.0 ** (7 * np.arange(octaves) / (octaves - 1)) / 64
    return SamplerWeights(
        weights=[normal(width, width) * np.float32(1.2 / width**0.5) for _ in range(layers - 1)]
        + [normal(width, 3) * np.float32(0.02)],
        biases=[normal(width) * np.float32(0.1) for _ in range(layers)] + [np.array([0.6, 0.5, 0.4], np.float32)],
        transforms=orthogonal * scale[:, None, None],
        noise_weights=normal(4, octaves // 4, width) * np.float32(0.5),
        gamma=1 + normal(layers, width) * np.float32(0.1),
        delta=normal(layers, width) * np.float32(0.1),
    )
