"""`solidgrain verify`: are baked files whole, and are they what their plan says?"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from solidgrain.bake.arguments import parse_count

FAILED_VERIFICATION = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("targets", nargs="+", type=Path, metavar="FILE", help="what was baked (a.vti, a.####.exr), or its .bake.json")
    add("--voxels", type=parse_count, default=256, metavar="N", help="random voxels to evaluate again; 0: checksums only (256)")
    add("--source", metavar="SOURCE", help="the texture, if it is not where it was")
    add("--bundle", metavar="FOLDER", help="the bundle that a texture file belongs to")
    add("--provider", default="auto", help="as for bake (auto)")
    add("--threads", type=parse_count, default=0, metavar="N", help="0: every processor that the process may use (0)")
    add("--json", action="store_true", help="print one JSON object on stdout")


def run(arguments: argparse.Namespace) -> int:
    from solidgrain.bake.verify import verify

    where = {name: getattr(arguments, name) for name in ("source", "bundle", "provider", "threads")}
    found = [verify(target, arguments.voxels, **where) for target in arguments.targets]
    if arguments.json:
        outputs = [{**asdict(one), "output": str(one.output), "sound": not one.wrong} for one in found]
        print(json.dumps({"outputs": outputs}, indent=2))
    else:
        for one in found:
            compared = f"{one.voxels} voxels evaluated again" if one.voxels else "checksums only"
            print("\n".join(one.wrong) if one.wrong else f"{one.output}: {one.files} files whole, {compared}")
    return FAILED_VERIFICATION if any(one.wrong for one in found) else 0
