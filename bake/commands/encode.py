"""`solidgrain encode`: a photograph becomes a texture file, in one pass through a space's encoder."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from solidgrain.bake.flags import add_cut
from solidgrain.bake.messages import tell, tell_next


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("photo", type=Path, metavar="PHOTO", help="a photograph (PNG, JPEG, TIFF, EXR, ...)")
    add("--out", type=Path, required=True, metavar="FILE", help="the texture file to write, .sgt.npz")
    add("--bundle", default="stone", metavar="SPACE", help="embedded name or bundle of the space (stone)")
    add_cut(parser.add_argument_group("the photograph"))
    add("--overwrite", action="store_true", help="replace the file if it exists")
    add("--json", action="store_true", help="print one JSON object on stdout")


def run(arguments: argparse.Namespace) -> int:
    from solidgrain.bake.sources import Cut, check_new, encode_photograph
    from solidgrain.runtime import load_space

    check_new(arguments.out, arguments.overwrite)
    space = load_space(arguments.bundle)
    texture = encode_photograph(space, arguments.photo, Cut(arguments.patch_scale, arguments.crop), tell)
    texture.save(arguments.out)
    latent = texture.data.latent
    report = {
        "texture": str(arguments.out),
        "name": texture.name,
        "space": space.name,
        "sampler_sha256": texture.data.sampler_sha256,
        "texture_sha256": texture.data.sha256,
        "patch_scale": arguments.patch_scale or 1.0,
        "crop": arguments.crop,  # null: the middle
        "latent": [] if latent is None else latent.tolist(),
    }
    if arguments.json:
        print(json.dumps(report, indent=2))
    tell_next(arguments.out, texture.data.sampler_sha256, arguments.bundle)
    return 0
