"""`make textures`: every embedded texture is measured anew, and its figures go into its model card and into docs/textures.md.

python -m docs.textures [--only NAME] [--resume] [--exemplars FOLDER] [--slices N] [--threads N]

Measures through the runtime, as `solidgrain evaluate --card` does. docs/textures.json keeps what was found, with the sha256 of
the files that it was found of: figures of other files are forgotten, those of textures that are not measured now stay. It is
written after every texture: stopped at any time, the same command goes on with --resume.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from docs.embedded import EXEMPLARS, HERE, embedded_textures, exemplar_of, find_photograph, say
from solidgrain.bake.arguments import parse_count, parse_positive
from solidgrain.export.card import turned
from solidgrain.export.evaluation import measure, planes_of, write_quality
from solidgrain.export.figures import Figures, make_figures
from solidgrain.runtime import SolidgrainError, UsageError, load_texture
from solidgrain.runtime.bundle import Bundle
from solidgrain.runtime.files import replacing
from solidgrain.runtime.workers import usable_threads
from solidgrain.train.copying import Copying
from solidgrain.train.exemplar import NONSTATIONARY
from solidgrain.train.quality import Evaluation
from solidgrain.train.vgg import find_weights

Found = dict[str, Any]  # what `solidgrain evaluate --json` prints, and `files`
PAGE, DATA = "textures.md", "textures.json"
INTRODUCTION = """\
# The embedded textures

Textures that come with the package: `solidgrain bake NAME` bakes them, `load("NAME")` evaluates them. This page is written by
`make textures`, the picture by `make pictures`.

![Each texture: the photograph, an axis-aligned and an oblique slice, and an object cut out of the solid](gallery.jpg)

*axis-aligned*, *oblique*: how many times as far such slices are from the photograph as its own parts are from each other, the
least and the greatest mean of the measures below. *copying*: the ratio, near or above 1 where nothing is copied, and the
share of patches that come closer than 99 % of the photograph's own. [What is measured](training.md#measuring-quality).

Looked at, in slices and in what was cut out: no streaks, no grid, no direction that a photograph does not have. Missing are
outlines of a pixel's width: the plates of the lava, the flakes of the chipboard, leaves of the moss, veins of the marble,
stones of the gravel and of the asphalt. Some edges of the lava are olive, some specks of asphalt and gravel a shade bluer than
they should be, some of the moss more violet. Light falls on the dirt as on its photograph in the planes from xy to xz, and from
elsewhere in others. Of granite-pink, gravel, marble and wood more patches come close than chance gives; the closest of the
gravel are plain grey ones. The photographs of granite, granite-pink, gravel, lichen and marble are among the eighty stones of
`stone`, as which trainings begin."""
HEADER = ("texture", "photograph", "licence", "credit", "axis-aligned", "oblique", "copying")


def main(argv: Sequence[str] | None = None) -> None:
    arguments = parse(argv)
    find_weights()
    torch.set_num_threads(arguments.threads or usable_threads())
    bundles = embedded_textures()
    found = kept(arguments.out / DATA, bundles)
    names = chosen(arguments.only, bundles)
    if arguments.resume:
        names = [name for name in names if name not in found or found[name]["slices"] != arguments.slices]
    photographs = {name: find_photograph(bundles[name], arguments.exemplars) for name in names}
    for name, photograph in photographs.items():
        if photograph is None:
            continue
        say(f"{name}: measuring {2 * arguments.slices} slices")
        texture = load_texture(bundles[name].folder, threads=arguments.threads)
        measured = measure(texture, photograph, arguments.slices)
        write_quality(texture, measured.figures)
        found[name] = {"files": bundles[name].manifest["files"]} | measured.as_json()
        write_results(arguments.out, bundles, found)
    write_results(arguments.out, bundles, found)


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("--only", action="append", default=[], metavar="NAME", help="measure this texture; may be repeated (all)")
    add("--resume", action="store_true", help="leave out textures that have their figures, of as many slices")
    add("--exemplars", type=Path, default=EXEMPLARS, metavar="FOLDER", help=f"where the photographs are ({EXEMPLARS})")
    add("--slices", type=parse_positive, default=100, metavar="N", help="axis-aligned and oblique slices (100)")
    add("--threads", type=parse_count, default=0, metavar="N", help="0: every processor that the process may use (0)")
    add("--out", type=Path, default=HERE, metavar="FOLDER", help=f"where {PAGE} and {DATA} are ({HERE})")
    return parser.parse_args(argv)


def chosen(only: Sequence[str], bundles: Mapping[str, Bundle]) -> list[str]:
    """The textures to measure. Raises UsageError for one that is not embedded."""
    if strange := [name for name in only if name not in bundles]:
        raise UsageError(f"--only {strange[0]}: no such embedded texture; expected one of {', '.join(bundles)}")
    return [name for name in bundles if not only or name in only]


def kept(path: Path, bundles: Mapping[str, Bundle]) -> dict[str, Found]:
    """What was found before of textures that have not changed since."""
    before = json.loads(path.read_text("utf-8")) if path.exists() else {}
    files = {name: bundle.manifest["files"] for name, bundle in bundles.items()}
    return {name: found for name, found in before.items() if found["files"] == files.get(name)}


def write_results(out: Path, bundles: Mapping[str, Bundle], found: Mapping[str, Found]) -> None:
    """The page, and the data that it is made of."""
    data = {name: found[name] for name in bundles if name in found}
    for name, text in ((DATA, json.dumps(data, indent=2) + "\n"), (PAGE, page(bundles, data))):
        with replacing(out / name) as file:
            file.write(text.encode())


def page(bundles: Mapping[str, Bundle], found: Mapping[str, Found]) -> str:
    rows = [summary(name, bundle, found.get(name)) for name, bundle in bundles.items()]
    sections = [section(name, bundle, found.get(name)) for name, bundle in bundles.items()]
    return Figures(INTRODUCTION, HEADER, rows, "\n".join(sections)).markdown()


def summary(name: str, bundle: Bundle, found: Found | None) -> tuple[str, ...]:
    """A texture's row in the first table."""
    said = exemplar_of(bundle)
    ranges = [f"{min(means):.2f} to {max(means):.2f}" for means in means_of(found)] if found else ["–", "–"]
    copying = Copying(**found["copying"]).said() if found else "–"
    stated = (said[key] or "not stated" for key in ("license", "credit"))
    return f"[{name}](#{name})", f"`{said['exemplar']}`", *stated, *ranges, copying


def means_of(found: Found) -> tuple[list[float], list[float]]:
    """Each measure's mean, of axis-aligned and of oblique slices."""
    axis, oblique = ([mean for mean, _ in found[kind].values()] for kind in ("axis", "oblique"))
    return axis, oblique


def section(name: str, bundle: Bundle, found: Found | None) -> str:
    """All that there is to say of a texture."""
    _, photograph, license, credit, *_ = summary(name, bundle, found)
    training = bundle.manifest["training"]
    uneven = (found or {}).get("nonstationarity", 0)
    change = f"; changes across itself: nonstationarity {uneven:.2f}, above {NONSTATIONARY}" if uneven > NONSTATIONARY else ""
    facts = [
        f"- photograph: {photograph}, licence {license}, credit {credit}{change}",
        f"- training: {training['iterations']:,} iterations, {training['minutes']:g} minutes; "
        f"slices {turned(planes_of(bundle))}",
        f"- bundle: {bundle.size / 1024:.0f} KB; "
        f"{bundle.manifest['octaves']} octaves, {bundle.manifest['width']} units a layer",
    ]
    return "\n".join([f"## {name}", "", *facts, "", quality(found) if found else "Not measured yet.", ""])


def quality(found: Found) -> str:
    """The table of `solidgrain evaluate`."""
    evaluation = {key: value for key, value in found.items() if key not in ("files", "nonstationarity", "copying")}
    return make_figures(Evaluation(**evaluation), Copying(**found["copying"])).markdown()


if __name__ == "__main__":
    try:
        main()
    except SolidgrainError as error:
        sys.exit(f"error: {error}")
