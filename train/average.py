"""The moving average of a training's weights, which becomes the texture."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor


@torch.no_grad()
def follow(average: Iterable[Tensor], current: Iterable[Tensor], iteration: int, most: float) -> None:
    """Move an exponential moving average on, in place.

    Its memory grows with the training, to a ninth of the iterations so far, until it decays by `most`.
    """
    kept = min(most, (1 + iteration) / (10 + iteration))
    for mean, value in zip(average, current, strict=True):
        mean.lerp_(value, 1 - kept)
