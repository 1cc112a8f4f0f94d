"""The critic D (appendix, "Network architecture of discriminator D")."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from solidgrain.train.layers import Conv, Linear, activate

# (inputs, outputs, kernel, followed by a 2x2 average pool)
CONVOLUTIONS = (
    (3, 32, 3, False),
    (32, 64, 3, True),
    (64, 64, 3, False),
    (64, 128, 3, True),
    (128, 128, 3, True),
    (128, 256, 3, True),
    (256, 256, 3, True),
    (256, 256, 3, True),
    (256, 256, 2, True),
)


class Critic(nn.Module):
    """A CNN without any normalisation. Its logit drives the Wasserstein loss, its activations the Gram loss.

    The mean over what is left of the image before the dense layers is the table's last pool at 128² pixels, and lets
    smaller and larger patches through as well.
    """

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        self.convolutions = nn.ModuleList(Conv(i, o, kernel, generator) for i, o, kernel, _ in CONVOLUTIONS)
        self.dense = Linear(256, 512, generator)
        self.logit = Linear(512, 1, generator, gain=1.0)

    def forward(self, images: Tensor) -> tuple[Tensor, list[Tensor]]:
        """images [B, 3, H, W] -> logits [B, 1], and the activations [B, C, h, w] of each convolution before its pool."""
        x, activations = images, []
        for convolution, (_, _, _, pooled) in zip(self.convolutions, CONVOLUTIONS, strict=True):
            x = activate(convolution(x))
            activations.append(x)
            if pooled and x.shape[-1] > 1:
                x = F.avg_pool2d(x, 2)
        x = activate(self.dense(x.mean((2, 3))))
        return self.logit(x), activations
