"""What a bake tells: a dry run's estimate, the result as data, a progress bar."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from solidgrain.bake.baker import Baked, Shard
from solidgrain.bake.plan import Plan, format_bytes, format_size
from solidgrain.bake.writers import output_bytes
from solidgrain.runtime import Texture


def describe(plan: Plan, texture: Texture, shard: Shard | None = None) -> dict[str, Any]:
    """What a bake would take: bytes per output, memory, and seconds, of its shard alone, from a short run of the sampler."""
    rate = measure_rate(texture, plan.seed) / plan.samples
    return {
        "plan": plan.to_json(),
        "voxels": plan.volume.voxels,
        "bytes_at_most": {str(output.path): output_bytes(output, plan.volume) for output in plan.outputs},
        "color_encoding": {str(output.path): output.colorspace for output in plan.outputs},
        "memory_bytes": plan.memory,
        "seconds": round(voxels_of(plan, shard) / rate, 3),
        "provider": texture.provider,
        "provider_note": texture.provider_note,
        "threads": texture.threads,
        "tile_distortion": tile_distortion(plan, texture),
    }


def voxels_of(plan: Plan, shard: Shard | None, without: int = 0) -> int:
    """The voxels of a shard, or of the volume, without so many slices."""
    width, height, depth = plan.size
    first, stop = shard or (0, depth)
    return width * height * (stop - first - without)


def measure_rate(texture: Texture, seed: int) -> float:
    """Samples per second, from a small block that is evaluated twice: the first time, tables are made as well."""
    shape = (16, 32, 32 * min(texture.threads, 16))
    texture.grid(shape, seed)
    started = time.monotonic()
    texture.grid(shape, seed)
    return shape[0] * shape[1] * shape[2] / (time.monotonic() - started)


def summary(report: dict[str, Any]) -> str:
    """A dry run for people."""
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
    if report["provider_note"]:
        lines.append(f"          no fused kernel: {report['provider_note']}")
    if report["tile_distortion"]:
        lines.append(f"tiling    {tiling_line(plan['tile'], report['tile_distortion'])}")
    return "\n".join(lines)


def tile_distortion(plan: Plan, texture: Texture) -> list[float] | None:
    """By how much tiling moved each octave, relative to its transform; None without tiling."""
    tiling = texture.tiling(
        [extent * plan.fine for extent in plan.volume.shape],
        spacing=[step / plan.fine for step in plan.spacing],
        tile=plan.tile,
        transform=plan.transform,
    )
    return [round(float(value), 4) for value in tiling.distortion] if plan.tile else None


def tiling_line(tile: str, distortion: Sequence[float]) -> str:
    return f"{tile}; octaves move by {min(distortion):.1%} to {max(distortion):.1%}"


def result(plan: Plan, texture: Texture, baked: Baked, shard: Shard | None = None) -> dict[str, Any]:
    """What `--json` prints after a bake."""
    return {
        "plan": plan.to_json(),
        "files": [str(path) for path in baked.files],
        "color_encoding": {str(output.path): output.colorspace for output in plan.outputs},
        "provider": texture.provider,
        "provider_note": texture.provider_note,
        "tile_distortion": tile_distortion(plan, texture),
        "seconds": round(baked.seconds, 3),
        "evaluation_seconds": round(baked.evaluation_seconds, 3),
        "voxels_per_second": round(voxels_of(plan, shard, baked.reused_slices) / baked.seconds) if baked.seconds else None,
        "reused_slices": baked.reused_slices,
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
    """A bar on a terminal, one line in a log."""

    def __init__(self, quiet: bool) -> None:
        self.quiet, self.terminal, self.started = quiet, sys.stderr.isatty(), time.monotonic()
        self.already = -1  # slices that were there from the start

    def show(self, done: int, total: int) -> None:
        if self.quiet or not self.terminal:
            return
        if self.already < 0:
            self.already = done
        seconds = time.monotonic() - self.started
        filled = 30 * done // total
        left = f", {seconds * (total - done) / (done - self.already):.0f} s left" if done > self.already else ""
        sys.stderr.write(f"\r[{'#' * filled}{'.' * (30 - filled)}] slice {done}/{total}{left} ")
        sys.stderr.flush()

    def end_line(self) -> None:
        """Leave the bar's line, so that whatever is printed next has its own."""
        if self.terminal and not self.quiet:
            sys.stderr.write("\n")

    def finish(self, plan: Plan, texture: Texture, baked: Baked, shard: Shard | None) -> None:
        if self.quiet:
            return
        if not voxels_of(plan, shard):
            sys.stderr.write(f"{plan.texture}: no slabs in this share\n")
            return
        rate = voxels_of(plan, shard, baked.reused_slices) / baked.seconds / 1e6
        reused = f", {baked.reused_slices} slices were there" if baked.reused_slices else ""
        sys.stderr.write(f"{plan.texture}: {len(baked.files)} files in {baked.seconds:.1f} s, {rate:.2f} Mvoxel/s{reused}\n")
        if distortion := tile_distortion(plan, texture):
            sys.stderr.write(f"tiles along {tiling_line(plan.tile, distortion)}\n")
