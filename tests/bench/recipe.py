"""`make recipe-table`: what each departure of the `fast` preset from the paper is worth, by quality over time.

python -m tests.bench.recipe --minutes 6 --threads 1 --seeds 1 --out FOLDER [--only ROW] [--exemplar FILE] [--resume]

Each row is the preset with one setting, or one group of them, as the paper has it. Every row is trained on the same exemplars
with the same seeds, and measured after a third of its minutes, two thirds, and all: VGG-Fréchet and Gram distance of oblique
slices over the exemplar's floor, the geometric mean over exemplars and seeds, and the worst. table.json has all measures.
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
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.photograph import read_exemplar
from solidgrain.train.quality import evaluate
from solidgrain.train.settings import FAST, PAPER, Budget, Settings
from tests.bench import cells
from tests.bench.paper_table import EXEMPLARS

DEFAULTS = [
    EXEMPLARS / "gazebo_tarmac.png",
    EXEMPLARS.parent / "stone128" / "Terrazzo010.png",
    EXEMPLARS.parent / "stone128" / "Marble010.png",
]
MARKS = (1 / 3, 2 / 3, 1.0)  # of the minutes
LARGEST = 256  # pixels: of larger photographs the middle
SMALLEST = 128
SHOWN = ("vgg_frechet", "gram")


def as_paper(*names: str) -> Settings:
    """The preset with those settings as the paper has them."""
    return replace(FAST, **{name: getattr(PAPER, name) for name in names})


ROWS: dict[str, tuple[str, Settings]] = {
    "fast": ("the preset", FAST),
    "critic": ("D starts from N(0,1)", as_paper("critic_start")),
    "colors": ("S speaks red, green, blue", as_paper("principal_colors")),
    "random-rgb": ("both of these", as_paper("critic_start", "principal_colors")),
    "lazy": ("penalty every iteration", as_paper("penalty_every")),
    "gram": ("Gram differences as they are", as_paper("relative_gram")),
    "pooled": ("Gram matrices patch by patch", as_paper("pooled_gram")),
    "octave-rate": ("T_i as fast as the rest", as_paper("octave_rate")),
    "octave-span": ("octaves 2^i", as_paper("octave_span")),
    "orthogonal": ("T_i from N(0,1)", as_paper("orthogonal_start")),
    "noise-weight": ("A from N(0,1)", as_paper("noise_weight_start")),
    "rates": (
        "constant rates",
        as_paper(
            "critic_rate_floor", "critic_half_life", "sampler_rate", "sampler_rate_floor", "sampler_half_life"
        ),
    ),
    "patch": ("patches of 128²", as_paper("patch")),
    "batch": ("batches of 16", as_paper("batch")),
    "rotations": ("Euler angles from [0°, 90°]", as_paper("rotations")),
    "transposed": ("patches are not transposed", as_paper("transposed")),
}  # fmt: skip


def main(argv: Sequence[str] | None = None) -> None:
    parser = cells.arguments_of(__doc__.splitlines()[0], Path("build/recipe"), slices=8)
    parser.add_argument("--seeds", type=int, default=2, metavar="N", help="trainings of each row and exemplar (2)")
    parser.add_argument("--only", action="append", default=[], metavar="ROW", help=f"of {', '.join(ROWS)} (all)")
    parser.add_argument("--exemplar", action="append", type=Path, default=[], metavar="PHOTO", help="instead of the three")
    arguments = parser.parse_args(argv)
    if arguments.minutes is None:
        raise UsageError("--iterations: rows take unlike times for an iteration; give --minutes")
    if strange := [name for name in arguments.only if name not in ROWS]:
        raise UsageError(f"--only {strange[0]}: no such row; expected one of {', '.join(ROWS)}")
    paths = arguments.exemplar or DEFAULTS
    exemplars = {path.stem: middle(path) for path in paths}
    device, _ = cells.prepare(arguments, exemplars=sorted(exemplars))
    for seed in range(arguments.seeds):
        for row in arguments.only or ROWS:
            for name, exemplar in exemplars.items():
                folder = arguments.out / row / f"{name}-{seed}"
                finish_cell(folder, replace(ROWS[row][1], seed=seed), exemplar, arguments.minutes, arguments.slices, device)
                write_results(arguments.out)
    print((arguments.out / "table.md").read_text("utf-8"))


def middle(path: Path) -> FloatArray:
    """An exemplar, or what is in the middle of it."""
    if not path.is_file():
        raise UsageError(f"--exemplar {path}: no such file; give photographs of at least {SMALLEST}x{SMALLEST} pixels")
    pixels = read_exemplar(path, SMALLEST)
    top, left = (max(0, extent - LARGEST) // 2 for extent in pixels.shape[:2])
    return np.ascontiguousarray(pixels[top : top + LARGEST, left : left + LARGEST])


def finish_cell(
    folder: Path, settings: Settings, exemplar: FloatArray, minutes: float, slices: int, device: torch.device
) -> None:
    """Train one row on one exemplar, and measure at each mark what was not measured before."""
    for mark in MARKS:
        result = folder.with_name(f"{folder.name}-{mark:.2f}.json")
        if result.exists():
            continue
        cells.say(f"{folder.parent.name}, {folder.name}: until minute {mark * minutes:g}")
        run = cells.trained(folder, settings, exemplar, Budget(minutes=mark * minutes), device)
        found: dict[str, Any] = {**run.facts, "mark": mark, "settings": asdict(settings)}
        if run.iterations:
            found["quality"] = asdict(evaluate(exemplar, cells.sampling(run.run, device), slices))
        cells.keep(result, found)


def write_results(out: Path) -> None:
    """table.md and table.json of what is finished."""
    found = {row: marks for row in ROWS if (marks := collected(out / row))}
    cells.keep(out / "table.json", found)
    with replacing(out / "table.md") as file:
        file.write(table(found).encode() + b"\n")


def collected(folder: Path) -> dict[str, dict[str, Any]]:
    """What was measured of a row, by the names of its cells."""
    return {path.stem: cell for path in sorted(folder.glob("*.json")) if (cell := cells.kept(path))}


def table(found: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """One line per row, in Markdown."""
    heads = [f"{name} at {mark:.0%}" for name in SHOWN for mark in MARKS]
    lines = [f"| | {' | '.join(heads)} | iterations |", "|---" * (len(heads) + 2) + "|"]
    for row, marks in found.items():
        figures = [figure(marks.values(), name, mark) for name in SHOWN for mark in MARKS]
        last = [cell["iterations"] for cell in marks.values() if cell["mark"] == MARKS[-1]]
        lines.append(f"| {ROWS[row][0]} | {' | '.join(figures)} | {np.mean(last):.0f} |" if last else f"| {ROWS[row][0]} | … |")
    return "\n".join(lines)


def figure(measured: Any, name: str, mark: float) -> str:
    """A measure at a mark: the geometric mean, and the worst."""
    values = [cell["quality"]["oblique"][name][0] for cell in measured if cell["mark"] == mark and "quality" in cell]
    return f"{np.exp(np.mean(np.log(values))):.2f} ({max(values):.2f})" if values else "–"


if __name__ == "__main__":
    sys.exit(cells.reported(main))
