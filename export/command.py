"""`solidgrain export`: a training run becomes a bundle."""

from __future__ import annotations

import argparse
import json
import shlex
from pathlib import Path

from solidgrain.bake.arguments import parse_text
from solidgrain.bake.messages import tell, warn


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN", help="a folder made by solidgrain train")
    parser.add_argument("--out", type=Path, required=True, metavar="BUNDLE", help="the bundle folder to write")
    parser.add_argument("--name", type=parse_text, default="", help="name of the texture (default: the bundle folder's name)")
    parser.add_argument("--overwrite", action="store_true", help="replace the bundle if it exists")
    parser.add_argument(
        "--companion", action="store_true", help="of a space: write its critic as well, which solidgrain adapt needs"
    )
    parser.add_argument("--json", action="store_true", help="print the bundle's manifest on stdout")


def run(arguments: argparse.Namespace) -> int:
    from solidgrain.export.from_run import export_run
    from solidgrain.export.from_space_run import export_space_run
    from solidgrain.runtime.bundle import CRITIC, open_bundle
    from solidgrain.runtime.errors import UsageError
    from solidgrain.train.run import is_space

    common, space = (arguments.run, arguments.out, arguments.name, arguments.overwrite), is_space(arguments.run)
    if arguments.companion and not space:
        raise UsageError(f"--companion: adapting needs a texture space, {arguments.run} is one texture's run; leave it out")
    companion = arguments.out / CRITIC
    if arguments.overwrite and companion.is_file() and not arguments.companion:
        warn(f"{companion}: is not written anew without --companion, and solidgrain adapt needs it")
    folder = export_space_run(*common, arguments.companion) if space else export_run(*common)
    bundle = open_bundle(folder)
    if arguments.json:
        print(json.dumps(bundle.manifest, indent=2))
    else:
        source = f"PHOTO --bundle {shlex.quote(str(folder))}" if space else shlex.quote(str(folder))
        tell(f"{folder}: {bundle.size / 1024:.0f} KB; next: solidgrain bake {source} --size 128 --out out.vti")
    return 0
