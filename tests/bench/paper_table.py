"""`make paper-table`: Table 1 of GramGAN (arXiv 2006.16112v2), every method of it trained for the same time on two exemplars.

python -m tests.bench.paper_table --minutes 20 --threads 1 --out FOLDER [--resume]

Prints distances to the exemplar over its own floor (`solidgrain.train.quality`; the paper's measure, SIFID, needs --inception),
mean ± deviation over one randomly oriented slice of each of 50 instances, beside the paper's figures, and how far the orders
of the methods agree. All columns but the last start from the `fast` preset with the paper's losses, since its other settings
want a GPU for hours; the last has them all. FOLDER gets table.md, table.json, a strip of slices per exemplar, and every run.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from solidgrain.runtime.errors import UsageError
from solidgrain.runtime.files import replacing
from solidgrain.train.begin import with_grain
from solidgrain.train.cuts import Sample
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.inception import Inception
from solidgrain.train.photograph import read_exemplar
from solidgrain.train.quality import evaluate
from solidgrain.train.settings import FAST, PAPER, Budget, Settings
from solidgrain.train.slices import Planes, planes_seen
from solidgrain.train.variants import vary
from tests.bench import cells

DEFAULTS = {
    "wood": cells.EXEMPLARS / "large" / "materialx_wood.jpg",
    "granite": cells.EXEMPLARS / "stone128" / "Granite002A.png",
}
LARGEST = 512  # pixels: larger photographs are reduced by a whole factor, so that patches see their structures
SMALLEST = 128

TITLES = {
    "henzler": "Henzler et al.",
    "gan+vgg": "GAN+VGG",
    "noise-at-input": "NI",
    "a1b0": "α:1 β:0",
    "a0b1": "α:0 β:1",
    "paper": "α:0.1 β:1",
}
PRESET = "paper-preset"  # the seventh column
# What the paper weighs against each other is its own, and no method has a head start: the embedded space is the method's.
LOSSES_OF_THE_PAPER = ("alpha", "alpha_half_life", "gram_energy", "color_weight")
NO_HEAD_START = ("critic_start", "sampler_start", "octaves", "later_patch")
FROM_NOISE = {"sampler_rate": 2e-3}  # the preset's is for a sampler that begins as a stone
SHARED = replace(FAST, **FROM_NOISE, **{name: getattr(PAPER, name) for name in LOSSES_OF_THE_PAPER + NO_HEAD_START})
COLUMNS: dict[str, Settings] = {**{name: vary(SHARED, name) for name in TITLES}, PRESET: PAPER}
SIFID: dict[str, dict[str, tuple[float, float]]] = {  # x 10^5, Portenier et al. 2020, Table 1
    "wood": {
        "henzler": (0.67, 0.42), "gan+vgg": (0.19, 0.04), "noise-at-input": (0.28, 0.04),
        "a1b0": (0.29, 0.05), "a0b1": (0.12, 0.02), "paper": (0.14, 0.02),
    },
    "granite": {
        "henzler": (0.53, 0.03), "gan+vgg": (0.31, 0.12), "noise-at-input": (0.34, 0.29),
        "a1b0": (0.28, 0.12), "a0b1": (0.43, 0.20), "paper": (0.21, 0.10),
    },
}  # fmt: skip
Cells = Mapping[str, Mapping[str, Any]]  # by column


def main(argv: Sequence[str] | None = None) -> None:
    parser = cells.arguments_of(__doc__.splitlines()[0], Path("build/paper-table"), slices=50)
    cells.add_budget(parser)
    for kind, path in DEFAULTS.items():
        parser.add_argument(f"--{kind}", type=Path, default=path, metavar="PHOTO", help=f"the {kind} of the table")
    arguments = parser.parse_args(argv)
    photographs = {kind: photograph(kind, getattr(arguments, kind)) for kind in DEFAULTS}
    device, inception = cells.prepare(arguments, exemplars={kind: getattr(arguments, kind).name for kind in DEFAULTS})
    budget = Budget(arguments.iterations, arguments.minutes)
    for kind, exemplar in photographs.items():
        for column in COLUMNS:
            finish_cell(arguments.out / kind, column, exemplar, budget, arguments.slices, device, inception)
            write_results(arguments.out, photographs)
    print((arguments.out / "table.md").read_text("utf-8"))


def photograph(kind: str, path: Path) -> FloatArray:
    """The exemplar of a row, reduced to the size that patches are made for."""
    if not path.is_file():
        raise UsageError(f"--{kind} {path}: no such file; give a photograph of {kind}, at least {SMALLEST}x{SMALLEST} pixels")
    pixels = torch.from_numpy(read_exemplar(path, SMALLEST)).permute(2, 0, 1)
    factor = max(1, min(pixels.shape[1:]) // LARGEST)
    return np.ascontiguousarray(torch.nn.functional.avg_pool2d(pixels, factor).permute(1, 2, 0).numpy())


def finish_cell(
    folder: Path,
    column: str,
    exemplar: FloatArray,
    budget: Budget,
    slices: int,
    device: torch.device,
    inception: Inception | None = None,
) -> None:
    """Train and measure one method on one exemplar, unless that was done before."""
    settings = with_grain(COLUMNS[column], "auto" if folder.name == "wood" else None, exemplar)
    planes = planes_seen(settings)

    def measured(sample: Sample) -> dict[str, Any]:
        cells.write_png(folder / f"{column}.png", slice_picture(sample, planes))
        return {"quality": asdict(evaluate(exemplar, sample, slices, planes, inception))}

    result = folder / f"{column}.json"
    cells.finish(result, folder / column, settings, exemplar, budget, device, {"method": column}, measured)


def slice_picture(sample: Sample, planes: Planes, size: int = 256) -> FloatArray:
    """An oblique slice of instance 0, or one that holds the grain."""
    oblique = planes.example() if planes.grain == "none" else planes.along_axes()[0]
    picture: FloatArray = sample(cells.plane(size, oblique, np.zeros(3)), 0).reshape(size, size, 3)
    return picture


def write_results(out: Path, photographs: Mapping[str, FloatArray]) -> None:
    """table.md, table.json and the strips, of the cells that are finished."""
    tables, found = [], {}
    for kind, exemplar in photographs.items():
        finished = {column: cell for column in COLUMNS if (cell := cells.kept(out / kind / f"{column}.json"))}
        if finished:
            correlations = {name: correlation(kind, means(finished, name)) for name in measures(finished)}
            tables.append(table(kind, finished, correlations))
            found[kind] = {"cells": finished, "rank_correlation": correlations, "paper_sifid": SIFID[kind]}
            cells.write_png(out / f"{kind}.png", strip(out / kind, exemplar))
    cells.keep(out / "table.json", found)
    with replacing(out / "table.md") as file:
        file.write("\n\n".join(tables).encode() + b"\n")


def measures(finished: Cells) -> list[str]:
    """The names of what was measured."""
    return next((list(cell["quality"]["oblique"]) for cell in finished.values() if "quality" in cell), [])


def means(finished: Cells, measure: str) -> dict[str, float]:
    """A measure's mean by method; the paper's preset is not one of the paper's methods."""
    return {
        name: cell["quality"]["oblique"][measure][0] for name, cell in finished.items() if "quality" in cell and name in TITLES
    }


def order(by_method: Mapping[str, float]) -> str:
    return " < ".join(TITLES[name] for name in sorted(by_method, key=by_method.__getitem__))


def correlation(kind: str, found: Mapping[str, float]) -> float | None:
    """Spearman's rank correlation with the paper's SIFID, over the methods that are there; None for fewer than three."""
    names = [name for name in SIFID[kind] if name in found]
    if len(names) < 3:
        return None
    ours, theirs = (np.argsort(np.argsort([by[name] for name in names])) for by in (found, sifid_means(kind)))
    return round(float(np.corrcoef(ours, theirs)[0, 1]), 3)


def sifid_means(kind: str) -> dict[str, float]:
    return {name: mean for name, (mean, _) in SIFID[kind].items()}


def sifid(quality: Mapping[str, Any]) -> list[float]:
    """A cell's SIFID as the paper prints it, mean and deviation."""
    return [1e5 * quality["floor"]["sifid"] * ratio for ratio in quality["oblique"]["sifid"]]


def table(kind: str, finished: Cells, correlations: Mapping[str, float | None]) -> str:
    """One exemplar's table in Markdown, and the orders of the methods under it."""
    titles = [*TITLES.values(), "the paper's preset"]
    lines = [f"| {kind} | {' | '.join(titles)} |", "|---" * (len(titles) + 1) + "|"]
    lines.append(row("SIFID × 10⁵ (the paper, Table 1)", {name: spread(pair) for name, pair in SIFID[kind].items()}))
    measured = {column: cell["quality"] for column, cell in finished.items() if "quality" in cell}
    if "sifid" in measures(finished):
        lines.append(row("SIFID × 10⁵", {column: spread(sifid(quality)) for column, quality in measured.items()}))
    for name in measures(finished):
        figures = {column: spread(quality["oblique"][name]) for column, quality in measured.items()}
        lines.append(row(f"{name} / floor", figures))
    lines.append(row("iterations", {column: f"{cell['iterations']}" for column, cell in finished.items()}))
    lines.append(row("minutes", {column: f"{cell['minutes']:.0f}" for column, cell in finished.items()}))
    lines.append(row("diverged", {column: "yes" if cell["diverged"] else "no" for column, cell in finished.items()}))
    lines += ["", "Best to worst:", "", f"- the paper's SIFID: {order(sifid_means(kind))}"]
    for name in measures(finished):
        agreement = correlations[name]
        note = "" if agreement is None else f" (rank correlation with the paper {agreement:+.2f})"
        lines.append(f"- {name}: {order(means(finished, name))}{note}")
    return "\n".join(lines)


def row(title: str, by_column: Mapping[str, str]) -> str:
    return f"| {title} | {' | '.join(by_column.get(column, '–') for column in [*TITLES, PRESET])} |"


def spread(pair: Sequence[float]) -> str:
    return f"{pair[0]:.2f} ± {pair[1]:.2f}"


def strip(folder: Path, exemplar: FloatArray, size: int = 256) -> FloatArray:
    """The exemplar's middle and a slice of each column in the table's order; black where there is none."""
    top, left = (max(extent - size, 0) // 2 for extent in exemplar.shape[:2])
    pictures = [exemplar[top : top + size, left : left + size]]
    for column in COLUMNS:
        path = folder / f"{column}.png"
        pictures.append(read_exemplar(path, 1) if path.exists() else np.zeros((size, size, 3), np.float32))
    return np.concatenate([np.pad(p, ((0, size - len(p)), (0, size - p.shape[1] + 8), (0, 0))) for p in pictures], axis=1)


if __name__ == "__main__":
    sys.exit(cells.reported(main))
