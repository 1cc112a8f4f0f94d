"""`solidgrain bake`: a texture becomes files."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from solidgrain.bake.flags import add_arguments, make_plan
from solidgrain.runtime.errors import UsageError

if TYPE_CHECKING:
    from solidgrain.bake.plan import Plan
    from solidgrain.runtime import Texture

__all__ = ["add_arguments", "run"]


def run(arguments: argparse.Namespace) -> int:
    from solidgrain.bake.report import describe, summary

    texture = load_texture(arguments)
    plan = make_plan(arguments, texture)
    if not plan.outputs and not arguments.dry_run:
        raise UsageError("nothing to write: give at least one --out FILE or --preview FILE.png")
    plan = to_do(plan, arguments)
    if arguments.dry_run:
        report = describe(plan, texture)
        print(json.dumps(report, indent=2) if arguments.json else summary(report))
        return 0
    report = bake_plan(plan, texture, arguments) if plan.outputs else {**describe(plan, texture), "files": []}
    if arguments.json:
        print(json.dumps(report, indent=2))
    return 0


def load_texture(arguments: argparse.Namespace) -> Texture:
    from solidgrain.runtime import load

    return load(
        arguments.source or "granite",
        bundle=arguments.bundle,
        provider=arguments.provider,
        precision=arguments.precision or "float32",
        threads=arguments.threads,
    )


def to_do(plan: Plan, arguments: argparse.Namespace) -> Plan:
    """The plan without what is done already or must stay, once nothing speaks against it."""
    from solidgrain.bake.checks import check_plan, without_existing
    from solidgrain.bake.manifest import is_complete
    from solidgrain.bake.staging import is_begun

    if arguments.no_clobber:
        plan = without_existing(plan)
    if arguments.resume or arguments.update or arguments.shard:
        plan = replace(plan, outputs=tuple(output for output in plan.outputs if not is_complete(plan, output)))
    begun = [output for output in plan.outputs if is_begun(output.path)] if arguments.resume or arguments.shard else []
    check_plan(plan, arguments.overwrite or arguments.update, begun)
    return plan


def bake_plan(plan: Plan, texture: Texture, arguments: argparse.Namespace) -> dict[str, Any]:
    """Bake, or a share of it, and say so."""
    from solidgrain.bake.baker import bake
    from solidgrain.bake.report import Progress, result

    progress = Progress(arguments.quiet)
    shard = plan.shard(*arguments.shard) if arguments.shard else None
    try:
        baked = bake(plan, texture, progress.show, resume=arguments.resume, shard=shard)
    finally:
        progress.end_line()
    first, stop = shard or (0, plan.size[2])
    progress.finish(plan, baked, stop - first)
    return result(plan, texture.provider, baked)
