"""Random planes through the solid (Sec. 3.1: "our model synthesizes 2D images by randomly slicing the 3D space")."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from solidgrain.train.settings import Settings

UNIT = 64.0  # pixels per unit of the coordinates that the octaves act on
REACH = 64.0  # units in which places are scattered


class Planes(NamedTuple):
    """Which planes through a solid look like the photograph: all of them, or those that hold the axis of its grain.

    Among the latter a plane that is turned by 180° is the same one seen from behind, the photograph's mirror image. Of what is
    not its own mirror image, as where light falls from one side, those look like it that are `upright`: from xy to xz, or from
    xy to zy with z to the left, where the grain runs along y. The authors' code draws its angles from such a quarter, too.
    """

    grain: str = "none"  # "none", "x" or "y"
    upright: bool = False

    def along_axes(self) -> Tensor:
        """The planes along the axes, as rotations [K, 3, 3] of xy: xy, xz and zy, or the two of them that hold the grain."""
        quarter = torch.tensor([math.pi / 2])
        xy, xz, zy = torch.eye(3), about_axis(0, quarter)[0], about_axis(1, quarter)[0]
        return torch.stack({"none": [xy, xz, zy], "x": [xy, xz], "y": [xy, zy]}[self.grain])

    def turned(self, count: int, generator: torch.Generator) -> Tensor:
        """Rotations [count, 3, 3] of xy, drawn evenly: from SO(3), through unit quaternions, or about the grain."""
        device = generator.device
        if self.grain == "none":
            return from_quaternions(F.normalize(torch.randn(count, 4, generator=generator, device=device), dim=1))
        angles = (0.5 if self.upright else 2.0) * math.pi * torch.rand(count, generator=generator, device=device)
        return about_axis("xyz".index(self.grain), angles)

    def example(self) -> Tensor:
        """One of them to look at, the same every time and along no axes, as a rotation [3, 3] of xy."""
        if self.grain == "none":
            return from_quaternions(torch.tensor([[0.5, 0.1, 0.7, 0.5]]))[0]
        return about_axis("xyz".index(self.grain), torch.tensor([0.9]))[0]


ALL_PLANES = Planes()


def planes_seen(settings: Settings) -> Planes:
    """Those that a training slices."""
    return Planes(settings.grain, settings.upright)


def draw_slices(settings: Settings, generator: torch.Generator) -> Tensor:
    """Points of `batch` randomly turned and shifted planes, [B, patch², 3], rows of the image first."""
    flat = flat_slice(settings.patch, generator.device)
    centred = flat - settings.patch / (2 * UNIT) * torch.tensor([1.0, 1.0, 0.0], device=flat.device)
    turned = torch.einsum("bij,pj->bpi", draw_rotations(settings, generator), centred)
    shift = torch.rand(settings.batch, 1, 3, generator=generator, device=generator.device)
    return turned + (2 * shift - 1)


def flat_slice(size: int, device: torch.device) -> Tensor:
    """The points [size², 3] of an axis-aligned square: x along the image's rows, y down its columns, z = 0."""
    ticks = torch.arange(size, device=device) / UNIT
    y, x = torch.meshgrid(ticks, ticks, indexing="ij")
    return torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)


def as_images(rgb: Tensor, size: int) -> Tensor:
    """The colours [B, size², 3] at a slice's points, as images [B, 3, size, size]."""
    return rgb.reshape(-1, size, size, 3).permute(0, 3, 1, 2)


def scatter(images: int, places: int, generator: torch.Generator) -> Tensor:
    """Points [images, places, 3] so far apart that the solid's colours there are as good as independent."""
    return REACH * torch.rand(images, places, 3, generator=generator, device=generator.device)


def draw_rotations(settings: Settings, generator: torch.Generator) -> Tensor:
    """Rotation matrices [B, 3, 3]: free for isotropic materials, about the grain's axis for anisotropic ones.

    The paper asks for "all possible slice orientations"; its code draws three Euler angles from [0°, 90°], which favours
    some. "axis" is what Henzler et al. (2020) do.
    """
    batch, device, planes = settings.batch, generator.device, planes_seen(settings)
    if settings.rotations == "axis":
        rotations = planes.along_axes().to(device)
        return rotations[torch.randint(len(rotations), (batch,), generator=generator, device=device)]
    if settings.rotations == "euler" and settings.grain == "none":
        angles = 0.5 * math.pi * torch.rand(3, batch, generator=generator, device=device)
        return about_axis(2, angles[2]) @ about_axis(1, angles[1]) @ about_axis(0, angles[0])
    return planes.turned(batch, generator)


def about_axis(axis: int, angles: Tensor) -> Tensor:
    """Right-handed rotations [B, 3, 3] by angles [B] (radians) about one coordinate axis."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    rotations = torch.eye(3, device=angles.device).repeat(len(angles), 1, 1)
    rotations[:, j, j] = rotations[:, k, k] = angles.cos()
    rotations[:, k, j] = angles.sin()
    rotations[:, j, k] = -angles.sin()
    return rotations


def from_quaternions(quaternions: Tensor) -> Tensor:
    """Unit quaternions (w, x, y, z) [B, 4] -> rotation matrices [B, 3, 3]."""
    w, x, y, z = quaternions.unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)
