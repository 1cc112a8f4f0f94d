"""`make space-table`: Table 2 of GramGAN (arXiv 2006.16112v2), a texture space on photographs that it was never trained on.

python -m tests.bench.space_table --bundle BUNDLE --seconds 60 --threads 1 --out FOLDER [--resume]

For each held-out photograph of the bundle's training: crops of the photograph itself (the paper's "ground truth"), the
texture that the space makes of the 128² pixels at its middle, and the same adapted to them with D's and with VGG's features
(Sec. 3.3). Measured are distances over the photograph's own floor, and ALL, the average log-likelihood of small patches
(space_measure.py, `tests.bench.likelihood`). Then the same for one photograph that is no stone at all (the paper's
figure of extrapolation), and with --large for every photograph of a folder. FOLDER gets table.md, table.json, pictures, the
adapted textures, and a folder of results for each photograph; what is there is not made again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import torch

from solidgrain.bake.arguments import parse_count, parse_positive, parse_scale, parse_seconds
from solidgrain.export.evaluation import planes_of
from solidgrain.runtime import SolidgrainError, Space, UsageError, load_space
from solidgrain.runtime.bundle import ENCODER, MAPPING, SAMPLER
from solidgrain.runtime.workers import usable_threads
from solidgrain.train.companion import find_companion
from solidgrain.train.cuts import as_image
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.inception import Inception
from solidgrain.train.photograph import SUFFIXES, read_exemplar
from solidgrain.train.quality import SMALLEST, Measure
from tests.bench import cells, space_pictures, space_report
from tests.bench.paper_table import slice_picture
from tests.bench.space_measure import Reference, cut_crops, measure_slices
from tests.bench.space_methods import ADAPTED, TITLES, Methods, Other, open_henzler

FAR = Path("wood128") / "Wood081.png"  # in cells.EXEMPLARS
LARGE = "large"  # in cells.EXEMPLARS
LARGE_SLICES = 10  # of each kind, at most: a mean is asked of them, and no test


@dataclass
class Subject:
    """A photograph of the table, and the folder of its results."""

    path: Path
    folder: Path
    patch: int  # pixels along each side of what is encoded
    scale: float  # the photograph's pixels in one

    @property
    def name(self) -> str:
        return self.path.name

    @cached_property
    def pixels(self) -> FloatArray:
        """All of it, at the scale that is encoded. Raises ExemplarError if it is unreadable or too small."""
        return read_exemplar(self.path, max(SMALLEST, self.patch), self.scale)

    @property
    def encoded(self) -> FloatArray:
        """The middle, which is all that E and adapting see."""
        top, left = ((extent - self.patch) // 2 for extent in self.pixels.shape[:2])
        return np.ascontiguousarray(self.pixels[top : top + self.patch, left : left + self.patch])

    def forget(self) -> None:
        self.__dict__.pop("pixels", None)


def main(argv: Sequence[str] | None = None) -> None:
    arguments = parser().parse_args(argv)
    torch.set_num_threads(arguments.threads or usable_threads())
    space = load_space(arguments.bundle, threads=arguments.threads)
    groups = {"held-out": held_out(space, arguments), "far": far(space, arguments)}
    if arguments.large:
        groups["large"] = large(space, arguments)
    every = [subject for group in groups.values() for subject in group]
    check(every, arguments.only)
    inception = Inception(arguments.inception) if arguments.inception else None
    measure, methods = Measure(inception), methods_of(space, arguments)
    settle(space, methods.henzler, arguments)
    chosen = [one for one in every if arguments.only is None or one.name in arguments.only]
    missing = fill(chosen, methods, measure, arguments.slices, arguments.out)
    space_pictures.write_interpolations(arguments.out / "interpolation.png", space, [one.encoded for one in groups["held-out"]])
    print((arguments.out / "table.md").read_text("utf-8"))
    if missing:
        raise SolidgrainError(f"{missing} results are missing, for the reasons above; the same command tries them again")


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = made.add_argument
    add("--bundle", type=Path, required=True, metavar="FOLDER", help="the texture space, as solidgrain export made it")
    add("--seconds", type=parse_seconds, default=60.0, metavar="S", help="of adapting, with D and with VGG (60)")
    add("--iterations", type=parse_positive, metavar="N", help="of adapting, in the place of --seconds")
    add("--only-unadapted", action="store_true", help="leave the adapted columns for another time")
    add("--without-vgg", action="store_true", help="leave out what is adapted with VGG's features")
    add("--critic", type=Path, metavar="FILE", help="what adapting with D needs, where the bundle does not hold it")
    add("--henzler", type=Path, metavar="FOLDER", help="a space after Henzler et al., bundle or run, for a column of its own")
    add("--exemplars", type=Path, default=cells.EXEMPLARS, metavar="FOLDER", help=f"holds the photographs ({cells.EXEMPLARS})")
    add("--far", type=Path, metavar="PHOTO", help=f"no stone at all, encoded as it is (FOLDER/{FAR})")
    add("--large", action="store_true", help=f"every photograph of FOLDER/{LARGE} as well, {LARGE_SLICES} slices at most")
    add("--patch-scale", type=parse_scale, default=1.0, metavar="S", help="of --large: their pixels per texture pixel (1)")
    add("--only", nargs="+", metavar="NAME", help="of all these photographs, only those with these file names")
    add("--slices", type=parse_positive, default=50, metavar="N", help="to measure of each kind (50)")
    add("--inception", type=Path, metavar="FILE", help="InceptionV3 weights (pt_inception-*.pth): SIFID as well")
    add("--threads", type=parse_count, default=0, metavar="T", help="0: every processor (0)")
    add("--out", type=Path, default=Path("build/space-table"), metavar="FOLDER", help="results (build/space-table)")
    add("--resume", action="store_true", help="keep what FOLDER holds of the same comparison and go on")
    return made


def held_out(space: Space, arguments: argparse.Namespace) -> list[Subject]:
    """The photographs that the bundle's training never saw, wherever they lie among the exemplars."""
    names = space.bundle.manifest["training"].get("held_out")
    if not names:
        raise UsageError(f"--bundle {arguments.bundle}: its training held nothing out; train a space with --hold-out")
    if not arguments.exemplars.is_dir():
        raise UsageError(f"--exemplars {arguments.exemplars}: no such folder; give the one that holds the photographs")
    every, subjects = sorted(arguments.exemplars.rglob("*")), []
    for name in names:
        found = [path for path in every if path.name == name]
        if len(found) != 1:
            what = f"{len(found)} files are called {name}" if found else f"no file in it is called {name}"
            raise UsageError(f"--exemplars {arguments.exemplars}: {what}, which the space was never shown; expected one")
        subjects.append(Subject(found[0], arguments.out / "held-out" / name, space.patch, 1.0))
    return subjects


def far(space: Space, arguments: argparse.Namespace) -> list[Subject]:
    path = arguments.far or arguments.exemplars / FAR
    if not path.is_file():
        raise UsageError(f"--far {path}: no such file; give a photograph of what the space knows nothing of")
    return [Subject(path, arguments.out / "far" / path.name, space.patch, 1.0)]


def large(space: Space, arguments: argparse.Namespace) -> list[Subject]:
    folder = arguments.exemplars / LARGE
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES)
    if not paths:
        raise UsageError(f"--large: {folder} holds no photographs")
    return [Subject(path, arguments.out / "large" / path.name, space.patch, arguments.patch_scale) for path in paths]


def check(subjects: Sequence[Subject], only: Sequence[str] | None) -> None:
    """All photographs can be read and are large enough, and --only names some of them."""
    if strange := sorted(set(only or ()) - {subject.name for subject in subjects}):
        raise UsageError(
            f"--only {strange[0]}: none of the {len(subjects)} photographs; they are called like {subjects[0].name}"
        )
    for subject in subjects:
        subject.pixels  # noqa: B018
        subject.forget()


def methods_of(space: Space, arguments: argparse.Namespace) -> Methods:
    if not arguments.only_unadapted:
        find_companion(space.bundle, arguments.critic)
    henzler = open_henzler(arguments.henzler, arguments.threads) if arguments.henzler else None
    if henzler and (seen := set(space.bundle.manifest["training"]["held_out"]) - henzler.held_out):
        raise UsageError(f"--henzler {arguments.henzler}: was trained on {min(seen)}; --hold-out the same photographs")
    budget = None if arguments.only_unadapted else budget_of(arguments)
    features = ADAPTED[:1] if arguments.without_vgg else ADAPTED
    return Methods(space, arguments.threads, budget, arguments.critic, henzler, features)


def budget_of(arguments: argparse.Namespace) -> tuple[str, str]:
    """How long to adapt, as `solidgrain adapt` takes it."""
    if arguments.iterations:
        return "--iterations", str(arguments.iterations)
    return "--seconds", f"{arguments.seconds:g}"


def settle(space: Space, henzler: Other | None, arguments: argparse.Namespace) -> None:
    """What results depend on, part by part, so that a part can be added later."""
    out, resume = arguments.out, arguments.resume
    manifest = space.bundle.manifest
    facts = {"bundle": {name: manifest["files"][name] for name in (ENCODER, MAPPING, SAMPLER)}, "slices": arguments.slices}
    facts |= {"iterations": manifest["training"].get("iterations"), "sifid": arguments.inception is not None}
    cells.settle(out, facts, resume)
    cells.settle(out / "far", {"far": (arguments.far or FAR).name}, resume=True)
    if arguments.large:
        cells.settle(out / "large", {"patch-scale": arguments.patch_scale}, resume=True)
    if not arguments.only_unadapted:
        cells.settle(out / "adapted", {"budget": " ".join(budget_of(arguments))}, resume=True)
    if henzler:
        facts = {"henzler": str(arguments.henzler.resolve()), "iterations": henzler.iterations}
        cells.settle(out / "henzler", facts, resume=True)


def fill(subjects: Sequence[Subject], methods: Methods, measure: Measure, slices: int, out: Path) -> int:
    """Make and measure what is not there yet. Returns how many results could not be had."""
    missing = 0
    for columns in methods.passes:
        for number, subject in enumerate(subjects):
            try:
                finish_cells(subject, columns, methods, measure, slices, f"{number + 1} of {len(subjects)}")
            except SolidgrainError as error:
                cells.say(f"left out: {error}")
                missing += 1
            subject.forget()
            space_report.write_results(out)
        space_pictures.write_sheets(out)
    return missing


def finish_cells(subject: Subject, columns: Sequence[str], methods: Methods, measure: Measure, slices: int, place: str) -> None:
    """Some columns of one photograph, unless that was done before."""
    columns = [column for column in columns if not (subject.folder / f"{column}.json").exists()]
    if not columns:
        return
    patch, exemplar = subject.encoded, subject.folder / "exemplar.png"
    if not exemplar.exists():
        write_exactly(exemplar, patch)
    reference = Reference(cut_crops(as_image(subject.pixels), subject.patch), measure)
    planes, count = (
        planes_of(methods.space.bundle),
        min(slices, LARGE_SLICES) if subject.folder.parent.name == "large" else slices,
    )
    for column in columns:
        cells.say(f"{place}, {subject.folder.parent.name}/{subject.name}: {TITLES[column]}")
        found: dict[str, Any]
        if column == "truth":
            found = {**reference.facts(), "truth": reference.of_truth()}
        else:
            sample = methods.sample(column, patch, subject.folder)
            found = {"slices": count, **measure_slices(reference, sample, count, planes)}
            if column in ADAPTED:
                found["adapting"] = cells.kept(subject.folder / f"{column}-adapted.json")
            cells.write_png(subject.folder / f"{column}.png", slice_picture(sample, planes, subject.patch))
        cells.keep(subject.folder / f"{column}.json", found)


def write_exactly(path: Path, pixels: FloatArray) -> None:
    """A PNG of 16 bits, which holds the levels of any 8-bit photograph, and a scaled one to 1/65535."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp.png")
    if not oiio.ImageBuf(pixels).write(str(temporary), oiio.UINT16):
        raise SolidgrainError(f"{path}: cannot be written ({oiio.geterror()})")
    temporary.replace(path)


if __name__ == "__main__":
    sys.exit(cells.reported(main))
