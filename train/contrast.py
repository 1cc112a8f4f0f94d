"""The contrast at which D sees a material: of faint colours its features say little, and L_style less.

Photographs and slices of one exemplar are stretched alike, about its mean colour, until the photograph deviates from it by a
given root mean square. Strong contrasts stay as they are. The paper shows D the colours themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from solidgrain.train.exemplar import FloatArray

FAINTEST = 1 / 255  # deviation of an exemplar that is all of one colour


class Stretch(NamedTuple):
    """What is done to the images [B, 3, H, W] of a batch, each on its own."""

    middle: Tensor  # mean colours [B, 3, 1, 1]
    gain: Tensor  # [B, 1, 1, 1]

    def __call__(self, images: Tensor) -> Tensor:
        return self.middle + self.gain * (images - self.middle)


def stretch_to(contrast: float, exemplar: FloatArray, device: torch.device) -> Stretch:
    """What brings an exemplar [H, W, 3] to a contrast; 0 for as it is."""
    if not contrast:
        return unstretched(device)
    pixels = torch.from_numpy(exemplar).reshape(-1, 3).double()
    middle = pixels.mean(0)
    deviation = max(FAINTEST, float((pixels - middle).square().mean().sqrt()))
    gain = torch.full((1, 1, 1, 1), max(1.0, contrast / deviation), device=device)
    return Stretch(middle.float().reshape(1, 3, 1, 1).to(device), gain)


def unstretched(device: torch.device) -> Stretch:
    """What leaves any exemplar as it is."""
    return Stretch(torch.zeros(1, 3, 1, 1, device=device), torch.ones(1, 1, 1, 1, device=device))


def together(stretches: Sequence[Stretch]) -> Stretch:
    """Those of a batch's exemplars, in order."""
    return Stretch(*(torch.cat(parts) for parts in zip(*stretches, strict=True)))
