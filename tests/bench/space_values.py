"""What the table of texture spaces has found so far: figures by photograph, and the likelihoods that the paper would quote.

OUT/GROUP/NAME/COLUMN.json are the results that this reads. A figure is a mean over slices of one photograph.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.bench import cells
from tests.bench.likelihood import BANDWIDTHS
from tests.bench.signed_rank import signed_rank
from tests.bench.space_measure import KERNELS, KINDS
from tests.bench.space_methods import TITLES

Photographs = Mapping[str, Mapping[str, Any]]  # by name, then by column: what its JSON holds
Values = dict[str, dict[str, float]]  # by column, then by photograph

ALL = "ALL"  # among the measures: the average log-likelihood, the only one of which more is better
SIGNIFICANT = 0.05
CONTRASTS = (("henzler", "unadapted"), ("unadapted", "critic"), ("truth", "unadapted"))  # whose difference decides on a size


class Window(NamedTuple):
    """At which size and bandwidth likelihoods are quoted, and why."""

    kernel: int  # pixels along each side of a patch
    bandwidth: float  # levels of 0..255
    methods: tuple[str, str]  # that are to be told apart
    p: float  # of their difference


def read_group(folder: Path) -> dict[str, dict[str, Any]]:
    """The results of a group of photographs."""
    found = {
        path.name: {column: cell for column in TITLES if (cell := cells.kept(path / f"{column}.json"))}
        for path in sorted(folder.glob("*"))
        if path.is_dir()
    }
    return {name: columns for name, columns in found.items() if columns}


def figures(cell: Mapping[str, Any], kind: str) -> Mapping[str, Any]:
    """Those of one kind of slices; crops of a photograph have no kinds."""
    found: Mapping[str, Any] = cell["truth"] if "truth" in cell else cell[kind]
    return found


def collect(photographs: Photographs, window: Window | None) -> dict[str, dict[str, Values]]:
    """Everything, by kind of slices, by measure, by column, by photograph."""
    return {
        kind: {name: ratios(photographs, kind, name) for name in measures(photographs)}
        | ({ALL: likelihoods(photographs, kind, window.kernel, BANDWIDTHS.index(window.bandwidth))} if window else {})
        for kind in KINDS
    }


def measures(photographs: Photographs) -> list[str]:
    """The names of what was measured."""
    every = [cell for columns in photographs.values() for cell in columns.values()]
    return list(figures(every[0], KINDS[0])["ratios"]) if every else []


def ratios(photographs: Photographs, kind: str, measure: str) -> Values:
    """A measure over its floor."""
    return {
        column: {
            name: figures(cell[column], kind)["ratios"][measure][0] for name, cell in photographs.items() if column in cell
        }
        for column in present(photographs)
    }


def likelihoods(photographs: Photographs, kind: str, kernel: int, bandwidth: int) -> Values:
    """ALL at a size and at one of BANDWIDTHS, by its place among them."""
    return {
        column: {
            name: figures(cell[column], kind)["likelihood"][str(kernel)][bandwidth]
            for name, cell in photographs.items()
            if column in cell
        }
        for column in present(photographs)
    }


def present(photographs: Photographs) -> list[str]:
    """The columns that have a result, in the table's order."""
    return [column for column in TITLES if any(column in cell for cell in photographs.values())]


def paired(first: Mapping[str, float], second: Mapping[str, float]) -> list[float]:
    """First minus second, of the photographs that both have."""
    return [first[name] - second[name] for name in first if name in second]


def mean(by_photograph: Mapping[str, float]) -> float:
    return float(np.mean([*by_photograph.values()]))


def choose_window(photographs: Photographs) -> Window | None:
    """The largest patches whose likelihood tells two methods apart at 5 %, as the paper chose them; else the smallest.

    Their bandwidth is the one of the grid under which the truth is most probable, over all photographs. None without truth
    or without two methods.
    """
    columns = present(photographs)
    methods = next((pair for pair in CONTRASTS if {*pair} <= {*columns}), None)
    if methods is None or "truth" not in columns:
        return None
    window = None
    for kernel in _sizes(photographs):
        grid = [likelihoods(photographs, KINDS[0], kernel, place) for place in range(len(BANDWIDTHS))]
        best = max(range(len(grid)), key=lambda place: mean(grid[place]["truth"]))
        p = signed_rank(paired(*(grid[best][method] for method in methods)))
        window = Window(kernel, BANDWIDTHS[best], methods, p)
        if p < SIGNIFICANT:
            break
    return window


def _sizes(photographs: Photographs) -> list[int]:
    """The patches that fit into what was compared of every photograph, large ones first."""
    found = [figures(cell, KINDS[0])["likelihood"] for columns in photographs.values() for cell in columns.values()]
    return [kernel for kernel in KERNELS if all(str(kernel) in one for one in found)]
