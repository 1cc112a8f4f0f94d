"""A bake as pure data, and the checks that need no evaluation: does it fit on disk and in memory, may it be written?"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from solidgrain.bake.writers import Output, Volume, output_bytes, output_exists, output_files
from solidgrain.runtime.errors import BakeError, UsageError

SLAB_BYTES = 48 * 2**20  # of float32 colour; what a bake holds at a time is a small multiple of it
THICKEST_SLAB = 16  # slices
BASE_MEMORY = 220 * 2**20  # interpreter, libraries, noise tables, the chunks in flight


@dataclass(frozen=True)
class Plan:
    """Everything that the bytes of a bake depend on, and where they go. Vectors are (x, y, z)."""

    source: str
    texture: str  # name of the texture
    sampler_sha256: str
    precision: str
    seed: int
    size: tuple[int, int, int]  # voxels
    origin: tuple[float, float, float]  # exemplar pixels
    spacing: tuple[float, float, float]  # exemplar pixels per voxel
    tile: str  # the axes that repeat, a subset of "xyz"
    outputs: tuple[Output, ...]

    @property
    def volume(self) -> Volume:
        """The grid as writers see it."""
        width, height, depth = self.size
        return Volume(
            shape=(depth, height, width),
            origin=self.origin,
            spacing=self.spacing,
            texture=self.texture,
            sampler_sha256=self.sampler_sha256,
            seed=self.seed,
            tile=self.tile,
        )

    @property
    def slab(self) -> int:
        """Slices per slab: as many as fit `SLAB_BYTES`, at least one."""
        width, height, depth = self.size
        return max(1, min(THICKEST_SLAB, depth, SLAB_BYTES // (width * height * 12)))

    @property
    def memory(self) -> int:
        """An upper estimate of resident bytes: the slab, what writers make of it, coordinates and file names, and the rest."""
        width, height, depth = self.size
        return BASE_MEMORY + 3 * self.slab * width * height * 12 + 64 * (width + height) + 1024 * depth

    def to_json(self) -> dict[str, Any]:
        """The plan as plain data, with the hash that names the work."""
        values = asdict(self)
        values["outputs"] = [{**asdict(output), "path": str(output.path)} for output in self.outputs]
        digest = hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
        return {**values, "hash": digest}


def check_plan(plan: Plan, overwrite: bool) -> None:
    """Refuse what cannot work, before any voxel is evaluated. Raises BakeError or UsageError with the reason."""
    for output in plan.outputs:
        _check_folder(output.path)
    _check_memory(plan)  # before any list as long as the volume is made
    _check_disk(plan)
    taken: set[Path] = set()
    for output in plan.outputs:
        for path in output_files(output, plan.volume):
            _check_file(path, overwrite, taken)


def without_existing(plan: Plan) -> Plan:
    """The plan without the outputs of which a file exists (`--no-clobber`)."""
    _check_memory(plan)
    kept = tuple(output for output in plan.outputs if not output_exists(output, plan.volume))
    return replace(plan, outputs=kept)


def _check_file(path: Path, overwrite: bool, taken: set[Path]) -> None:
    if path in taken:
        raise UsageError(f"--out {path}: two outputs would write this file; give each a name of its own")
    taken.add(path)
    if path.is_dir():
        raise BakeError(f"{path}: is a folder, expected a file name")
    if not overwrite and path.exists():
        raise BakeError(f"{path}: already exists; use --overwrite to replace it or --no-clobber to keep it")


def _check_folder(path: Path) -> None:
    folder = path.parent
    if not folder.is_dir():
        raise BakeError(f"{path}: folder {folder} does not exist; create it first")
    if not os.access(folder, os.W_OK):
        raise BakeError(f"{path}: folder {folder} is not writable")


def _check_memory(plan: Plan) -> None:
    available = available_memory()
    if available is not None and plan.memory > available:
        raise BakeError(
            f"--size {format_size(plan.size)}: one slab needs {format_bytes(plan.memory)} of memory, "
            f"{format_bytes(available)} are available; bake a smaller x by y"
        )


def _check_disk(plan: Plan) -> None:
    """The outputs' sizes per file system against its free space."""
    needed: dict[int, tuple[Path, int]] = {}
    for output in plan.outputs:
        device = output.path.parent.stat().st_dev
        total = needed.get(device, (output.path.parent, 0))[1] + output_bytes(output, plan.volume)
        needed[device] = (output.path.parent, total)
    for folder, size in needed.values():
        free = shutil.disk_usage(folder).free
        if size > free:
            raise BakeError(
                f"--size {format_size(plan.size)}: the outputs need up to {format_bytes(size)} in {folder.resolve()}, "
                f"{format_bytes(free)} are free; bake less or elsewhere"
            )


def available_memory() -> int | None:
    """Bytes that this process could still take, or None where the system does not tell."""
    try:
        lines = Path("/proc/meminfo").read_text("ascii").splitlines()
    except OSError:
        return None
    found = next((line for line in lines if line.startswith("MemAvailable:")), None)
    return None if found is None else int(found.split()[1]) * 1024


def format_bytes(count: float) -> str:
    """A byte count for people, such as "1.5 GB"."""
    for unit in ("B", "KB", "MB", "GB", "TB"):
        if count < 1024:
            return f"{count:.0f} {unit}" if unit in ("B", "KB") else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.0f} PB"


def format_size(size: tuple[int, int, int]) -> str:
    return "x".join(str(extent) for extent in size)
