"""`solidgrain merge`: the files of a plan, once all of its shards have been baked."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from solidgrain.bake.arguments import parse_count
from solidgrain.bake.messages import tell
from solidgrain.runtime.errors import BakeError, UsageError

if TYPE_CHECKING:
    from solidgrain.bake.plan import Plan


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("target", type=Path, metavar="TARGET", help="the plan file that was sharded, or the output (a.vti, a.####.exr)")
    add("--overwrite", action="store_true", help="replace outputs that exist")
    add("--threads", type=parse_count, default=0, metavar="N", help="0: every processor that the process may use (0)")
    add("--json", action="store_true", help="print one JSON object on stdout")
    add("--quiet", action="store_true", help="no message on stderr")


def run(arguments: argparse.Namespace) -> int:
    from solidgrain.bake.baker import merge
    from solidgrain.runtime.workers import Workers

    plan = to_merge(find_plan(arguments.target), arguments.overwrite)
    merged = merge(plan, Workers(arguments.threads))
    files = [str(path) for path in merged.files]
    if arguments.json:
        print(json.dumps({"plan": plan.to_json(), "files": files, "seconds": round(merged.seconds, 3)}, indent=2))
    if not arguments.quiet:
        told = f"{len(files)} files in {merged.seconds:.1f} s" if files else "nothing to merge, its files are whole"
        tell(f"{plan.texture}: {told}")
    return 0


def find_plan(target: Path) -> Plan:
    """The plan of a file; of an output, the one that its shards were baked for. Raises UsageError."""
    from solidgrain.bake.manifest import manifest_path
    from solidgrain.bake.schema import load_plan, plan_of, read_data, seen_in
    from solidgrain.bake.staging import PLAN, staging_folder

    if target.suffix.lower() == ".json":
        return load_plan(target)
    if (kept := staging_folder(target) / PLAN).exists():
        return seen_in(target.parent, plan_of(read_data(kept), str(kept)))
    if manifest_path(target).exists():
        return load_plan(manifest_path(target))
    raise UsageError(f"{target}: no shard of it has been baked here; expected an output with shards, or a plan file")


def to_merge(plan: Plan, overwrite: bool) -> Plan:
    """The plan without the outputs that are whole already, once nothing speaks against the others. Raises BakeError."""
    from solidgrain.bake.checks import check_plan, without_complete
    from solidgrain.bake.staging import is_begun, staging_folder

    plan = without_complete(plan)
    check_plan(plan, overwrite, [output for output in plan.outputs if is_begun(output.path)])
    for output in plan.outputs:
        if not staging_folder(output.path).is_dir():
            raise BakeError(f"{output.path}: slices 0 to {plan.size[2] - 1} are missing; bake their shards first")
    return plan
