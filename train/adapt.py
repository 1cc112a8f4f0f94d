"""Adapting a texture of a space to a photograph that the space was not trained on (Sec. 3.3).

From what E and Q predict of the photograph, L_style alone is minimised over theta = (T_i, gamma_l, delta_l, A_l), all that
this texture owns, on random slices of fresh noise. D and what S shares with the space's other textures are fixed. Departures
from the paper, and what they gain, are in docs/training.md.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from solidgrain.runtime.bundle import SAMPLER, Bundle
from solidgrain.runtime.errors import BundleError, ExemplarError, TrainingError
from solidgrain.runtime.fold import read_weights
from solidgrain.runtime.texture_file import TextureData
from solidgrain.train.average import follow
from solidgrain.train.collection import Member, draw_patches, in_levels, wraps
from solidgrain.train.companion import Companion
from solidgrain.train.contrast import stretch_to
from solidgrain.train.layers import activate
from solidgrain.train.losses import gram_difference, mean_gram, mean_grams
from solidgrain.train.noise import Noise, draw_noise, look_up
from solidgrain.train.precision import autocast, use_bfloat16
from solidgrain.train.settings import Budget, Settings
from solidgrain.train.slices import UNIT, as_images, draw_slices
from solidgrain.train.streams import MEASURE, stream
from solidgrain.train.vgg import Vgg

FloatArray = npt.NDArray[np.float32]

ITERATIONS, SECONDS = 600, 120.0  # whichever comes first, where no flag says otherwise


@dataclass(frozen=True)
class Recipe:
    """How theta is moved. Rates are Adam's, at the start."""

    octave_rate: float = 1e-2  # of T_i, relative to its size
    style_rate: float = 3e-3  # of gamma_l and delta_l
    noise_rate: float = 3e-3  # of A_l
    warm_up: int = 10  # iterations until rates are whole: Adam's first steps are as long as its others, in no sure direction
    constant: float = 2 / 3  # share of the budget after which rates begin to fall, to a tenth
    average_decay: float = 0.98  # of the moving average that becomes the texture
    noise_kept: int = 8  # iterations that share noise tables, each with offsets of its own
    crops: int = 128  # of the photograph, whose mean Gram matrices are aimed at
    measured: int = 8  # batches, of L_style as it is reported
    memory: int = 30  # iterations, of the running mean of L_style
    patience: int = 150  # iterations without a new low of that mean: a plateau
    gain: float = 0.01  # by which a low must undercut the last one
    limit: float = 10.0  # times its first value that the mean may reach


DEFAULT = Recipe()


@dataclass(frozen=True)
class Report:
    """How far an adaptation has come."""

    iteration: int
    seconds: float
    style: float  # running mean of L_style


@dataclass(frozen=True)
class Adapted:
    """What came of it."""

    texture: TextureData
    start: float  # L_style of what E and Q predicted
    end: float  # of the texture, on the same slices
    iterations: int
    seconds: float
    ended: str  # why: "budget", "plateau", "stopped" or "diverged"


class Features(NamedTuple):
    """F of L_style."""

    activations: Callable[[Tensor], Sequence[Tensor]]  # images [B, 3, H, W] -> [B, C, h, w] of each layer
    relative: bool  # whether each layer's term is divided by the mean absolute entry of the photograph's Gram matrix
    contrast: float = 0.0  # to which it sees faint photographs stretched


class Theta(NamedTuple):
    """What one texture owns."""

    directions: Tensor  # [n, 3, 3], T_i over its size at the start, so that one rate suits all octaves
    gamma: Tensor  # [hidden layers, m]
    delta: Tensor  # [hidden layers, m]
    noise_weights: Tensor  # A [4, n/4, m]

    def copy(self) -> Theta:
        return Theta(*(part.detach().clone() for part in self))


class FrozenSampler:
    """S with the weights that all textures of a bundle share; what a texture owns is an argument."""

    def __init__(self, bundle: Bundle, texture: TextureData, device: torch.device) -> None:
        try:
            weights = read_weights((bundle.folder / SAMPLER).read_bytes(), texture)
        except ValueError as error:
            raise BundleError(f"{bundle.folder / SAMPLER}: cannot be adapted to: {error}") from error
        self.first, *rest = (torch.tensor(weight, device=device) for weight in weights)  # b_0 + W_0 constant
        self.layers = list(zip(rest[::2], rest[1::2], strict=True))  # W_l [m, m] for x W, b_l [m]

    def __call__(self, noise: Tensor, theta: Theta) -> Tensor:
        """noise [B, P, n] -> colour [B, P, 3], not clipped: Eq. 5, gamma and delta folded into the layer that follows.

        The last layer is float32 in any case: in bfloat16 a bright colour has steps of 1/256, as large as a faint material's
        contrast.
        """
        bins = noise.chunk(len(theta.noise_weights), dim=-1)  # (B, P, n / 4) each
        y = self.first + bins[0] @ theta.noise_weights[0]
        for layer in range(len(self.layers) - 1):
            y = F.linear(activate(y), *self._folded(layer, theta))
            if layer + 1 < len(bins):
                y = y + bins[layer + 1] @ theta.noise_weights[layer + 1]
        with torch.autocast(y.device.type, enabled=False):
            weight, bias = self._folded(-1, theta)
            return F.linear(activate(y).to(weight), weight, bias)

    def _folded(self, layer: int, theta: Theta) -> tuple[Tensor, Tensor]:
        """W' and b' of W (gamma x + delta) + b = W' x + b', float32 or wider."""
        weight, bias = self.layers[layer]
        with torch.autocast(weight.device.type, enabled=False):
            return (theta.gamma[layer, :, None] * weight).T, theta.delta[layer] @ weight + bias


def critic_features(companion: Companion, device: torch.device) -> Features:
    """F of L_style as in the paper: the activations of the space's own D, compared as they were in its training."""
    critic = companion.critic.to(device=device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    settings = companion.settings
    return Features(lambda images: critic(images)[1], settings.relative_gram, settings.critic_contrast)


def vgg_features(device: torch.device) -> Features:
    """What the paper compares it with: activations of a pretrained VGG. Raises SolidgrainError without its weights."""
    return Features(Vgg(device).style, relative=True)


class Adaptation:
    """The state of an adaptation: theta, its moving average, the optimiser, one random stream. `adapt` drives it."""

    def __init__(
        self,
        start: TextureData,
        sampler: FrozenSampler,
        photograph: FloatArray,
        features: Features,
        settings: Settings,
        recipe: Recipe,
        device: torch.device,
    ) -> None:
        self.start, self.sampler, self.features, self.recipe = start, sampler, features, recipe
        self.settings = replace(settings, octaves=len(start.transforms))
        self.reduced_precision = use_bfloat16(settings, device)
        self.generator = stream(device, settings.seed)
        self.sizes = np.linalg.norm(start.transforms, axis=(1, 2), keepdims=True) / math.sqrt(3)  # [n, 1, 1]
        self.octave_scale = torch.tensor(self.sizes * UNIT, dtype=torch.float32, device=device)
        owned = (start.transforms / self.sizes, start.gamma, start.delta, start.noise_weights)
        self.theta = Theta(*(torch.tensor(part, dtype=torch.float32, device=device, requires_grad=True) for part in owned))
        self.average, self.iteration = self.theta.copy(), 0
        rates = (recipe.octave_rate, recipe.style_rate, recipe.style_rate, recipe.noise_rate)
        groups = [{"params": [part], "lr": rate, "start": rate} for part, rate in zip(self.theta, rates, strict=True)]
        self.optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99))
        self.stretch = stretch_to(features.contrast, photograph, device)
        self.target = self._mean_grams(photograph)

    def step(self, pace: float) -> float:
        """One iteration at so much of the rates. L_style before it."""
        if self.iteration % self.recipe.noise_kept == 0:
            self.noise = draw_noise(self.settings.octaves, self.settings.resolution, self.generator)
        loss = self._style(self.theta, self.noise, self.generator)
        self.optimiser.zero_grad()
        torch.autograd.backward(loss)
        pace *= min((self.iteration + 1) / self.recipe.warm_up, 1.0)
        for group in self.optimiser.param_groups:
            group["lr"] = pace * group["start"]
        self.optimiser.step()
        follow(self.average, self.theta, self.iteration, self.recipe.average_decay)
        self.iteration += 1
        return float(loss.detach())

    def _style(self, theta: Theta, noise: Noise, generator: torch.Generator) -> Tensor:
        """L_style of random slices."""
        settings = self.settings
        points = draw_slices(settings, generator)
        eta = look_up(noise.moved(generator), theta.directions * self.octave_scale, points)
        # coordinates stay outside it: in bfloat16 they are wrong by texels
        with autocast(self.generator.device, self.reduced_precision):
            rgb = self.sampler(eta, theta)
            activations = self.features.activations(self.stretch(as_images(rgb.float(), settings.patch)))
        pairs = zip(self.target, activations, strict=True)
        terms = [gram_difference(wanted, mean_gram(of_layer), self.features.relative) for wanted, of_layer in pairs]
        return torch.stack(terms).mean()

    @torch.no_grad()
    def _mean_grams(self, photograph: FloatArray) -> list[Tensor]:
        """What L_style compares with: since F is fixed, crops of the photograph need to be looked at only once."""
        member = Member("", in_levels(photograph), wraps(photograph))
        height, width = photograph.shape[:2]
        if min(height, width) < self.settings.patch:
            raise ExemplarError(
                f"{width}x{height} pixels to adapt to: expected at least {self.settings.patch} along each side, as many as a "
                "patch of this space's training has; leave --crop out, lower --patch-scale, or give a larger photograph"
            )

        def look() -> Sequence[Tensor]:
            crops = draw_patches(member, self.settings.patch, self.settings.batch, self.settings, self.generator)
            with autocast(self.generator.device, self.reduced_precision):
                return self.features.activations(self.stretch(crops))

        return mean_grams(look() for _ in range(math.ceil(self.recipe.crops / self.settings.batch)))

    @torch.no_grad()
    def measure(self, theta: Theta) -> float:
        """L_style over many slices, the same ones whenever it is called."""
        generator = stream(self.generator.device, self.settings.seed, MEASURE)
        noise = draw_noise(self.settings.octaves, self.settings.resolution, generator)
        return float(torch.stack([self._style(theta, noise, generator) for _ in range(self.recipe.measured)]).mean())

    def texture(self, theta: Theta) -> TextureData:
        directions, gamma, delta, noise_weights = (part.detach().cpu().numpy() for part in theta)
        transforms = directions.astype(np.float64) * self.sizes
        return replace(self.start, transforms=transforms, gamma=gamma, delta=delta, noise_weights=noise_weights)


@dataclass
class Descent:
    """The running mean of L_style, and theta's average when it was at its lowest."""

    recipe: Recipe
    best: Theta
    mean: float = 0.0
    first: float = math.nan  # value of it over a whole memory
    lowest: float = math.inf
    seen: int = 0
    waited: int = 0  # iterations since the last low

    def see(self, style: float, average: Theta) -> None:
        self.seen, self.waited = self.seen + 1, self.waited + 1
        self.mean += (style - self.mean) / min(self.seen, self.recipe.memory)
        full = self.seen == self.recipe.memory
        if full:
            self.first = self.mean
        if full or self.mean < (1 - self.recipe.gain) * self.lowest:  # lows of a few are a matter of luck, and do not stand
            self.lowest, self.best, self.waited = self.mean, average.copy(), 0

    @property
    def diverged(self) -> bool:
        return not math.isfinite(self.mean) or self.mean > self.recipe.limit * self.first

    @property
    def plateau(self) -> bool:
        return self.waited >= self.recipe.patience


@dataclass
class Pace:
    """So much of the rates: all of them at first, then falling to a tenth, from two thirds of the budget or a plateau on.

    Falling takes half as long as it took to get there.
    """

    falls_from: float  # share of the budget

    def at(self, share: float) -> float:
        return 1 - 0.9 * min(max(share - self.falls_from, 0.0) / max(self.ends_at - self.falls_from, 1e-9), 1.0)

    @property
    def ends_at(self) -> float:
        return min(1.5 * self.falls_from, 1.0)


def adapt(
    start: TextureData,
    sampler: FrozenSampler,
    photograph: FloatArray,
    features: Features,
    settings: Settings,
    budget: Budget,
    device: torch.device,
    recipe: Recipe = DEFAULT,
    on_report: Callable[[Report], None] = lambda report: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Adapted:
    """Adapt a texture to a photograph [H, W, 3] until the budget is spent, L_style stops falling, or `should_stop` says so.

    The texture is the moving average of theta, or, if that has the lower L_style, the average at the lowest running mean: so
    an adaptation that diverges ends with the best that it had. It is never worse by L_style than `start`, which may be what
    comes back. Raises TrainingError if L_style of that is not a number.
    """
    began = time.monotonic()
    state = Adaptation(start, sampler, photograph, features, settings, recipe, device)
    descent, pace, ended, share = Descent(recipe, state.average.copy()), Pace(recipe.constant), "budget", 0.0
    unadapted, measuring = state.average.copy(), time.monotonic()
    first = state.measure(unadapted)
    reserved = 2 * (time.monotonic() - measuring)  # for the two thetas that are measured at the end
    if not math.isfinite(first):
        raise TrainingError(f"texture {start.name!r}: its L_style is not a number; the critic or the bundle is damaged")
    while share < pace.ends_at:
        if should_stop():
            ended = "stopped"
            break
        descent.see(state.step(pace.at(share)), state.average)
        if descent.diverged:
            ended = "diverged"
            break
        seconds = time.monotonic() - began
        share = budget.progress(state.iteration, seconds + reserved)
        if descent.plateau and share < pace.falls_from:
            pace, ended = Pace(share), "plateau"
        on_report(Report(state.iteration, seconds, descent.mean))
    found = [(first, unadapted), *((state.measure(theta), theta) for theta in (descent.best, state.average))]
    end, theta = min((pair for pair in found if math.isfinite(pair[0])), key=lambda pair: pair[0])
    return Adapted(state.texture(theta), first, end, state.iteration, time.monotonic() - began, ended)
