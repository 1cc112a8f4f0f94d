"""The pictures of the table of texture spaces: what was photographed beside what was made of it, and what lies between two."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from solidgrain.export.evaluation import planes_of
from solidgrain.runtime import Space
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.photograph import read_exemplar
from tests.bench import cells
from tests.bench.paper_table import slice_picture
from tests.bench.space_methods import TITLES

GAP = 8  # pixels
ACROSS = 4  # exemplars side by side
STRIPS = 6  # at most
SQUARES = 7  # of an interpolation, both ends included
SHEETS = {  # by group of photographs: the columns beside each exemplar
    "held-out": ("unadapted", "critic"),
    "far": tuple(name for name in TITLES if name != "truth"),
    "large": ("unadapted", "critic"),
}


def write_sheets(out: Path) -> None:
    """OUT/held-out.png and its like: for each photograph, in the order of names, the exemplar and a slice of each column."""
    for group, columns in SHEETS.items():
        folders = sorted(path.parent for path in (out / group).glob("*/exemplar.png"))
        shown = [name for name in ("exemplar", *columns) if any((folder / f"{name}.png").exists() for folder in folders)]
        if shown:
            cells.write_png(
                out / f"{group}.png", _grid([_row([folder / f"{name}.png" for name in shown]) for folder in folders])
            )


def write_interpolations(path: Path, space: Space, exemplars: Sequence[FloatArray]) -> None:
    """Strips of slices through the textures between two exemplars, linear in z, all in one plane of one instance.

    An exemplar at each end; beside it, the first and last slice are the exemplars as the space makes them (the paper's
    figure of latent interpolation). Exemplars are paired across the list, so that neighbours in it are not.
    """
    half = len(exemplars) // 2
    if path.exists() or not half:
        return
    pairs = list(zip(exemplars[:half], exemplars[half:], strict=False))
    chosen = [pairs[k * len(pairs) // min(STRIPS, half)] for k in range(min(STRIPS, half))]
    rows = []
    for number, (first, second) in enumerate(chosen):
        cells.say(f"interpolation {number + 1} of {len(chosen)}")
        ends, planes = [space.encode(one) for one in (first, second)], planes_of(space.bundle)
        between = [space.blend(ends[0], ends[1], float(at)) for at in np.linspace(0, 1, SQUARES)]
        slices = [slice_picture(texture.sample, planes, space.patch) for texture in between]
        rows.append(_joined([first, *slices, second], axis=1))
    cells.write_png(path, _joined(rows, axis=0))


def _row(paths: Sequence[Path]) -> FloatArray:
    """Pictures side by side; black where there is none yet."""
    size = len(read_exemplar(paths[0], 1))
    empty = np.zeros((size, size, 3), np.float32)
    return _joined([read_exemplar(path, 1) if path.exists() else empty for path in paths], axis=1, gap=2)


def _grid(rows: Sequence[FloatArray]) -> FloatArray:
    """ACROSS of the rows side by side, and as many lines as it takes."""
    filled = [*rows, *[np.ones_like(rows[0])] * (-len(rows) % min(ACROSS, len(rows)))]
    across = min(ACROSS, len(rows))
    lines = [_joined(filled[k : k + across], axis=1) for k in range(0, len(filled), across)]
    return _joined(lines, axis=0)


def _joined(pictures: Sequence[FloatArray], axis: int, gap: int = GAP) -> FloatArray:
    """Pictures of one size, a white gap between them."""
    shape = list(pictures[0].shape)
    shape[axis] = gap
    parts = [part for picture in pictures for part in (picture, np.ones(shape, np.float32))]
    return np.concatenate(parts[:-1], axis=axis)
