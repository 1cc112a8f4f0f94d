"""`solidgrain bake`: a texture becomes files."""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from solidgrain.bake.flags import add_arguments, check_dither, make_plan
from solidgrain.bake.messages import tell, tell_error
from solidgrain.bake.modes import check_modes
from solidgrain.bake.sources import Encoded
from solidgrain.runtime.errors import UsageError

if TYPE_CHECKING:
    from solidgrain.bake.baker import Shard
    from solidgrain.bake.plan import Plan
    from solidgrain.bake.writers import Output, Volume
    from solidgrain.runtime import Texture

__all__ = ["add_arguments", "run"]


def run(arguments: argparse.Namespace) -> int:
    from solidgrain.bake.baker import Baked
    from solidgrain.bake.report import describe, result, summary

    check_modes(arguments)
    if arguments.jobs:
        return run_jobs(arguments)
    encoded = Encoded(tell)
    encoded.settle(arguments)
    plan, texture = planned(arguments, encoded)
    if not plan.outputs and not arguments.dry_run:
        raise UsageError("nothing to write: give at least one --out FILE or --preview FILE.png")
    asked, plan = plan, to_do(plan, arguments)
    left_out = [output for output in asked.outputs if output not in plan.outputs]
    skipped = [str(output.path) for output in left_out]
    for output in [] if arguments.quiet else left_out:
        tell(f"{output.path}: skipped, {present(output, asked.volume)}")
    if arguments.dry_run:
        encoded.tell_missing()
        report = describe(plan, texture, asked_shard(plan, arguments))
        print(json.dumps(report, indent=2) if arguments.json else summary(report))
        return 0
    try:
        encoded.save([plan])
        if arguments.emit_openjd and (plan.outputs or arguments.update):
            report = emit_job(asked if arguments.update else plan, arguments)  # its shards leave out what is whole
        else:
            report = bake_plan(plan, texture, arguments) if plan.outputs else result(plan, texture, Baked([], 0.0))
    except BaseException:
        encoded.remove_unused([plan])
        raise
    if arguments.json:
        print(json.dumps({**report, "skipped": skipped}, indent=2))
    return 0


def present(output: Output, volume: Volume) -> str:
    """How many of an output's files are there."""
    from solidgrain.bake.writers import output_files

    files = output_files(output, volume)
    count = sum(os.path.lexists(path) for path in files)
    return (
        "its files are there" if count == len(files) else f"{count} of its {len(files)} files are there; --update completes it"
    )


def planned(arguments: argparse.Namespace, encoded: Encoded) -> tuple[Plan, Texture]:
    """The plan that the flags ask for, or the one that --plan names, and its texture."""
    if arguments.plan is None:
        texture = encoded.load(arguments) or load_texture(arguments)
        plan = make_plan(arguments, texture)
        check_dither(arguments, plan.outputs)
        return plan, texture
    from solidgrain.bake.evaluate import check_place
    from solidgrain.bake.plan import located
    from solidgrain.bake.schema import load_plan
    from solidgrain.bake.verify import check_texture

    if encoded.load(arguments):
        raise UsageError(
            f"--plan {arguments.plan}: takes a texture file for SOURCE; solidgrain encode makes one of the photograph"
        )
    plan = load_plan(arguments.plan)
    source, bundle = (given and located(given) for given in (arguments.source, arguments.bundle))
    plan = replace(plan, source=source or plan.source, bundle=bundle or plan.bundle)
    of_plan = {"source": plan.source, "bundle": plan.bundle, "precision": plan.precision}
    texture = load_texture(argparse.Namespace(**{**vars(arguments), **of_plan}))
    check_texture(plan, texture, f"--plan {arguments.plan}")
    check_place(plan, texture)
    return plan, texture


def run_jobs(arguments: argparse.Namespace) -> int:
    """Bake, or plan, every job of a job file. Exit code 1 if one failed."""
    from solidgrain.bake.jobs import FAILED, bake_jobs, in_turn, plan_jobs, read_jobs
    from solidgrain.bake.report import describe, summary

    encoded = Encoded(tell)
    read = read_jobs(arguments.jobs, arguments)
    jobs, textures = plan_jobs(read, encoded.settle, lambda named: encoded.load(named) or load_texture(named), to_do)
    if arguments.dry_run:
        encoded.tell_missing()
        plans = [{"name": one.job.name, **describe(one.plan, texture)} for one, texture in in_turn(jobs, textures)]
        print(json.dumps({"jobs": plans}, indent=2) if arguments.json else "\n\n".join(map(summary, plans)))
        return 0
    try:
        encoded.save(one.plan for one in jobs)
        report = bake_jobs(jobs, textures, bake_plan, tell_error, arguments.continue_on_error)
    finally:
        encoded.remove_unused(one.plan for one in jobs)
    if arguments.json:
        print(json.dumps({"jobs": report}, indent=2))
    return 1 if any(job["status"] == FAILED for job in report) else 0


def emit_job(plan: Plan, arguments: argparse.Namespace) -> dict[str, Any]:
    """Write the plan as a job for a render farm."""
    from solidgrain.bake.openjd import emit

    overwrite = arguments.overwrite or arguments.update
    files = emit(plan, arguments.emit_openjd, arguments.shards, overwrite, arguments.provider, arguments.threads)
    return {"plan": plan.to_json(), "files": [str(path) for path in files]}


def load_texture(arguments: argparse.Namespace) -> Texture:
    from solidgrain.runtime import load_texture

    return load_texture(
        arguments.source or "granite",
        bundle=arguments.bundle,
        provider=arguments.provider,
        precision=arguments.precision or "float32",
        threads=arguments.threads,
    )


def asked_shard(plan: Plan, arguments: argparse.Namespace) -> Shard | None:
    """The slices that --shard asks for, None for all of them."""
    return plan.shard(*arguments.shard) if arguments.shard else None


def to_do(plan: Plan, arguments: argparse.Namespace) -> Plan:
    """The plan without what is done already or must stay, once nothing speaks against it. A dry run removes nothing."""
    from solidgrain.bake.checks import check_plan, without_complete, without_existing
    from solidgrain.bake.staging import clear_leftovers, is_begun

    anew, shared = arguments.overwrite or arguments.update, arguments.shard or arguments.dask
    if arguments.no_clobber:
        plan = without_existing(plan)
    if arguments.resume or arguments.update or shared:
        plan = without_complete(plan, discard=not arguments.dry_run)
    shard = asked_shard(plan, arguments)
    goes_on = arguments.resume or arguments.no_clobber or shared
    check_plan(plan, anew, [output for output in plan.outputs if goes_on and is_begun(output.path)], shard)
    if (shared or arguments.resume) and not (arguments.dry_run and anew):  # it would be removed, not refused
        for output in plan.outputs:
            clear_leftovers(output.path, plan.work(output), anew)
    return plan


def bake_plan(plan: Plan, texture: Texture, arguments: argparse.Namespace) -> dict[str, Any]:
    """Bake, or a share of it, here or on a cluster, and say so."""
    from solidgrain.bake.baker import bake
    from solidgrain.bake.distributed import bake_on_cluster
    from solidgrain.bake.report import Progress, result

    if texture.provider_note and not arguments.quiet:
        tell(f"{plan.texture}: evaluated by {texture.provider}, no fused kernel: {texture.provider_note}")
    progress = Progress(arguments.quiet)
    shard, details = asked_shard(plan, arguments), {}
    try:
        if arguments.dask:
            anew = arguments.overwrite or arguments.update
            options = {"overwrite": anew, "provider": arguments.provider, "threads": arguments.threads}
            baked, told = bake_on_cluster(plan, texture, arguments.dask, arguments.shards, progress.show, **options)
            details = {"shards": told}
        else:
            baked = bake(plan, texture, progress.show, resume=arguments.resume, shard=shard)
    finally:
        progress.end_line()
    progress.finish(plan, texture, baked, shard)
    return {**result(plan, texture, baked, shard), **details}
