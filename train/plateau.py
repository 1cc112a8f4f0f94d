"""When a training gets no better, told by a critic that no longer learns.

Neither loss says so: both are measured by a D that moves. The embedded space's critic stands still. Every `EVERY` iterations it
looks at slices of the moving average, and their mean Gram matrices are compared with those of the exemplar's crops. The
distance falls as a training gets better, but not steadily: D and S chase each other, and on the way mean Gram matrices pass
near the exemplar's by chance, whatever the slices look like. So a running mean of it is watched: when that was not lower for
half as long as it took to get there, it is a plateau. The paper trains for a fixed number of iterations.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from solidgrain.train import exemplar
from solidgrain.train.companion import embedded_critic
from solidgrain.train.contrast import stretch_to
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.losses import gram_difference, mean_grams
from solidgrain.train.noise import draw_noise
from solidgrain.train.settings import FAST, Settings
from solidgrain.train.slices import as_images, draw_slices

EVERY = 25  # iterations
BATCHES = 8  # of slices, the same ones each time
MEMORY = 8  # looks, of the running mean
GAIN = 0.02  # by which it must undercut the lowest before it
SHARE = 0.5  # of the iterations until the lowest, that may pass without another
LEAST = 200  # of them in any case


@dataclass
class Plateau:
    """The running mean of the distance, and the lowest that it was; goes into the checkpoint."""

    lowest: float = math.inf
    at: int = 0  # iteration
    looked: int = 0  # the last time
    mean: float = 0.0
    seen: int = 0  # looks that follow each other

    def see(self, distance: float, iteration: int) -> None:
        if not self.seen or self._stale(iteration):
            self.seen, self.lowest = 0, math.inf
        self.seen, self.looked = self.seen + 1, iteration
        self.mean += (distance - self.mean) / min(self.seen, MEMORY)
        if self.mean < (1 - GAIN) * self.lowest:
            self.lowest, self.at = self.mean, iteration

    def reached(self, iteration: int) -> bool:
        waited = math.isfinite(self.lowest) and iteration - self.at >= max(LEAST, SHARE * self.at)
        return waited and not self._stale(iteration)

    def _stale(self, iteration: int) -> bool:
        """Whether a stretch of training has gone by without a look."""
        return iteration - self.looked > EVERY

    def state(self) -> dict[str, Any]:
        return asdict(self)


class Onlooker:
    """The critic that stands still, and what it has seen of the exemplar [H, W, 3]."""

    def __init__(self, settings: Settings, pixels: FloatArray, device: torch.device) -> None:
        self.settings, self.device = settings, device
        self.critic = embedded_critic(FAST.critic_start, device)
        self.stretch = stretch_to(FAST.critic_contrast, pixels, device)
        image, generator = torch.from_numpy(pixels).permute(2, 0, 1).to(device), self._stream()
        self.wanted = self._mean_grams([exemplar.draw_patches(image, settings, generator) for _ in range(2 * BATCHES)])

    @torch.no_grad()
    def distance(self, average: nn.Module) -> float:
        """The mean over layers of the relative difference of Gram matrices."""
        settings, generator, images = self.settings, self._stream(), []
        for _ in range(BATCHES):
            noise = draw_noise(settings.octaves, settings.resolution, generator)
            images.append(as_images(average(noise, draw_slices(settings, generator)), settings.patch))
        pairs = zip(self.wanted, self._mean_grams(images), strict=True)
        return float(torch.stack([gram_difference(wanted, found, relative=True) for wanted, found in pairs]).mean())

    @torch.no_grad()
    def _mean_grams(self, batches: list[Tensor]) -> list[Tensor]:
        return mean_grams(self.critic(self.stretch(images))[1] for images in batches)

    def _stream(self) -> torch.Generator:
        return torch.Generator(self.device).manual_seed(11)
