"""The noise octaves of Eq. 1: eta_i(c) = table_i(T_i c), looked up trilinearly in a periodic table."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def look_up(tables: Tensor, transforms: Tensor, points: Tensor, offsets: Tensor | None = None) -> Tensor:
    """Noise values at points.

    tables [n, R, R, R] standard normal, indexed (x, y, z); transforms [n, 3, 3], or [B, n, 3, 3] where each image has its
    own; points [B, P, 3]; offsets [n, 3] texels, added to T_i p -> [B, P, n] float32.
    Differentiable in `transforms`; the tables get no gradient.

    Always float32: under autocast the product T p would silently run in bfloat16 and be wrong by whole texels, which
    costs more quality than any other mistake that we know of.
    """
    resolution = tables.shape[-1]
    with torch.autocast(points.device.type, enabled=False):
        located = torch.einsum("nij,bpj->nbpi" if transforms.dim() == 3 else "bnij,bpj->nbpi", transforms, points)
        if offsets is not None:
            located = located + offsets[:, None, None]
        located = located - torch.floor(located.detach() / resolution) * resolution  # into [0, R): the tables repeat
        wrapped = F.pad(tables[None], (0, 1, 0, 1, 0, 1), mode="circular")[0]  # [n, R+1, R+1, R+1]
        grid = (located / (resolution / 2) - 1).flip(-1)  # grid_sample wants (last axis, ..., first axis) in [-1, 1]
        values = F.grid_sample(wrapped[:, None], grid[:, None], mode="bilinear", align_corners=True)
        return values[:, 0, 0].permute(1, 2, 0)


def draw_tables(octaves: int, resolution: int, generator: torch.Generator) -> Tensor:
    """A fresh noise instance [n, R, R, R]."""
    return torch.randn(octaves, resolution, resolution, resolution, generator=generator, device=generator.device)


def shift_tables(tables: Tensor, generator: torch.Generator) -> Tensor:
    """Another instance made of the same numbers: each table [R, R, R] of [n, R, R, R] moved around by whole texels at random.

    A slice meets a small part of a table, so that this is as good as fresh numbers, which take ten times as long to draw.
    """
    shifts = torch.randint(tables.shape[-1], (len(tables), 3), generator=generator, device=generator.device).tolist()
    return torch.stack([table.roll(shift, (0, 1, 2)) for table, shift in zip(tables, shifts, strict=True)])
