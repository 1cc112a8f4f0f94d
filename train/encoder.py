"""The encoder E: a patch of a photograph in, its latent code z out (Sec. 3.2; appendix, "architecture of encoder E")."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from solidgrain.train.layers import Conv, Linear, activate
from solidgrain.train.settings import Settings

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


MOMENTS = 4  # mean red, green and blue, and their deviation from it


class Encoder(nn.Module):
    """A CNN without any normalisation. Seven pools bring the 128² pixels that it expects down to one.

    With `color_moments` the last four numbers of z are not learned, they are the patch's `moments`: brightness and contrast of
    an unseen photograph are then right without having been guessed.
    """

    def __init__(self, settings: Settings, generator: torch.Generator) -> None:
        super().__init__()
        self.color_moments = settings.color_moments
        latent = settings.latent - (MOMENTS if settings.color_moments else 0)
        self.convolutions = nn.ModuleList(Conv(i, o, kernel, generator) for i, o, kernel in CONVOLUTIONS)
        self.dense = Linear(256, 256, generator)
        self.code = Linear(256, latent, generator, gain=1.0)

    def forward(self, patches: Tensor) -> Tensor:
        """patches [B, 3, 128, 128] in [0, 1] -> z [B, latent]."""
        x = patches
        for convolution in self.convolutions:
            x = F.avg_pool2d(activate(convolution(x)), 2)
        z: Tensor = self.code(activate(self.dense(x.flatten(1)))).to(patches)  # not in bfloat16
        return torch.cat([z, moments(patches)], 1) if self.color_moments else z


def moments(patches: Tensor) -> Tensor:
    """Mean colour and contrast of patches [B, 3, H, W]: [B, 4]. Contrast is the root mean square deviation of all channels."""
    mean = patches.mean((2, 3))
    contrast = (patches - mean[:, :, None, None]).square().mean((1, 2, 3)).sqrt()
    return torch.cat([mean, contrast[:, None]], 1)
