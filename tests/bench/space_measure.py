"""Slices of a texture against a photograph of which the space saw one patch: distances over the floor, and likelihoods.

What slices are compared with is also held out, a crop of the photograph at a time, and measured as if it were a slice: that is
the paper's "ground truth", which no synthesis needs to be better than. Where the photograph has room for it, slices are
compared with the encoded patch, at its size, and truth is other crops of the photograph. A photograph that is not much
larger than the patch is cut into disjoint crops of half its size, as in `solidgrain.train.quality`; slices are
compared with all of them, and each crop in turn with the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from solidgrain.train.cuts import Sample, as_image, axis_rotation, cut, oblique_rotation, random_place
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.quality import Measure, Statistics, disjoint_crops
from solidgrain.train.slices import Planes
from tests.bench.likelihood import BANDWIDTHS, log_likelihoods, take_patches

KINDS = ("oblique", "axis")  # orientations of slices, reported apart
FEWEST, MOST = 4, 8  # crops of truth
KERNELS = (15, 11, 9, 7, 5, 3)  # pixels along each side of the patches whose likelihood is asked for, "start large"
SAMPLES, TRUTH = 512, 4096  # patches that are asked for, and of which the density is made

DoubleArray = npt.NDArray[np.float64]
Figures = dict[str, Any]  # JSON: "ratios" by measure, mean and deviation; "likelihood" by kernel, a mean for each bandwidth


class Crops(NamedTuple):
    """What is compared, all squares of one size [1, 3, s, s]."""

    compared: list[Tensor]  # with slices
    truth: list[Tensor]  # with what is compared, in the place of slices
    same: bool  # whether they are the same crops, none of which is compared with itself


def cut_crops(photograph: Tensor, patch: int) -> Crops:
    """The crops of a photograph [1, 3, H, W] whose middle `patch`² pixels were encoded."""
    height, width = photograph.shape[2:]
    top, left = (height - patch) // 2, (width - patch) // 2
    corners = [(y, x) for y in range(0, height - patch + 1, patch) for x in range(0, width - patch + 1, patch)]
    apart = [(y, x) for y, x in corners if abs(y - top) >= patch or abs(x - left) >= patch]
    if len(apart) < FEWEST:
        crops = [square.pixels for square in disjoint_crops(photograph, min(height // 2, width // 2, patch))]
        return Crops(crops, crops, same=True)
    order = torch.randperm(len(apart), generator=torch.Generator().manual_seed(0)).tolist()
    places = [(top, left), *(apart[k] for k in order[:MOST])]
    encoded, *truth = [photograph[..., y : y + patch, x : x + patch] for y, x in places]
    return Crops([encoded], truth, same=False)


@dataclass
class Reference:
    """A photograph's crops and what the measures say of them: K crops of truth, R that slices are compared with."""

    crops: Crops
    measure: Measure
    _densities: dict[tuple[int, bytes], Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.compared = [self.measure.statistics(crop) for crop in self.crops.compared]
        same = self.crops.same
        self.truth = self.compared if same else [self.measure.statistics(crop) for crop in self.crops.truth]
        self.names = list(self.measure.distances(self.compared[0], self.compared[0]))
        self.between = np.stack([self._distances(one) for one in self.truth])  # [K, R, measures]
        self.fair = ~np.eye(len(self.truth), dtype=bool) if same else np.ones(self.between.shape[:2], bool)  # [K, R]
        others = ~np.eye(len(self.truth), dtype=bool)[..., None] & self.fair[:, None] & self.fair  # [K held out, K, R]
        self.floors = np.stack([self.between[pairs].mean(0) for pairs in others])  # without what is held out: [K, measures]

    @property
    def size(self) -> int:
        """Pixels along each side of what is compared."""
        return int(self.crops.compared[0].shape[-1])

    def facts(self) -> dict[str, Any]:
        """What was compared, and the distances that are the floor, for the record."""
        floor = self.between[self.fair].mean(0)
        found = dict(zip(self.names, floor.tolist(), strict=True))
        return {"crop": self.size, "crops": len(self.truth), "apart_from_patch": not self.crops.same, "floor": found}

    def of_truth(self) -> Figures:
        """Each crop of truth, held out, as if it were a slice."""
        ratios = [self.between[k][self.fair[k]].mean(0) / self.floors[k] for k in range(len(self.truth))]
        return {"ratios": self._spread(ratios), "likelihood": self._likelihoods([[crop] for crop in self.crops.truth])}

    def of_slices(self, slices: Sequence[Tensor]) -> Figures:
        """Slices [1, 3, s, s]: compared with what each crop of truth is compared with, over the same floor."""
        ratios = []
        for one in slices:
            distances = self._distances(self.measure.statistics(one))
            each = [distances[fair].mean(0) / floor for fair, floor in zip(self.fair, self.floors, strict=True)]
            ratios.append(np.mean(each, 0))
        return {
            "ratios": self._spread(ratios),
            "likelihood": self._likelihoods([slices[k :: len(self.truth)] for k in range(len(self.truth))]),
        }

    def _distances(self, picture: Statistics) -> DoubleArray:
        """To each of the compared: [R, measures]."""
        found = [self.measure.distances(one, picture) for one in self.compared]
        return np.array([list(one.values()) for one in found])

    def _spread(self, ratios: Sequence[DoubleArray]) -> dict[str, list[float]]:
        means, deviations = np.mean(ratios, 0).tolist(), np.std(ratios, 0).tolist()
        return {name: [mean, std] for name, mean, std in zip(self.names, means, deviations, strict=True)}

    def _likelihoods(self, pictures: Sequence[Sequence[Tensor]]) -> dict[str, list[float]]:
        """By kernel size the mean log-likelihood under each of BANDWIDTHS; pictures[k] under the density without truth k."""
        generator, found = torch.Generator().manual_seed(1), {}
        share = -(-SAMPLES // sum(map(len, pictures)))
        for kernel in (kernel for kernel in KERNELS if kernel <= self.size):
            parts = []
            for k, group in enumerate(pictures):
                if group:
                    patches = torch.cat([take_patches(one, kernel, share, generator) for one in group])
                    parts.append(log_likelihoods(patches, self._density(k, kernel), BANDWIDTHS))
            found[str(kernel)] = torch.cat(parts, 1).mean(1).tolist()
        return found

    def _density(self, k: int, kernel: int) -> Tensor:
        """Patches of what truth k is compared with."""
        key = (kernel, self.fair[k].tobytes())
        if key not in self._densities:
            generator = torch.Generator().manual_seed(kernel)
            crops = [crop for crop, fair in zip(self.crops.compared, self.fair[k], strict=True) if fair]
            share = TRUTH // len(crops)
            self._densities[key] = torch.cat([take_patches(crop, kernel, share, generator) for crop in crops])
        return self._densities[key]


@torch.no_grad()
def measure_slices(reference: Reference, sample: Sample, slices: int, planes: Planes) -> dict[str, Figures]:
    """Of each kind of orientation, a slice of each of so many instances."""
    views = list(_views(sample, reference.size, slices, planes))
    return {kind: reference.of_slices([view[k] for view in views]) for k, kind in enumerate(KINDS)}


def _views(sample: Sample, size: int, slices: int, planes: Planes) -> Iterator[tuple[Tensor, ...]]:
    """Both kinds of one instance after another: making an instance takes longer than a slice of it."""
    turned: dict[str, Callable[[int, torch.Generator], Tensor]] = {
        "axis": lambda seed, generator: axis_rotation(seed, planes),
        "oblique": lambda seed, generator: oblique_rotation(generator, planes),
    }
    for seed in range(slices):
        generator = torch.Generator().manual_seed(seed)
        pictures: list[FloatArray] = []
        for kind in KINDS:
            rotation = turned[kind](seed, generator)
            pictures.append(cut(sample, size, rotation, seed, random_place(generator)))
        yield tuple(map(as_image, pictures))
