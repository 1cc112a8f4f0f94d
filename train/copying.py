"""Whether a texture merely copies its exemplar: how near its patches come to the exemplar's own.

The floor is the same distance within the exemplar: from patches of one half to their nearest in the other half. A texture
that invents is about as far from the exemplar as the exemplar's halves are from each other; one that copies comes nearer.
It is searched in twice the area, so that even patches of the very same material come a few percent nearer.

Distances are root mean squares over a patch's pixels and channels, colours in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from solidgrain.train.cuts import Sample, as_image, axis_rotation, cut, oblique_rotation, random_place
from solidgrain.train.exemplar import FloatArray, unfolded
from solidgrain.train.slices import ALL_PLANES, Planes

SIDE = 15  # pixels along each side of a patch
SLICES, SLICE = 16, 64  # half of them axis-aligned, half oblique; pixels along each side
MOST, FEWEST = 256, 32  # patches that are compared, for exemplars up to 512² pixels and for very large ones
SHOWN = 8  # the nearest pairs, for looking at
BAND = 2**22  # numbers held at a time
SMALLEST_FLOOR = 1 / 1020  # a quarter of an 8-bit level: exemplars that repeat themselves have less


@dataclass(frozen=True)
class Copying:
    """How near patches of a texture come to its exemplar."""

    patches: int  # compared, half of axis-aligned slices and half of oblique ones
    floor: float  # median distance from patches of one half of the exemplar to their nearest in the other half
    # Of an exemplar that repeats itself, whose halves hold the same, neither can be told: None.
    ratio: float | None  # median distance of the texture's patches, over the floor: near or above 1 is no copying
    closer: float | None  # share of the texture's patches that are nearer than 99 % of the floor's: near 0.01 is no copying

    def said(self) -> str:
        """In a few words."""
        return "–" if self.ratio is None or self.closer is None else f"{self.ratio:.2f}, {100 * self.closer:.1f} %"


class Pair(NamedTuple):
    """A patch of the texture and the nearest of the exemplar, turned as it was found; [SIDE, SIDE, 3] each."""

    patch: FloatArray
    nearest: FloatArray
    distance: float


@torch.no_grad()
def measure_copying(exemplar: FloatArray, sample: Sample, planes: Planes = ALL_PLANES) -> tuple[Copying, list[Pair]]:
    """Compare patches of a texture with their nearest in the exemplar, and return the nearest pairs of all as well.

    The search is exhaustive: every place in the exemplar, flipped, and transposed where it has no grain. The floor of what
    was mirrored to tile is that of one side: its halves hold the same.
    """
    image, side = as_image(exemplar), as_image(unfolded(exemplar, 2 * SIDE))
    count = min(MOST, max(FEWEST, MOST * 2**18 // (image.shape[2] * image.shape[3]))) // SLICES * SLICES
    found, nearest = search(image, made := _synthesised(sample, count, planes), planes.grain)
    first, second = side.tensor_split(2, dim=2 if side.shape[2] > side.shape[3] else 3)
    generator = torch.Generator().manual_seed(2)
    halves = [(first, _patches(second, count // 2, generator)), (second, _patches(first, count // 2, generator))]
    floor = torch.cat([search(half, patches, planes.grain)[0] for half, patches in halves])
    median = float(floor.median())
    pairs = [Pair(_as_array(made[i]), _as_array(nearest[i]), float(found[i])) for i in found.argsort()[:SHOWN].tolist()]
    if median < SMALLEST_FLOOR:
        return Copying(count, median, None, None), pairs
    closer = float((found < floor.quantile(0.01)).float().mean())
    return Copying(count, median, float(found.median()) / median, closer), pairs


def search(image: Tensor, patches: Tensor, grain: str) -> tuple[Tensor, Tensor]:
    """The place in an image [1, 3, H, W] nearest to each patch [N, 3, s, s]: distances [N], and what is there [N, 3, s, s]."""
    turns = [turn for turn in TURNS if grain == "none" or not turn.transposed]
    centre = image.mean((0, 2, 3), keepdim=True)
    turned = torch.cat([turn.there(patches) for turn in turns])
    values, tops, lefts = _nearest_places(image - centre, turned - centre)
    nearest = torch.empty_like(patches)
    for i, which in enumerate(values.view(len(turns), -1).argmin(0).tolist()):
        top, left = int(tops[which * len(patches) + i]), int(lefts[which * len(patches) + i])
        found = image[:, :, top : top + patches.shape[2], left : left + patches.shape[3]]
        nearest[i] = turns[which].back(found)[0]
    return (nearest - patches).square().mean((1, 2, 3)).sqrt(), nearest


@dataclass(frozen=True)
class Turn:
    """One of the eight ways in which a square falls on itself."""

    flips: tuple[int, ...]
    transposed: bool

    def there(self, patches: Tensor) -> Tensor:
        flipped = patches.flip(self.flips)
        return flipped.transpose(2, 3) if self.transposed else flipped

    def back(self, patches: Tensor) -> Tensor:
        return (patches.transpose(2, 3) if self.transposed else patches).flip(self.flips)


TURNS = [Turn(flips, transposed) for transposed in (False, True) for flips in ((), (2,), (3,), (2, 3))]  # as `draw_patches` has


def _nearest_places(image: Tensor, patches: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where |p|² - 2 p·q is least, in bands of rows: those values, tops and lefts, [N] each."""
    side, (height, width) = patches.shape[2], image.shape[2:]
    columns = width - side + 1
    rows = max(1, BAND // (columns * (len(patches) + 3 * side * side)))
    best: list[tuple[Tensor, Tensor]] = []
    for top in range(0, height - side + 1, rows):
        there = F.unfold(image[:, :, top : top + rows + side - 1], side)[0]  # [3 s², places]
        least, place = (there.square().sum(0) - 2 * patches.flatten(1) @ there).min(1)
        best.append((least, top * columns + place))
    values, places = (torch.stack(part) for part in zip(*best, strict=True))
    least, which = values.min(0)
    place = places.gather(0, which[None])[0]
    return least, place // columns, place % columns


def _synthesised(sample: Sample, count: int, planes: Planes) -> Tensor:
    """Patches [count, 3, SIDE, SIDE] of slices of as many instances."""
    patches = []
    for seed in range(SLICES):
        generator = torch.Generator().manual_seed(seed)
        rotation = oblique_rotation(generator, planes) if seed % 2 else axis_rotation(seed // 2, planes)
        image = as_image(cut(sample, SLICE, rotation, seed, random_place(generator)))
        patches.append(_patches(image, count // SLICES, generator))
    return torch.cat(patches)


def _patches(image: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Random patches [count, 3, SIDE, SIDE] of an image [1, 3, H, W]."""
    tops, lefts = (torch.randint(extent - SIDE + 1, (count,), generator=generator).tolist() for extent in image.shape[2:])
    places = zip(tops, lefts, strict=True)
    return torch.stack([image[0, :, top : top + SIDE, left : left + SIDE] for top, left in places])


def _as_array(patch: Tensor) -> FloatArray:
    pixels: FloatArray = patch.permute(1, 2, 0).contiguous().numpy()
    return pixels
