"""`solidgrain evaluate`: a texture, through the runtime, measured against the photograph that it was learned from."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from solidgrain.bake.arguments import parse_count, parse_positive, parse_scale
from solidgrain.bake.checks import check_folder
from solidgrain.bake.messages import tell, warn
from solidgrain.runtime.errors import UsageError

SHEETS = (".png", ".html")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="SOURCE", help="embedded name, bundle or texture file")
    add("--bundle", metavar="FOLDER", help="the bundle of a texture file")
    add("--exemplar", type=Path, required=True, metavar="PHOTO", help="the photograph that it was trained on")
    add(
        "--patch-scale",
        type=parse_scale,
        metavar="S",
        help="photograph's pixels per exemplar pixel (as it was trained or encoded)",
    )
    add(
        "--slices", type=parse_positive, default=50, metavar="N", help="axis-aligned and oblique slices, one instance each (50)"
    )
    add("--inception", type=Path, metavar="FILE", help="InceptionV3 weights (pt_inception-*.pth): measure SIFID as well")
    add("--sheet", type=Path, metavar="FILE", help="write pictures and figures into a .png or a .html")
    add("--threads", type=parse_count, default=0, metavar="N", help="0: every processor that the process may use (0)")
    add("--json", action="store_true", help="print one JSON object on stdout")
    add("--card", action="store_true", help="write the table into the bundle's model card")


def run(arguments: argparse.Namespace) -> int:
    import torch

    from solidgrain.export.evaluation import exemplar_scale, is_exemplar, measure, planes_of, write_quality
    from solidgrain.export.sheet import make_sheet, write_sheet
    from solidgrain.runtime import load_texture
    from solidgrain.runtime.blend_file import BlendData
    from solidgrain.runtime.bundle import CARD
    from solidgrain.runtime.workers import usable_threads
    from solidgrain.train.inception import Inception
    from solidgrain.train.photograph import read_photograph, scaled
    from solidgrain.train.quality import SMALLEST
    from solidgrain.train.run import pixels_sha256

    if arguments.sheet:
        check_sheet(arguments.sheet, arguments.exemplar)
    torch.set_num_threads(arguments.threads or usable_threads())
    inception = Inception(arguments.inception) if arguments.inception else None
    texture = load_texture(arguments.source, bundle=arguments.bundle, threads=arguments.threads)
    if isinstance(texture.data, BlendData):
        raise UsageError(f"{arguments.source}: is a blend in space, which has no exemplar of its own; evaluate its ends")
    if arguments.card:
        check_folder(texture.bundle.folder / CARD)
    if arguments.card and texture.bundle.is_space:
        raise UsageError(f"--card: {texture.bundle.name} is a space, its card not that of one texture; leave --card out")
    scale = arguments.patch_scale or exemplar_scale(texture)
    smaller = "use a larger photograph or a smaller --patch-scale"
    photograph, _, warning = read_photograph(arguments.exemplar, round(SMALLEST * scale), smaller)
    if warning:
        warn(f"{arguments.exemplar}: {warning}")
    if not texture.bundle.is_space and not is_exemplar(texture.bundle, photograph):
        if arguments.card:
            raise UsageError(
                f"--card: {texture.name} was not learned from {arguments.exemplar}, by its pixels; leave --card out"
            )
        warn(f"{arguments.exemplar}: {texture.name} was not learned from it, by its pixels")
    exemplar = scaled(photograph, scale)
    reduced = "" if scale == 1 else f", of whose pixels {scale:g}x{scale:g} are one"
    tell(f"measuring {2 * arguments.slices} slices of {texture.name} against {arguments.exemplar}{reduced}")
    found = measure(texture, exemplar, arguments.slices, inception, tell)
    figures = found.figures
    about = {
        "texture": texture.name,
        "texture_sha256": texture.data.sha256,
        "sampler_sha256": texture.data.sampler_sha256,
        "exemplar": str(arguments.exemplar),
        "exemplar_sha256": pixels_sha256(exemplar),  # as the manifest of its training has it
        "patch_scale": scale,
    }
    print(json.dumps(about | found.as_json(), indent=2) if arguments.json else figures.markdown())
    if arguments.sheet:
        sheet = make_sheet(texture.name, exemplar, texture.sample, planes_of(texture.bundle), found.pairs, figures)
        write_sheet(arguments.sheet, sheet)
    if arguments.card:
        write_quality(texture, figures)
    return 0


def check_sheet(sheet: Path, exemplar: Path) -> None:
    """Raises UsageError for a sheet that could not be written, before minutes are spent on measuring."""
    if sheet.suffix.lower() not in SHEETS:
        raise UsageError(f"--sheet {sheet}: expected a name that ends in {' or '.join(SHEETS)}")
    if not sheet.parent.is_dir():
        raise UsageError(f"--sheet {sheet}: no folder {sheet.parent}; make it first")
    if sheet.exists() and exemplar.exists() and sheet.samefile(exemplar):
        raise UsageError(f"--sheet {sheet}: is the exemplar itself; choose another name")
    if sheet.is_dir():
        raise UsageError(f"--sheet {sheet}: is a folder; choose another name")
    check_folder(sheet)
