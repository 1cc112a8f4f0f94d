"""`make ground-truth`: solids that are known in full (solids.py), learned from one slice and compared with the truth.

python -m tests.bench.ground_truth --minutes 20 --threads 1 --out FOLDER [--resume]

An exemplar says nothing of the planes that it does not show. Here they are known: each solid is trained on one axis-aligned
slice, and slices of the synthesised solid in orientations that the exemplar does not have are compared with slices of the
true solid in orientations of the same kind, by the measures of `solidgrain.train.quality`. Distances are quoted over the
floor, the same distance between independent unseen slices of the truth: 1.0 is a solid that these measures cannot tell from it.

Granite and marble are isotropic: every orientation is fair. Wood is not: the rings of a real trunk look wider the more a plane
turns away from the radius, which no one slice can tell. Planes that hold the grain and turn by up to 30° meet the rings at
spacings within 15 % of the exemplar's, and only those are compared.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from solidgrain.runtime.files import replacing
from solidgrain.train.begin import with_grain
from solidgrain.train.cuts import Sample, as_image, oblique_rotation
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.inception import Inception
from solidgrain.train.quality import Measure, compared, floor_between
from solidgrain.train.settings import FAST, Budget
from solidgrain.train.slices import ALL_PLANES, about_axis
from tests.bench import cells
from tests.bench.solids import SOLIDS, DoubleArray, colors

SETTINGS = FAST
EXEMPLAR = 512  # pixels along each side
CROP = 256  # of the compared slices
TILT = math.radians(30)  # of wood's fair planes
TRUE_SLICES = 16  # of the true solid, of each kind: one of eight may be unlike the others
REACH = 10_000.0  # pixels around the origin in which slices of the truth are taken
SEEDS = {"exemplar": 0, "truth": 1_000, "synthesis": 2_000, "seen": 0, "unseen": 500}  # no instance serves twice

Look = Callable[[int, Tensor], Tensor]  # seed, rotation -> a slice [1, 3, CROP, CROP]


def main(argv: Sequence[str] | None = None) -> None:
    parser = cells.arguments_of(__doc__.splitlines()[0], Path("build/ground-truth"), slices=24)
    cells.add_budget(parser)
    arguments = parser.parse_args(argv)
    device, inception = cells.prepare(arguments, solids=sorted(SOLIDS), true_slices=TRUE_SLICES)
    for name in SOLIDS:
        finish_solid(arguments.out, name, Budget(arguments.iterations, arguments.minutes), arguments.slices, device, inception)
        write_results(arguments.out)
    print((arguments.out / "table.md").read_text("utf-8"))


def finish_solid(
    out: Path, name: str, budget: Budget, slices: int, device: torch.device, inception: Inception | None = None
) -> None:
    """Learn one solid from its slice and compare, unless that was done before."""
    exemplar = exemplar_of(name)
    settings = with_grain(SETTINGS, "x" if name == "wood" else None, exemplar)

    def measured(sample: Sample) -> dict[str, Any]:
        synthesis = synthesised(sample)
        cells.write_png(out / f"{name}.png", strip(name, exemplar, synthesis))
        return {"quality": compare(name, synthesis, slices, inception)}

    cells.finish(out / f"{name}.json", out / name, settings, exemplar, budget, device, {"solid": name}, measured)


def exemplar_of(name: str) -> FloatArray:
    """The one slice that training sees: the xy plane from the origin, [EXEMPLAR, EXEMPLAR, 3]."""
    y, x = np.mgrid[:EXEMPLAR, :EXEMPLAR].astype(np.float64)
    points = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    return colors(SOLIDS[name], points, SEEDS["exemplar"]).reshape(EXEMPLAR, EXEMPLAR, 3)


def seen(name: str, generator: torch.Generator) -> Tensor:
    """The exemplar's own orientation."""
    return torch.eye(3)


def unseen(name: str, generator: torch.Generator) -> Tensor:
    """A random orientation of those that are fair for the solid."""
    if name == "wood":
        return about_axis(0, TILT * (2 * torch.rand(1, generator=generator) - 1))[0]
    return oblique_rotation(generator, ALL_PLANES)


KINDS = {"seen": seen, "unseen": unseen}


def true(name: str) -> Look:
    """Slices of the true solid: anywhere, or for wood at the exemplar's distance from the pith."""
    reach = np.array([REACH, 0, 0] if name == "wood" else 3 * [REACH])
    middle = np.array([0.0, EXEMPLAR / 2, 0.0])

    def look(seed: int, rotation: Tensor) -> Tensor:
        place: DoubleArray = middle + reach * np.random.default_rng(seed).uniform(-1, 1, 3)
        return square(colors(SOLIDS[name], cells.plane(CROP, rotation, place), SEEDS["truth"] + seed))

    return look


def synthesised(sample: Sample) -> Look:
    return lambda seed, rotation: square(sample(cells.plane(CROP, rotation, np.zeros(3)), SEEDS["synthesis"] + seed))


def square(rgb: FloatArray) -> Tensor:
    """Colours [CROP², 3] as an image [1, 3, CROP, CROP]."""
    return as_image(rgb.reshape(CROP, CROP, 3))


@torch.no_grad()
def compare(name: str, synthesis: Look, slices: int, inception: Inception | None = None) -> dict[str, Any]:
    """The synthesised solid against the truth in both kinds of orientations, over the one floor of the unseen ones.

    `orientation` is the truth against itself: how far slices in the exemplar's orientation are from unseen ones. `seen_floor`
    is how far they are from each other. Both near 1, the exemplar does show what its solid looks like elsewhere.
    """
    measure, truth = Measure(inception), true(name)
    statistics = {kind: [measure.statistics(image) for image in views(truth, kind, name, TRUE_SLICES)] for kind in KINDS}
    floor = floor_between(measure, statistics["unseen"])
    seen_floor = floor_between(measure, statistics["seen"])
    found: dict[str, Any] = {"crop": CROP, "slices": slices, "true_slices": TRUE_SLICES, "floor": floor}
    for kind, true_slices in statistics.items():
        pictures = (measure.statistics(image) for image in views(synthesis, kind, name, slices))
        found[kind], _ = compared(measure, pictures, true_slices, floor)
    found["orientation"], _ = compared(measure, statistics["seen"], statistics["unseen"], floor)
    found["seen_floor"] = {name: seen_floor[name] / floor[name] for name in floor}
    return found


def views(look: Look, kind: str, name: str, count: int) -> Iterator[Tensor]:
    """Slices of as many instances, other ones for each kind."""
    first = SEEDS[kind]
    for seed in range(first, first + count):
        yield look(seed, KINDS[kind](name, torch.Generator().manual_seed(seed)))


def strip(name: str, exemplar: FloatArray, synthesis: Look) -> FloatArray:
    """The exemplar's corner, the truth and the synthesis in one unseen orientation."""
    rotation = unseen(name, torch.Generator().manual_seed(0))
    slices = [look(0, rotation)[0].permute(1, 2, 0).numpy() for look in (true(name), synthesis)]
    return np.concatenate([exemplar[:CROP, :CROP], *slices], axis=1)


def write_results(out: Path) -> None:
    """table.md and table.json of the solids that are finished."""
    finished = {name: cell for name in SOLIDS if (cell := cells.kept(out / f"{name}.json"))}
    cells.keep(out / "table.json", finished)
    with replacing(out / "table.md") as file:
        file.write("\n\n".join(table(name, cell) for name, cell in finished.items()).encode() + b"\n")


def table(name: str, cell: dict[str, Any]) -> str:
    """One solid's table in Markdown."""
    title = f"{name}: {cell['iterations']} iterations, {cell['minutes']:.0f} minutes{', diverged' if cell['diverged'] else ''}"
    if "quality" not in cell:
        return title
    quality = cell["quality"]
    columns = ["floor of the truth", "unseen planes", "exemplar's plane", "truth: exemplar's plane to unseen", "to each other"]
    lines = [title, "", f"| measure | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    for measure, distance in quality["floor"].items():
        figures = [f"{mean:.2f} ± {std:.2f}" for mean, std in (quality[k][measure] for k in ("unseen", "seen", "orientation"))]
        lines.append(f"| {measure} | {distance:.4g} | {' | '.join(figures)} | {quality['seen_floor'][measure]:.2f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(cells.reported(main))
