"""How probable the patches of one picture are among those of another: average log-likelihoods with Parzen windows.

GramGAN's second measure of a texture space, ALL (Sec. 4, Table 2), after Breuleux, Bengio and Vincent 2010: a generator that
makes artefacts makes patches that are unlike any of the truth, and is punished for every one of them. The density of
k x k patches, as vectors x of d = 3 k² numbers, is that of a Gaussian kernel around each of N patches x_i of the truth:

    p(x) = 1/N sum_i N(x; x_i, sigma² I)

Colours and the bandwidth sigma are in levels of 0..255, log-likelihoods in nats per patch. The paper names neither: with k from
3 to 5, the figures are of the size of its own. A likelihood says nothing by itself, and everything beside another of the
same k, sigma and N.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

LEVELS = 255.0
BANDWIDTHS = tuple(2.0 ** (step / 2) for step in range(14))  # 1 to 90 levels
BLOCK = 1 << 20  # distances held at a time


def take_patches(image: Tensor, kernel: int, count: int, generator: torch.Generator) -> Tensor:
    """Random kernel x kernel patches of an image [1, 3, H, W] in [0, 1], in levels: [count, 3 kernel²].

    No place is taken twice; where there are fewer places than `count`, there is one patch for each.
    """
    vectors = F.unfold(image, kernel)[0].T
    chosen = torch.randperm(len(vectors), generator=generator)[:count]
    return vectors[chosen] * LEVELS


def log_likelihoods(patches: Tensor, truth: Tensor, bandwidths: Sequence[float]) -> Tensor:
    """log p of patches [M, d] under the truth's [N, d], for each of S bandwidths: [S, M] float64."""
    centre = truth.double().mean(0)  # small vectors have exact squares
    samples, kernels = patches.double() - centre, truth.double() - centre
    blocks = torch.split(samples, max(1, BLOCK // len(kernels)))
    return torch.cat([_log_density(block, kernels, bandwidths) for block in blocks], 1)


def _log_density(samples: Tensor, kernels: Tensor, bandwidths: Sequence[float]) -> Tensor:
    """As `log_likelihoods`, of vectors that were centred. Only what is left of a distance above the least is exponentiated,

    and float32 is enough for that: the nearest kernel's share is 1.
    """
    count, dimensions = kernels.shape
    squared = (samples**2).sum(1, keepdim=True) + (kernels**2).sum(1) - 2 * samples @ kernels.T  # (M, N)
    least = squared.amin(1).clamp(min=0)
    above = (squared - least[:, None]).clamp(min=0).float()
    rows = []
    for sigma in bandwidths:
        others = (above * (-0.5 / sigma**2)).exp().sum(1).double().log()
        rows.append(others - 0.5 * least / sigma**2 - math.log(count) - dimensions * math.log(sigma * math.sqrt(2 * math.pi)))
    return torch.stack(rows)
