"""`make recipe-table`: what each departure of the `fast` preset from the paper is worth, by quality over time.

python -m tests.bench.recipe --marks 2,4,6 --out FOLDER [--only ROW] [--exemplar PHOTO] [--set NAME=VALUE] [--resume]

Each row is the preset with one setting, or one group of them, as the paper has it. Every row is trained on the same exemplars
with the same seeds, and measured after so many minutes of training, or with `--by iterations` at the same iterations on any
machine: VGG-Fréchet and Gram distance of oblique slices over the exemplar's floor, the geometric mean over exemplars and seeds,
and the worst. What another seed does to these means is said below, for it is what a row must surpass. For each mark there
follow the preset's figures of every exemplar by every measure; table.json has everything, and in the end curves.png
the means over time, of rows, or of exemplars where one row alone is run.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from solidgrain.bake.arguments import parse_minutes, parse_positive
from solidgrain.runtime.errors import UsageError
from solidgrain.runtime.files import replacing
from solidgrain.train import exemplar as exemplar_module
from solidgrain.train.begin import with_grain
from solidgrain.train.cuts import Sample
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.inception import Inception
from solidgrain.train.photograph import read_exemplar
from solidgrain.train.quality import evaluate
from solidgrain.train.settings import FAST, PAPER, Budget, Settings
from solidgrain.train.slices import planes_seen
from tests.bench import cells, curves

DEFAULTS = [  # the embedded critic, which FAST starts from, has seen none of them
    cells.EXEMPLARS / "large" / "gazebo_tarmac.png",
    cells.EXEMPLARS / "stone128" / "Terrazzo006.png",
    cells.EXEMPLARS / "stone128" / "Marble018.png",
]
MARKS = [2.0, 4.0, 6.0]
LARGEST = 256  # pixels: of larger photographs the middle
SMALLEST = 128
SHOWN = ("vgg_frechet", "gram")
Found = Mapping[str, Mapping[str, Mapping[str, Any]]]  # by row, then by cell: exemplar, seed and mark


def as_paper(*names: str) -> Settings:
    """The preset with those settings as the paper has them."""
    return replace(FAST, **{name: getattr(PAPER, name) for name in names})


def from_noise(*names: str) -> Settings:
    """The same, with S starting from N(0,1): some settings say how, and say nothing where it starts as a stone."""
    return as_paper("sampler_start", *names)


ROWS: dict[str, tuple[str, Settings]] = {
    "fast": ("the preset", FAST),
    "critic": ("D starts from N(0,1)", as_paper("critic_start")),
    "sampler": ("S starts from N(0,1)", from_noise()),
    "octaves": ("the same, with 16 octaves", from_noise("octaves")),
    "octave-span": ("the same, 16 octaves 2^i", from_noise("octaves", "octave_span")),
    "orthogonal": ("the same, T_i from N(0,1)", from_noise("orthogonal_start")),
    "contrast": ("D sees colours as they are", as_paper("critic_contrast")),
    "colors": ("S speaks red, green, blue", as_paper("principal_colors")),
    "random-rgb": ("the same, D from N(0,1)", as_paper("critic_start", "principal_colors")),
    "lazy": ("penalty every iteration", as_paper("penalty_every")),
    "gram": ("Gram differences as they are", as_paper("relative_gram")),
    "fresh-noise": ("fresh noise tables", as_paper("shared_noise")),
    "critic-rate": ("D learns twice as fast", as_paper("critic_rate", "critic_rate_floor")),
    "sampler-rate": (
        "constant rates of S", as_paper("sampler_rate", "sampler_rate_floor", "sampler_half_life"),
    ),
    "energy": ("slices compared patch by patch", as_paper("gram_energy")),
    "color-weight": ("no L_color", as_paper("color_weight")),
    "alpha": ("alpha 0.1", as_paper("alpha")),
    "alpha-falls": ("alpha stays", as_paper("alpha_half_life")),
    "later-patch": ("patches of 64² all along", as_paper("later_patch")),
    "later-room": ("patches of 128² later from 256² on", as_paper("later_room")),
    "patch": ("patches of 128² all along", as_paper("patch", "later_patch")),
    "batch": ("batches of 16", as_paper("batch")),
    "rotations": ("Euler angles from [0°, 90°]", as_paper("rotations")),
    "transposed": ("patches are not transposed", as_paper("transposed")),
}  # fmt: skip


def main(argv: Sequence[str] | None = None) -> None:
    arguments = parse(argv)
    chosen = arguments.exemplar if arguments.exemplar or arguments.anisotropic else DEFAULTS
    names = [path.stem for path in (*chosen, *arguments.anisotropic)]
    if len(set(names)) < len(names):
        raise UsageError(
            f"--exemplar, --anisotropic: two photographs of the same name ({', '.join(sorted(names))}); rename one"
        )
    exemplars = {path.stem: middle(path, arguments.largest) for path in chosen}
    grained = {path.stem: middle(path, arguments.largest) for path in arguments.anisotropic}
    changes = dict(arguments.set)
    asked = {"marks": arguments.marks, "by": arguments.by, "largest": arguments.largest} | ({"set": changes} if changes else {})
    device, inception = cells.prepare(arguments, **asked)
    for seed in range(arguments.seeds):
        for row in arguments.only or ROWS:
            for name, exemplar in (exemplars | grained).items():
                settings = replace(ROWS[row][1], seed=seed, **changes)
                settings = with_grain(settings, "auto" if name in grained else None, exemplar)
                folder = arguments.out / row / f"{name}-{seed}"
                for mark in arguments.marks:
                    finish_mark(folder, settings, exemplar, mark, arguments.by, arguments.slices, device, inception)
                    write_results(arguments.out, arguments.marks, arguments.by)
    if len(arguments.marks) > 1:
        found = found_in(arguments.out)
        panels = {name: over_time(found, name, arguments.marks) for name in SHOWN}
        curves.draw(arguments.out / "curves.png", panels, arguments.by)
    print((arguments.out / "table.md").read_text("utf-8"))


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = cells.arguments_of(__doc__.splitlines()[0], Path("build/recipe"), slices=8)
    add = parser.add_argument
    add("--marks", type=parse_marks, default=MARKS, metavar="M,M,...", help="when to measure, by minutes or iterations (2,4,6)")
    add("--by", choices=("minutes", "iterations"), default="minutes", help="what marks count (minutes)")
    add("--seeds", type=parse_positive, default=2, metavar="N", help="trainings of each row on each exemplar (2)")
    add("--only", action="append", default=[], choices=ROWS, metavar="ROW", help=f"of {', '.join(ROWS)} (all)")
    add("--exemplar", action="append", type=Path, default=[], metavar="PHOTO", help="instead of the three; may be repeated")
    add("--anisotropic", action="append", type=Path, default=[], metavar="PHOTO", help="another one, with a grain")
    add("--largest", type=parse_positive, default=LARGEST, metavar="PX", help=f"of larger photographs the middle ({LARGEST})")
    add(
        "--set", type=parse_setting, action="append", default=[], metavar="NAME=VALUE", help="of train/settings.py, in all rows"
    )
    arguments = parser.parse_args(argv)
    if arguments.by == "iterations" and any(mark % 1 for mark in arguments.marks):
        raise UsageError(f"--marks {','.join(f'{mark:g}' for mark in arguments.marks)}: expected whole numbers of iterations")
    return arguments


def parse_marks(text: str) -> list[float]:
    return sorted(parse_minutes(mark) for mark in text.split(","))


def parse_setting(text: str) -> tuple[str, Any]:
    """A setting and its value, of the type that it has in the preset."""
    name, _, value = text.partition("=")
    preset = asdict(FAST)
    del preset["seed"]  # --seeds has it
    try:
        kind = type(preset[name])
        return name, {"true": True, "false": False}[value] if kind is bool else kind(value)
    except (KeyError, ValueError):
        raise argparse.ArgumentTypeError(f"expected a setting of train/settings.py and its value, found {text!r}") from None


def middle(path: Path, largest: int) -> FloatArray:
    """An exemplar, or what is in the middle of it."""
    if not path.is_file():
        raise UsageError(f"--exemplar {path}: no such file; give photographs of at least {SMALLEST}x{SMALLEST} pixels")
    return np.ascontiguousarray(exemplar_module.middle(read_exemplar(path, SMALLEST), largest))


def finish_mark(
    folder: Path,
    settings: Settings,
    exemplar: FloatArray,
    mark: float,
    by: str,
    slices: int,
    device: torch.device,
    inception: Inception | None = None,
) -> None:
    """Train one row on one exemplar until a mark, and measure, unless that was done before."""
    result = folder.with_name(f"{folder.name}-{mark:g}.json")
    budget = Budget(minutes=mark) if by == "minutes" else Budget(iterations=round(mark))
    planes = planes_seen(settings)

    def measured(sample: Sample) -> dict[str, Any]:
        return {"quality": asdict(evaluate(exemplar, sample, slices, planes, inception))}

    facts = {"exemplar": folder.name, "mark": mark}
    cells.finish(result, folder, settings, exemplar, budget, device, facts, measured)


def write_results(out: Path, marks: Sequence[float], by: str) -> None:
    """table.md and table.json of what is finished."""
    found = found_in(out)
    cells.keep(out / "table.json", found)
    tables = [
        rows_table(found, marks, by),
        chance(found, marks),
        *(exemplars_table(found.get("fast", {}), mark, by) for mark in marks),
    ]
    with replacing(out / "table.md") as file:
        file.write("\n\n".join(filter(None, tables)).encode() + b"\n")


def over_time(found: Found, name: str, marks: Sequence[float]) -> curves.Curves:
    """A measure's means for each seed at each finished mark: of rows, or of the exemplars where there is one row alone."""
    lines: dict[str, dict[str, Mapping[str, Any]]] = {}
    for row, measured in found.items():
        for key, cell in measured.items():
            title = ROWS[row][0] if len(found) > 1 else cell["exemplar"].rpartition("-")[0]
            lines.setdefault(title, {})[key] = cell
    return {
        title: {mark: means for mark in marks if (means := seed_means(measured, name, mark))}
        for title, measured in lines.items()
    }


def found_in(out: Path) -> Found:
    """What is finished of each row."""
    return {row: measured for row in ROWS if (measured := collected(out / row))}


def collected(folder: Path) -> dict[str, dict[str, Any]]:
    """What was measured of a row, by the names of its files."""
    return {path.stem: cell for path in sorted(folder.glob("*.json")) if (cell := cells.kept(path))}


def rows_table(found: Found, marks: Sequence[float], by: str) -> str:
    """One line per row, in Markdown."""
    lines = titles("", [f"{name}, {mark:g} {by}" for name in SHOWN for mark in marks] + ["iterations", "seconds each"])
    for row, measured in found.items():
        figures = [over_all(values(measured, "oblique", name, mark)) for name in SHOWN for mark in marks]
        longest = max(cell["mark"] for cell in measured.values())
        lengths = [(cell["iterations"], cell["minutes"]) for cell in measured.values() if cell["mark"] == longest]
        iterations, minutes = np.mean(lengths, 0)
        seconds = f"{60 * minutes / iterations:.2f}" if iterations else "–"
        lines.append(f"| {ROWS[row][0]} | {' | '.join(figures)} | {iterations:.0f} | {seconds} |")
    return "\n".join(lines)


def chance(found: Found, marks: Sequence[float]) -> str:
    """How far apart one row's means are for two seeds, in the middle and at most over rows, measures and marks; or ""."""
    apart = []
    for measured, name, mark in product(found.values(), SHOWN, marks):
        apart += [abs(np.log(one / other)) for one, other in combinations(seed_means(measured, name, mark), 2)]
    if not apart:
        return ""
    middle, most = np.expm1([np.median(apart), max(apart)])
    return f"From one seed to another, a row's mean changes by {middle:.0%} (median; {most:.0%} at most)."


def seed_means(measured: Mapping[str, Mapping[str, Any]], name: str, mark: float) -> list[float]:
    """The geometric mean of a measure over exemplars, oblique, for each seed; without seeds that lack some of them."""
    seeds = sorted({cell["settings"]["seed"] for cell in measured.values()})
    of_seeds = [values(measured, "oblique", name, mark, seed) for seed in seeds]
    return [curves.geometric_mean(found) for found in of_seeds if len(found) == max(map(len, of_seeds)) > 0]


def exemplars_table(measured: Mapping[str, Mapping[str, Any]], mark: float, by: str) -> str:
    """The preset's figures at a mark, one line per exemplar and seed: axis-aligned / oblique slices; their median and worst.

    Last, VGG-Fréchet of the exemplar itself, turned by 90°, or with a grain mirrored across it.
    """
    finished = [cell for cell in measured.values() if cell["mark"] == mark and "quality" in cell]
    names = list(finished[0]["quality"]["floor"]) if finished else []
    lines = titles(f"the preset, {mark:g} {by}: axis-aligned / oblique", ["iterations", *names, "itself, turned"])
    for cell in finished:
        turned = cell["quality"]["turned"][SHOWN[0]]
        pairs = [pair(cell["quality"], name) for name in names]
        lines.append(line(cell["exemplar"], f"{cell['iterations']}", pairs, f"{turned:.2f}"))
    if len(finished) > 1:
        pairs = {name: np.array([pair(cell["quality"], name) for cell in finished]) for name in names}
        iterations = f"{np.median([cell['iterations'] for cell in finished]):.0f}"
        lines.append(line("median", iterations, [np.median(pairs[name], 0) for name in names], ""))
        lines.append(line("worst", "", [pairs[name].max(0) for name in names], ""))
    return "\n".join(lines)


def pair(quality: Mapping[str, Any], name: str) -> tuple[float, float]:
    """A measure's means: axis-aligned, oblique."""
    return quality["axis"][name][0], quality["oblique"][name][0]


def line(title: str, iterations: str, pairs: Iterable[Sequence[float]], last: str) -> str:
    figures = " | ".join(f"{axis:.2f} / {oblique:.2f}" for axis, oblique in pairs)
    return f"| {title} | {iterations} | {figures} | {last} |"


def titles(first: str, others: Sequence[str]) -> list[str]:
    return [f"| {first} | {' | '.join(others)} |", "|---" * (len(others) + 1) + "|"]


def values(
    measured: Mapping[str, Mapping[str, Any]], kind: str, name: str, mark: float, seed: int | None = None
) -> list[float]:
    """A measure at a mark, of all exemplars that have it, and of all seeds or one."""
    finished = (cell for cell in measured.values() if cell["mark"] == mark and "quality" in cell)
    return [cell["quality"][kind][name][0] for cell in finished if seed in (None, cell["settings"]["seed"])]


def over_all(found: Sequence[float]) -> str:
    """The geometric mean, and the worst if there are several."""
    if not found:
        return "–"
    worst = f" ({max(found):.2f})" if len(found) > 1 else ""
    return f"{curves.geometric_mean(found):.2f}{worst}"


if __name__ == "__main__":
    sys.exit(cells.reported(main))
