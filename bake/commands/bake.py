"""`solidgrain bake`: a texture becomes files."""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from solidgrain.bake.arguments import parse_count, parse_seed, parse_size, parse_spacing, parse_tile, parse_vector
from solidgrain.runtime.errors import UsageError

if TYPE_CHECKING:
    from solidgrain.bake.baker import Baked
    from solidgrain.bake.plan import Plan
    from solidgrain.bake.writers import Output
    from solidgrain.runtime import Texture


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", nargs="?", default="granite", metavar="SOURCE", help="embedded name, bundle or texture file (granite)")
    add("--size", type=parse_size, default=(128, 128, 128), metavar="N|XxYxZ", help="voxels, x by y by z (128)")
    add("--out", type=Path, action="append", default=[], metavar="FILE", help="granite.####.exr, .vti or .npy; repeatable")
    add("--preview", type=Path, metavar="FILE.png", help="a PNG with three slices and the turned block")
    add("--seed", type=parse_seed, default=0, metavar="N", help="which instance of the texture (0)")
    add(
        "--origin",
        type=parse_vector,
        default=(0.0, 0.0, 0.0),
        metavar="X,Y,Z",
        help="corner of the grid, exemplar pixels (0,0,0)",
    )
    add("--spacing", type=parse_spacing, default=(1.0, 1.0, 1.0), metavar="S|X,Y,Z", help="exemplar pixels per voxel (1)")
    add("--tile", type=parse_tile, default="", metavar="AXES", help="axes that repeat seamlessly, any of xyz")
    add("--vti-type", choices=("uint8", "float32"), default="uint8", help="of the colours in .vti (uint8)")
    add("--start", type=parse_count, default=1, metavar="N", help="number of the first slice of a stack (1)")
    add("--bundle", type=Path, metavar="FOLDER", help="the bundle that a texture file belongs to")
    add("--provider", default="auto", help="auto: the fused kernel, else ONNX Runtime; kernel, cpu, cuda, directml, … (auto)")
    add("--precision", choices=("float32", "bfloat16"), default="float32", help="bfloat16: faster, needs AMX (float32)")
    add("--threads", type=parse_count, default=0, metavar="N", help="0: every processor that the process may use (0)")
    existing = parser.add_mutually_exclusive_group()
    existing.add_argument("--overwrite", action="store_true", help="replace outputs that exist")
    existing.add_argument("--no-clobber", action="store_true", help="skip outputs that exist")
    add("--dry-run", action="store_true", help="print the plan with bytes, memory and time, and stop")
    add("--json", action="store_true", help="print one JSON object on stdout")
    add("--quiet", action="store_true", help="no progress on stderr")


def run(arguments: argparse.Namespace) -> int:
    from solidgrain.bake.baker import bake
    from solidgrain.bake.plan import check_plan, without_existing
    from solidgrain.runtime import load

    texture = load(
        arguments.source,
        bundle=arguments.bundle,
        provider=arguments.provider,
        precision=arguments.precision,
        threads=arguments.threads,
    )
    plan = make_plan(arguments, texture)
    if arguments.no_clobber:
        plan = without_existing(plan)
    check_plan(plan, arguments.overwrite)
    if arguments.dry_run:
        report = describe(plan, texture)
        print(json.dumps(report, indent=2) if arguments.json else summary(report))
        return 0
    if not plan.outputs:
        report = {**describe(plan, texture), "files": []}
    else:
        progress = Progress(arguments.quiet)
        try:
            baked = bake(plan, texture, progress.show)
        finally:
            progress.end_line()
        progress.finish(plan, baked)
        report = result(plan, texture, baked)
    if arguments.json:
        print(json.dumps(report, indent=2))
    return 0


def make_plan(arguments: argparse.Namespace, texture: Texture) -> Plan:
    """The plan that the flags ask for. Raises UsageError when they name no output or an impossible one."""
    from solidgrain.bake.plan import Plan
    from solidgrain.bake.writers import Output, make_output

    outputs: list[Output] = [make_output(path, **_options(path, arguments)) for path in arguments.out]
    if arguments.preview:
        if arguments.preview.suffix.lower() != ".png":
            raise UsageError(f"--preview {arguments.preview}: expected a name that ends in .png")
        outputs.append(Output(arguments.preview, "preview"))
    if not outputs and not arguments.dry_run:
        raise UsageError("nothing to write: give at least one --out FILE or --preview FILE.png")
    return Plan(
        source=arguments.source,
        texture=texture.name,
        sampler_sha256=texture.data.sampler_sha256,
        precision=texture.precision,
        seed=arguments.seed,
        size=arguments.size,
        origin=arguments.origin,
        spacing=arguments.spacing,
        tile=arguments.tile,
        outputs=tuple(outputs),
    )


def _options(path: Path, arguments: argparse.Namespace) -> dict[str, str | int]:
    return {".vti": {"dtype": arguments.vti_type}, ".exr": {"start": arguments.start}}.get(path.suffix.lower(), {})


def describe(plan: Plan, texture: Texture) -> dict[str, Any]:
    """What a bake would take: bytes per output, memory, and seconds from a short run of the sampler."""
    from solidgrain.bake.writers import encoding, output_bytes

    rate = measure_rate(texture, plan.seed)
    tiling = texture.tiling(plan.volume.shape, spacing=plan.spacing, tile=plan.tile)
    return {
        "plan": plan.to_json(),
        "voxels": plan.volume.voxels,
        "bytes_at_most": {str(output.path): output_bytes(output, plan.volume) for output in plan.outputs},
        "color_encoding": {str(output.path): encoding(output) for output in plan.outputs},
        "memory_bytes": plan.memory,
        "seconds": round(plan.volume.voxels / rate, 3),
        "provider": texture.provider,
        "provider_note": texture.provider_note,
        "threads": texture.threads,
        "tile_distortion": [round(float(value), 4) for value in tiling.distortion] if plan.tile else None,
    }


def measure_rate(texture: Texture, seed: int) -> float:
    """Voxels per second, from a small block that is evaluated twice: the first time, tables are made as well."""
    shape = (16, 32, 32 * min(texture.threads, 16))
    texture.grid(shape, seed)
    started = time.monotonic()
    texture.grid(shape, seed)
    return shape[0] * shape[1] * shape[2] / (time.monotonic() - started)


def summary(report: dict[str, Any]) -> str:
    """A dry run for people."""
    from solidgrain.bake.plan import format_bytes, format_size

    plan = report["plan"]
    lines = [f"texture   {plan['texture']}, seed {plan['seed']}", f"size      {format_size(plan['size'])} voxels (x, y, z)"]
    lines += [
        f"output    {path}: at most {format_bytes(size)}, {report['color_encoding'][path]}"
        for path, size in report["bytes_at_most"].items()
    ]
    lines += [
        f"memory    about {format_bytes(report['memory_bytes'])}",
        f"time      about {report['seconds']:.3g} s on {report['threads']} threads, {report['provider']}",
    ]
    if report["tile_distortion"]:
        least, most = min(report["tile_distortion"]), max(report["tile_distortion"])
        lines.append(f"tiling    {plan['tile']}; octaves move by {least:.1%} to {most:.1%}")
    return "\n".join(lines)


def result(plan: Plan, texture: Texture, baked: Baked) -> dict[str, Any]:
    """What `--json` prints after a bake."""
    from solidgrain.bake.writers import encoding

    return {
        "plan": plan.to_json(),
        "files": [str(path) for path in baked.files],
        "color_encoding": {str(output.path): encoding(output) for output in plan.outputs},
        "provider": texture.provider,
        "seconds": round(baked.seconds, 3),
        "evaluation_seconds": round(baked.evaluation_seconds, 3),
        "voxels_per_second": round(plan.volume.voxels / baked.seconds),
        "peak_memory_bytes": peak_memory(),
    }


def peak_memory() -> int:
    """The most bytes that were resident. Linux's ru_maxrss starts at what the parent process had: /proc does not."""
    try:
        status = Path("/proc/self/status").read_text("ascii")
        return int(status.split("VmHWM:")[1].split()[0]) * 1024
    except (OSError, IndexError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


class Progress:
    """A bar on a terminal, two lines in a log."""

    def __init__(self, quiet: bool) -> None:
        self.quiet, self.terminal, self.started = quiet, sys.stderr.isatty(), time.monotonic()

    def show(self, done: int, total: int) -> None:
        if self.quiet or not self.terminal:
            return
        seconds = time.monotonic() - self.started
        filled = 30 * done // total
        left = seconds * (total - done) / done
        print(
            f"\r[{'#' * filled}{'.' * (30 - filled)}] slice {done}/{total}, {left:.0f} s left ",
            end="",
            file=sys.stderr,
            flush=True,
        )

    def end_line(self) -> None:
        """Leave the bar's line, so that whatever is printed next has its own."""
        if self.terminal and not self.quiet:
            print(file=sys.stderr)

    def finish(self, plan: Plan, baked: Baked) -> None:
        if self.quiet:
            return
        rate = plan.volume.voxels / baked.seconds / 1e6
        print(f"{plan.texture}: {len(baked.files)} files in {baked.seconds:.1f} s, {rate:.2f} Mvoxel/s", file=sys.stderr)
