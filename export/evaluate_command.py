"""`solidgrain evaluate`: a texture, through the runtime, measured against the photograph that it was learned from."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from solidgrain.bake.arguments import parse_count, parse_positive

if TYPE_CHECKING:
    from solidgrain.train.quality import Evaluation


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="SOURCE", help="embedded name, bundle or texture file")
    add("--exemplar", type=Path, required=True, metavar="PHOTO", help="the photograph that it was trained on")
    add(
        "--slices", type=parse_positive, default=50, metavar="N", help="axis-aligned and oblique slices, one instance each (50)"
    )
    add("--threads", type=parse_count, default=0, metavar="N", help="0: every processor that the process may use (0)")
    add("--json", action="store_true", help="print one JSON object on stdout")
    add("--card", action="store_true", help="write the table into the bundle's model card")


def run(arguments: argparse.Namespace) -> int:
    from dataclasses import asdict

    from solidgrain.export.card import with_quality
    from solidgrain.runtime import load
    from solidgrain.runtime.bundle import CARD
    from solidgrain.runtime.files import replacing
    from solidgrain.train.exemplar import read_exemplar
    from solidgrain.train.quality import SMALLEST, evaluate

    texture = load(arguments.source, threads=arguments.threads)
    manifest = texture.bundle.manifest
    exemplar = read_exemplar(arguments.exemplar, SMALLEST)
    grain = manifest["training"].get("settings", {}).get("grain", "none")
    print(f"measuring {2 * arguments.slices} slices of {texture.name}", file=sys.stderr)
    evaluation = evaluate(exemplar, texture.sample, arguments.slices, grain)
    print(json.dumps(asdict(evaluation), indent=2) if arguments.json else table(evaluation))
    if arguments.card:
        card = texture.bundle.folder / CARD
        written = card.read_text("utf-8") if card.is_file() else f"# {texture.name}\n"
        with replacing(card) as file:
            file.write(with_quality(written, table(evaluation)).encode())
    return 0


def table(evaluation: Evaluation) -> str:
    """The measures as a table of Markdown."""
    lines = [
        f"Distances to the exemplar over its own floor, mean ± standard deviation over {evaluation.slices} slices of "
        f"{evaluation.crop}² pixels, through the runtime:",
        "",
        "| measure | floor | axis-aligned slices | oblique slices |",
        "|---|---|---|---|",
    ]
    for name, floor in evaluation.floor.items():
        (axis, axis_spread), (oblique, oblique_spread) = evaluation.axis[name], evaluation.oblique[name]
        lines.append(f"| {name} | {floor:.4g} | {axis:.2f} ± {axis_spread:.2f} | {oblique:.2f} ± {oblique_spread:.2f} |")
    return "\n".join(lines)
