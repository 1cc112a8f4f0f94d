"""How good a texture is: distances between the inner statistics of its slices and of the exemplar, over the exemplar's floor.

A distance alone says little. The floor is the same distance between disjoint crops of the exemplar itself, and results are
quoted as ratios to it. Several measures, since they disagree:

    vgg_frechet  Fréchet distance between VGG-16 features of two layers (as SIFID, Shaham et al. 2019, but on VGG)
    gram         relative difference of Gram matrices of four VGG-16 layers (Gatys et al. 2015)
    patches      sliced Wasserstein distance of 7x7 patches on three pyramid levels (Karras et al. 2018)
    color        sliced Wasserstein distance of the colours
    coarse_gram  `gram` at a quarter of the resolution: large structures
    sifid        Fréchet distance between InceptionV3 features (Shaham et al. 2019), where the user has its weights

Images here are tensors [1, 3, H, W] in [0, 1].
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from solidgrain.runtime.errors import ExemplarError
from solidgrain.train.cuts import RotationOf, Sample, as_image, axis_rotation, oblique_rotation, take_slices
from solidgrain.train.exemplar import FloatArray, mirror_symmetry, nonstationarity, unfolded
from solidgrain.train.inception import Inception
from solidgrain.train.losses import gram_difference, gram_matrices
from solidgrain.train.slices import ALL_PLANES, Planes
from solidgrain.train.vgg import STYLE_LAYERS, Vgg

Measures = dict[str, float]

FRECHET_LAYERS, GRAM_LAYERS = (1, 3), STYLE_LAYERS
LARGEST_CROP = 256  # pixels
COMPARED = 6  # crops of an exemplar at most, all over it
REPEATED = 0.1  # of the median difference between two crops, below which one shows the other's period again
SMALLEST = 64  # pixels along each side of an exemplar: its crops must outlast the pyramids
SMALLEST_FLOOR = 1e-6  # between colours: a photograph's is a thousand times that


@dataclass(frozen=True)
class Evaluation:
    """Measures of a texture, as ratios to the exemplar's floor: mean and standard deviation over slices."""

    crop: int  # pixels along each side of the compared squares
    slices: int  # of each kind
    floor: Measures
    axis: dict[str, tuple[float, float]]
    oblique: dict[str, tuple[float, float]]
    turned: Measures  # the exemplar itself, as `turn` says: far above 1 where it has a direction
    nonstationarity: float = 0.0  # of the exemplar
    symmetry: float = 0.0  # of the exemplar about its middle
    one_side: bool = False  # of an exemplar that was mirrored there was compared, rather than all of it
    grain: str = "none"  # the image axis about which slices turn
    upright: bool = False  # by a quarter at most
    among: Measures = field(default_factory=dict)  # each oblique slice from the next: at 1 they vary as the exemplar's parts do

    @property
    def turn(self) -> str:
        return "turned by 90°" if self.grain == "none" else "mirrored across its grain"


@torch.no_grad()
def evaluate(
    exemplar: FloatArray, sample: Sample, slices: int = 10, planes: Planes = ALL_PLANES, inception: Inception | None = None
) -> Evaluation:
    """Measure axis-aligned and oblique slices of a texture, one of each per seed, against its exemplar.

    Slices are taken in those planes alone that training saw. Of an exemplar that was mirrored to tile one side is compared, if
    it is large enough: a floor is not between mirror images.
    Raises ExemplarError if the exemplar's parts are all the same: there is no floor then.
    """
    measure = Measure(inception)
    part = unfolded(exemplar, SMALLEST)
    image = as_image(part)
    size = min(image.shape[2] // 2, image.shape[3] // 2, LARGEST_CROP)
    squares = [square.pixels for square in spread_out(distinct(disjoint_crops(image, size)), COMPARED)]
    crops = [measure.statistics(square) for square in squares]
    floor = floor_between(measure, crops)
    if floor["color"] < SMALLEST_FLOOR:
        raise ExemplarError(
            f"the exemplar has the same colours in each of its squares of {size}² pixels, so that nothing tells how far apart "
            "its own parts are; expected a photograph that neither repeats nor mirrors itself nor is of one colour, or one "
            "side or one period of it"
        )
    others = [measure.statistics(turned_as_slices_are(square, planes.grain)) for square in squares]
    turned = _mean(measure.distances(a, b) for i, a in enumerate(crops) for j, b in enumerate(others) if i != j)

    def pictures(rotation_of: RotationOf) -> Iterator[Statistics]:
        return (measure.statistics(as_image(one)) for one in take_slices(sample, size, slices, rotation_of))

    axis, _ = compared(measure, pictures(lambda seed, generator: axis_rotation(seed, planes)), crops, floor)
    oblique, among = compared(measure, pictures(lambda seed, generator: oblique_rotation(generator, planes)), crops, floor)
    return Evaluation(
        crop=size,
        slices=slices,
        floor=floor,
        axis=axis,
        oblique=oblique,
        turned={name: turned[name] / floor[name] for name in floor},
        nonstationarity=nonstationarity(exemplar),
        symmetry=mirror_symmetry(exemplar),
        one_side=part is not exemplar,
        grain=planes.grain,
        upright=planes.upright,
        among=among,
    )


def turned_as_slices_are(image: Tensor, grain: str) -> Tensor:
    """What slices show as often as the image itself, unless they are upright: it turned by 90°, or its grain from behind."""
    return image.rot90(1, (2, 3)) if grain == "none" else image.flip(2 if grain == "x" else 3)


class Square(NamedTuple):
    """A part of a picture, and which one of its grid of parts it is."""

    pixels: Tensor  # [1, 3, size, size]
    row: int
    column: int


def disjoint_crops(image: Tensor, size: int) -> list[Square]:
    """The image [1, 3, H, W] cut into squares; what is left over is shared out among its edges."""
    rows, columns = ([extent % size // 2 + number * size for number in range(extent // size)] for extent in image.shape[2:])
    return [
        Square(image[..., top : top + size, left : left + size], row, column)
        for row, top in enumerate(rows)
        for column, left in enumerate(columns)
    ]


def distinct(squares: list[Square]) -> list[Square]:
    """Without those that repeat an earlier one, as where a photograph holds two periods: a floor is not between equals."""
    step = max(1, squares[0].pixels.shape[2] // 32)
    seen = torch.cat([square.pixels[..., ::step, ::step].flatten(1) for square in squares])
    apart = torch.cdist(seen, seen, p=1)
    typical = apart[torch.ones_like(apart).triu(1).bool()].median()
    kept: list[int] = []
    for number in range(len(squares)):
        if all(apart[number, other] >= REPEATED * typical for other in kept):
            kept.append(number)
    return [squares[number] for number in kept]


def spread_out(squares: list[Square], count: int) -> list[Square]:
    """At most so many of a picture's squares: each as far from those before it as can be, the first in a corner."""
    chosen: list[Square] = []

    def apart(square: Square) -> tuple[float, int, int]:
        near = min((math.dist(square[1:], other[1:]) for other in chosen), default=0.0)
        return near, -square.row, square.column

    for _ in range(min(count, len(squares))):
        chosen.append(max(squares, key=apart))
    return chosen


@dataclass(frozen=True)
class Statistics:
    """What the measures compare, computed once per image."""

    moments: list[tuple[Tensor, Tensor]]  # mean and covariance of features
    grams: list[Tensor]
    coarse_grams: list[Tensor]
    patches: list[Tensor]  # sorted projections, per pyramid level
    colors: Tensor  # sorted projections
    inception: tuple[Tensor, Tensor] | None  # mean and covariance of features


class Measure:
    """The measures, with pretrained features (vgg.py, inception.py)."""

    def __init__(self, inception: Inception | None = None) -> None:
        self.vgg, self.inception = Vgg(), inception

    def statistics(self, image: Tensor) -> Statistics:
        features = self.vgg.features(image)
        coarse = self.vgg.features(F.avg_pool2d(image, 4))
        levels = [F.avg_pool2d(image, factor) for factor in (1, 2, 4)]
        return Statistics(
            moments=[_moments(F.avg_pool2d(features[layer], 2)) for layer in FRECHET_LAYERS],
            grams=[gram_matrices(features[layer]) for layer in GRAM_LAYERS if layer < len(features)],
            coarse_grams=[gram_matrices(coarse[layer]) for layer in GRAM_LAYERS if layer < len(coarse)],
            patches=[_projections(F.unfold(level, 7)[0].T, 256) for level in levels],
            colors=_projections(image.flatten(2)[0].T, 32),
            inception=_moments(self.inception.features(image)) if self.inception else None,
        )

    def distances(self, exemplar: Statistics, other: Statistics) -> Measures:
        moments = zip(exemplar.moments, other.moments, strict=True)
        measures = {
            "vgg_frechet": sum(_frechet(a, b) for a, b in moments),
            "gram": _gram_distance(exemplar.grams, other.grams),
            "patches": float(np.mean([_wasserstein(a, b) for a, b in zip(exemplar.patches, other.patches, strict=True)])),
            "color": _wasserstein(exemplar.colors, other.colors),
            "coarse_gram": _gram_distance(exemplar.coarse_grams, other.coarse_grams),
        }
        if exemplar.inception and other.inception:
            measures["sifid"] = _frechet(exemplar.inception, other.inception)
        return measures


def floor_between(measure: Measure, parts: list[Statistics]) -> Measures:
    """The mean distance between a picture's parts, of each from each: the other way round a distance may be another one."""
    return _mean(measure.distances(a, b) for i, a in enumerate(parts) for j, b in enumerate(parts) if i != j)


def compared(
    measure: Measure, pictures: Iterable[Statistics], crops: list[Statistics], floor: Measures
) -> tuple[dict[str, tuple[float, float]], Measures]:
    """How far pictures are from an exemplar's crops, and each from the one before it, over a floor.

    One picture at a time: the statistics of a hundred do not fit in memory.
    """
    to_crops, to_last, last = [], [], None
    for picture in pictures:
        to_crops.append(_mean(measure.distances(crop, picture) for crop in crops))
        if last is not None:
            to_last.append(measure.distances(last, picture))
        last = picture
    among = {name: value / floor[name] for name, value in _mean(to_last).items()} if to_last else {}
    return {name: _spread([one[name] / floor[name] for one in to_crops]) for name in floor}, among


def _moments(features: Tensor) -> tuple[Tensor, Tensor]:
    flat = features.flatten(2)[0].T.double()
    return flat.mean(0), torch.cov(flat.T)


def _frechet(a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor]) -> float:
    """|m_a - m_b|² + tr(C_a + C_b - 2 (C_a C_b)^(1/2)) (Dowson and Landau 1982)."""
    (mean_a, cov_a), (mean_b, cov_b) = a, b
    root = torch.linalg.eigvals(cov_a @ cov_b).real.clamp(min=0).sqrt().sum()
    return float(((mean_a - mean_b) ** 2).sum() + cov_a.trace() + cov_b.trace() - 2 * root)


def _gram_distance(exemplar: list[Tensor], other: list[Tensor]) -> float:
    """The mean over layers of Gram matrices' differences, relative to the exemplar's: the other way round it is another one."""
    return float(np.mean([float(gram_difference(a, b, relative=True)) for a, b in zip(exemplar, other, strict=True)]))


def _projections(vectors: Tensor, count: int) -> Tensor:
    """Vectors [N, d] on `count` fixed random directions, each projection sorted: [count, min(N, 20 000)]."""
    generator = torch.Generator().manual_seed(1)
    directions = torch.randn(vectors.shape[1], count, generator=generator)
    chosen = torch.randperm(len(vectors), generator=generator)[:20000]
    projected = (directions / directions.norm(dim=0)).T @ vectors[chosen].T
    return torch.from_numpy(np.sort(projected.numpy()))  # ten times as fast as torch's, which also says where each was


def _wasserstein(a: Tensor, b: Tensor) -> float:
    return float((a - b).abs().mean())


def _mean(measured: Iterable[Measures]) -> Measures:
    collected = list(measured)
    return {name: float(np.mean([one[name] for one in collected])) for name in collected[0]}


def _spread(values: list[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values))
