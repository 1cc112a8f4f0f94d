"""The encoder E: a patch of a photograph in, its latent code z out (Sec. 3.2; appendix, "architecture of encoder E")."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from solidgrain.train.layers import Conv, Linear, activate

# (inputs, outputs, kernel), each followed by a 2x2 average pool
CONVOLUTIONS = (
    (3, 32, 3),
    (32, 64, 3),
    (64, 128, 3),
    (128, 256, 3),
    (256, 256, 3),
    (256, 256, 3),
    (256, 256, 2),
)


class Encoder(nn.Module):
    """A CNN without any normalisation. Seven pools bring the 128² pixels that it expects down to one."""

    def __init__(self, latent: int, generator: torch.Generator) -> None:
        super().__init__()
        self.convolutions = nn.ModuleList(Conv(i, o, kernel, generator) for i, o, kernel in CONVOLUTIONS)
        self.dense = Linear(256, 256, generator)
        self.code = Linear(256, latent, generator, gain=1.0)

    def forward(self, patches: Tensor) -> Tensor:
        """patches [B, 3, 128, 128] in [0, 1] -> z [B, latent]."""
        x = patches
        for convolution in self.convolutions:
            x = F.avg_pool2d(activate(convolution(x)), 2)
        z: Tensor = self.code(activate(self.dense(x.flatten(1))))
        return z
