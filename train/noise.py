"""The noise octaves of Eq. 1: eta_i(c) = table_i(T_i c), looked up trilinearly in a periodic table."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from solidgrain.runtime.noise import noise_offsets, noise_tables


class Noise(NamedTuple):
    """An instance of the noise."""

    tables: Tensor  # [n, R + 1, R + 1, R + 1] standard normal, indexed (x, y, z); the last along each axis are the first again
    offsets: Tensor  # [n, 3] texels, added to T_i p

    @property
    def resolution(self) -> int:
        """Texels R after which the tables repeat."""
        return self.tables.shape[-1] - 1

    def moved(self, generator: torch.Generator) -> Noise:
        """Another instance made of the same numbers: each table is read elsewhere.

        A slice meets a small part of a table, so that this is as good as fresh numbers, which take long to draw.
        """
        shape = self.offsets.shape
        return self._replace(offsets=self.resolution * torch.rand(shape, generator=generator, device=generator.device))


def draw_noise(octaves: int, resolution: int, generator: torch.Generator) -> Noise:
    """A fresh instance."""
    device = generator.device
    tables = torch.randn(octaves, resolution, resolution, resolution, generator=generator, device=device)
    return Noise(_wrapped(tables), torch.zeros(octaves, 3, device=device))


def runtime_noise(seed: int, octaves: int, points: Tensor) -> Noise:
    """The instance that the runtime has for a seed, on the device of some points and as exact as they are."""
    tables, offsets = torch.from_numpy(noise_tables(seed, octaves)), torch.from_numpy(noise_offsets(seed, octaves))
    return Noise(_wrapped(tables.to(points)), offsets.to(points))


def _wrapped(tables: Tensor) -> Tensor:
    """Tables [n, R, R, R] with their first texels behind their last ones, so that no cell is cut in two."""
    return F.pad(tables[None], (0, 1, 0, 1, 0, 1), mode="circular")[0]


def look_up(noise: Noise, transforms: Tensor, points: Tensor) -> Tensor:
    """Noise values at points.

    transforms [n, 3, 3], or [B, n, 3, 3] where each image has its own; points [B, P, 3] -> [B, P, n] float32, or float64
    where all of them are. Differentiable in `transforms`; the tables get no gradient.

    Never narrower: under autocast the product T p would silently run in bfloat16 and be wrong by whole texels, which
    costs more quality than any other mistake that we know of.
    """
    resolution = noise.resolution
    with torch.autocast(points.device.type, enabled=False):
        located = torch.einsum("nij,bpj->nbpi" if transforms.dim() == 3 else "bnij,bpj->nbpi", transforms, points)
        located = located + noise.offsets[:, None, None]
        located = located - torch.floor(located.detach() / resolution) * resolution  # into [0, R): the tables repeat
        grid = (located / (resolution / 2) - 1).flip(-1)  # grid_sample wants (last axis, ..., first axis) in [-1, 1]
        values = F.grid_sample(noise.tables[:, None], grid[:, None], mode="bilinear", align_corners=True)
        return values[:, 0, 0].permute(1, 2, 0)
