"""`solidgrain verify`: are baked files whole, and are they what their plan says?"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from solidgrain.bake.arguments import parse_count
from solidgrain.bake.messages import tell_error

if TYPE_CHECKING:
    from solidgrain.bake.verify import Verified

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
    from solidgrain.runtime.errors import SolidgrainError

    where = {name: getattr(arguments, name) for name in ("source", "bundle", "provider", "threads")}
    found, failures = [], []
    for target in arguments.targets:
        try:
            found.append(verify(target, arguments.voxels, **where))
        except SolidgrainError as error:  # what is wrong with the others is to be said, too
            failures.append(error)
    if arguments.json:
        outputs = [{**asdict(one), "output": str(one.output), "sound": not one.wrong} for one in found]
        print(json.dumps({"outputs": outputs, "errors": [str(error) for error in failures]}, indent=2))
    else:
        show(found)
    unsound = any(one.wrong for one in found)
    for failure in failures if unsound else failures[1:]:
        tell_error(failure)
    if failures and not unsound:
        raise failures[0]
    return FAILED_VERIFICATION if unsound else 0


def show(found: Sequence[Verified]) -> None:
    """What was found, for people."""
    for one in found:
        compared = f"{one.voxels} voxels evaluated again" if one.voxels else "checksums only"
        print("\n".join(one.wrong) if one.wrong else f"{one.output}: {one.files} files whole, {compared}")
