"""The texture space (Sec. 3.2): an encoder E, the mapping from z to octaves and style, and the sampler that they condition."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from solidgrain.train.encoder import MOMENTS, Encoder
from solidgrain.train.layers import Linear, activate
from solidgrain.train.noise import Noise
from solidgrain.train.sampler import HIDDEN_LAYERS, Condition, make_sampler
from solidgrain.train.settings import Settings

MAPPED = 128  # hidden units of Q and of f, and length of the style w
START = 0.1  # of N(0,1), the weights of Q's and g's outputs: every texture starts close to the same one


class Mapping(nn.Module):
    """Q(z), f(z) and g_l(w): what tells one texture from another. Both outputs are relative to the sampler as it is.

    Q's output comes on top of the sampler's own T_i, its bias in effect, so that octaves start orthogonal and within their
    band as those of a single exemplar do; g_l's scale comes on top of one.
    """

    def __init__(self, settings: Settings, generator: torch.Generator) -> None:
        super().__init__()
        n, m = settings.octaves, settings.width
        self.octaves = nn.ModuleList([Linear(settings.latent, MAPPED, generator), _small(MAPPED, 9 * n, generator)])  # Q
        self.style = nn.ModuleList([Linear(settings.latent, MAPPED, generator), Linear(MAPPED, MAPPED, generator, gain=1.0)])
        self.affine = nn.ModuleList(_small(MAPPED, 2 * m, generator) for _ in range(HIDDEN_LAYERS))  # g_l

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """z [B, latent] -> changes of the directions [B, n, 3, 3], gamma and delta [B, hidden layers, m]."""
        directions = self.octaves[1](activate(self.octaves[0](z))).reshape(len(z), -1, 3, 3)
        w = self.style[1](activate(self.style[0](z)))
        scale, shift = torch.stack([affine(w) for affine in self.affine], 1).chunk(2, -1)
        return directions, 1 + scale, shift


class Space(nn.Module):
    """E, Q, f, g_l and S: photographs in, colours of their solids out."""

    def __init__(self, settings: Settings, generator: torch.Generator) -> None:
        super().__init__()
        self.sampler = make_sampler(settings, generator)
        self.encoder = Encoder(settings, generator)
        self.mapping = Mapping(settings, generator)

    def condition(self, z: Tensor) -> Condition:
        """The textures of latent codes z [B, latent]. Never in bfloat16: octaves multiply whatever is lost here."""
        with torch.autocast(z.device.type, enabled=False):
            change, gamma, delta = self.mapping(z)
            if self.encoder.color_moments:
                gamma, delta = self._with_colors(gamma, delta, mean=z[:, -MOMENTS:-1], contrast=z[:, -1:])
            return Condition((self.sampler.directions + change) * self.sampler.octave_scale, gamma, delta)

    def _with_colors(self, gamma: Tensor, delta: Tensor, mean: Tensor, contrast: Tensor) -> tuple[Tensor, Tensor]:
        """The style whose colours are `mean + contrast * rgb`, where those of the style that is given are rgb.

        Only the last hidden layer's changes: W (c gamma x + c delta + V (mean + (c - 1) b)) + b, with W V = 1, the output
        layer's pseudoinverse.
        """
        axes, output = self.sampler.color_axes.to(gamma), self.sampler.output
        weight, bias = axes.T @ output.effective_weight(), output.bias @ axes
        inverse = weight.T @ torch.linalg.inv(weight @ weight.T)  # V [m, 3]
        shift = (mean + (contrast - 1) * bias) @ inverse.T
        last_gamma, last_delta = contrast * gamma[:, -1], contrast * delta[:, -1] + shift
        return (
            torch.cat([gamma[:, :-1], last_gamma[:, None]], 1),
            torch.cat([delta[:, :-1], last_delta[:, None]], 1),
        )

    def forward(self, noise: Noise, points: Tensor, patches: Tensor) -> Tensor:
        """Colour [B, P, 3] at points [B, P, 3] of the textures of patches [B, 3, 128, 128]."""
        rgb: Tensor = self.sampler(noise, points, self.condition(self.encoder(patches)))
        return rgb


def _small(inputs: int, outputs: int, generator: torch.Generator) -> Linear:
    """An output layer that says little at first."""
    layer = Linear(inputs, outputs, generator, gain=1.0)
    with torch.no_grad():
        layer.weight.mul_(START)
    return layer
