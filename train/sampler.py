"""The sampler S: noise octaves in, colour out (Sec. 3.1, Eq. 1 and 2; conditioned on a texture, Sec. 3.2, Eq. 5)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from solidgrain.train.contrast import FAINTEST
from solidgrain.train.layers import Linear, activate
from solidgrain.train.noise import Noise, look_up
from solidgrain.train.settings import Settings

HIDDEN_LAYERS = 5
NARROWEST = 0.02  # of the largest deviation of an exemplar's colours, the least that is told apart along any axis
COLORS = ("color_mean", "color_axes")  # of a sampler's state, what its output is relative to
BINS = 4  # consecutive bins of octaves; bin l enters hidden layer l, the last hidden layer gets none


class Condition(NamedTuple):
    """What makes one sampler many textures: octaves and style of each image of a batch (Eq. 5)."""

    transforms: Tensor  # [B, n, 3, 3], on coordinates in units of 64 pixels
    gamma: Tensor  # [B, hidden layers, m]
    delta: Tensor  # [B, hidden layers, m]

    def styled(self, layer: int, x: Tensor) -> Tensor:
        """y = gamma phi(...) + delta of a hidden layer, x [B, P, m] its activations."""
        return self.gamma[:, layer, None].to(x.dtype) * x + self.delta[:, layer, None].to(x.dtype)


class Octaves(nn.Module):
    """The transformation model: noise at a point through learned T_i (Eq. 1). What every sampler begins with."""

    octave_scale: Tensor
    color_mean: Tensor
    color_axes: Tensor

    def __init__(self, settings: Settings, generator: torch.Generator) -> None:
        super().__init__()
        self.register_buffer("color_mean", torch.zeros(3, device=generator.device))
        self.register_buffer("color_axes", torch.eye(3, device=generator.device))
        self.register_load_state_dict_pre_hook(_keep_own_colors)  # type: ignore[no-untyped-call]
        self.directions = nn.Parameter(_start_directions(settings, generator))  # [n, 3, 3]
        self.register_buffer("octave_scale", _octave_scale(settings).to(generator.device))  # [n, 1, 3]

    def transforms(self) -> Tensor:
        """T_i [n, 3, 3], on coordinates in units of 64 pixels."""
        return self.directions * self.octave_scale

    def take_colors(self, mean: Tensor, covariance: Tensor) -> None:
        """Let the output layer's axes be the principal ones of colours with this mean [3] and covariance [3, 3].

        Its three numbers are then deviations from the mean colour, in standard deviations along each axis: whatever the network
        says at first has the material's hues. In plain RGB it has all hues, and unlearning them takes most of a training.
        Axes are part of the state: an eigenvector's sign, or which of equal ones come, is up to the machine.
        """
        variances, axes = torch.linalg.eigh(covariance.double())
        deviations = variances.clamp(min=0).sqrt()
        deviations = deviations.clamp(min=NARROWEST * max(float(deviations.max()), FAINTEST))
        self.color_mean = mean.float()
        self.color_axes = (deviations[:, None] * axes.T).float()

    def colored(self, output: Linear, x: Tensor) -> Tensor:
        """The last hidden layer's activations [..., m] as rgb, through the output layer and along the colours' axes.

        Float32 or wider: in bfloat16 a bright colour has steps of 1/256, as large as a faint material's contrast.
        """
        exact = x if x.dtype == torch.float64 else x.float()
        with torch.autocast(exact.device.type, enabled=False):
            rgb: Tensor = self.color_mean.to(exact) + output(exact) @ self.color_axes.to(exact)
        return rgb

    def eta(self, noise: Noise, points: Tensor, transforms: Tensor | None = None) -> Tensor:
        """eta(c): points [B, P, 3] -> [B, P, n], through `transforms` in place of its own if given."""
        return look_up(noise, self.transforms() if transforms is None else transforms, points)


class Sampler(Octaves):
    """An MLP on a learned constant, with a quarter of the octaves injected into each of its first four hidden layers."""

    def __init__(self, settings: Settings, generator: torch.Generator) -> None:
        super().__init__(settings, generator)
        n, m = settings.octaves, settings.width
        self.constant = nn.Parameter(torch.ones(m, device=generator.device))
        self.hidden = nn.ModuleList(Linear(m, m, generator) for _ in range(HIDDEN_LAYERS))
        # A of Eq. 2, transposed
        self.noise_weights = nn.Parameter(torch.randn(BINS, n // BINS, m, generator=generator, device=generator.device))
        self.output = Linear(m, 3, generator, gain=1.0)

    def forward(self, noise: Noise, points: Tensor, condition: Condition | None = None) -> Tensor:
        """Colour at points [B, P, 3] -> rgb [B, P, 3], not clipped to [0, 1].

        Without a condition it is its own texture: its own T_i, no scale and no shift.
        """
        eta = self.eta(noise, points, condition and condition.transforms)
        bins = eta.chunk(BINS, dim=-1)  # (B, P, n / 4) each
        x: Tensor = self.constant
        for layer, dense in enumerate(self.hidden):
            y: Tensor = dense(x)
            if layer < BINS:
                y = y + bins[layer] @ self.noise_weights[layer]  # psi(eta) = A eta
            x = activate(y)
            if condition is not None:
                x = condition.styled(layer, x)
        return self.colored(self.output, x)


class NoiseAtInputSampler(Octaves):
    """The baseline of Fig. 2 a: a plain MLP of the same size on the noise vector. Bundles cannot hold it."""

    def __init__(self, settings: Settings, generator: torch.Generator) -> None:
        super().__init__(settings, generator)
        n, m = settings.octaves, settings.width
        self.hidden = nn.ModuleList(Linear(n if layer == 0 else m, m, generator) for layer in range(HIDDEN_LAYERS))
        self.output = Linear(m, 3, generator, gain=1.0)

    def forward(self, noise: Noise, points: Tensor, condition: Condition | None = None) -> Tensor:
        """As `Sampler.forward`."""
        x = self.eta(noise, points, condition and condition.transforms)
        for layer, dense in enumerate(self.hidden):
            x = activate(dense(x))
            if condition is not None:
                x = condition.styled(layer, x)
        return self.colored(self.output, x)


def make_sampler(settings: Settings, generator: torch.Generator) -> Sampler | NoiseAtInputSampler:
    """The sampler that the settings ask for."""
    return NoiseAtInputSampler(settings, generator) if settings.noise_at_input else Sampler(settings, generator)


def _keep_own_colors(sampler: nn.Module, state: dict[str, Tensor], prefix: str, *_: object) -> None:
    """States of earlier versions have no colours: they computed them from the exemplar whenever they were read."""
    for name in COLORS:
        state.setdefault(prefix + name, getattr(sampler, name))


def _octave_scale(settings: Settings) -> Tensor:
    """2^(span i / (n - 1)), times the start of the grain: structures are longer along the axis that slices turn about."""
    exponents = torch.arange(settings.octaves) * settings.octave_span / (settings.octaves - 1)
    stretch = torch.ones(3)
    if settings.grain != "none":
        stretch["xy".index(settings.grain)] = settings.grain_ratio
    return (2.0**exponents)[:, None, None] * stretch  # scales the columns: T diag(stretch)


def _start_directions(settings: Settings, generator: torch.Generator) -> Tensor:
    """N(0,1)^{3x3} as in the paper, or random orthogonal matrices.

    Gaussian matrices shear most octaves into streaks that training has to unlearn at the pace of the learning rate;
    orthogonal ones start isotropic.
    """
    gaussian = torch.randn(settings.octaves, 3, 3, generator=generator, device=generator.device)
    if not settings.orthogonal_start:
        return gaussian
    orthogonal: Tensor = torch.linalg.qr(gaussian)[0]
    return orthogonal
