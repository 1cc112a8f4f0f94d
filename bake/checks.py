"""The checks that need no evaluation: can the formats hold it, does it fit on disk and in memory, may it be written?"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from solidgrain.bake.manifest import manifest_path
from solidgrain.bake.plan import Plan, format_bytes, format_size
from solidgrain.bake.staging import staged_bytes
from solidgrain.bake.writers import Output, check_output, output_bytes, output_exists, output_files, scratch_bytes
from solidgrain.runtime.errors import BakeError, UsageError


def check_plan(plan: Plan, overwrite: bool, begun: Sequence[Output] = ()) -> None:
    """Refuse what cannot work, before any voxel is evaluated. Raises BakeError or UsageError with the reason.

    Outputs that are `begun` may have files in place: those that a kill left behind between two renames.
    """
    for output in plan.outputs:
        check_output(output, plan.volume)
        _check_folder(output.path)
    _check_memory(plan)  # before any list as long as the volume is made
    _check_disk(plan)
    taken: set[Path] = set()
    for output in plan.outputs:
        for path in output_files(output, plan.volume):
            _check_file(path, overwrite or output in begun, taken)
    for output in plan.outputs:
        _check_name(manifest_path(output.path).absolute(), taken)


def without_existing(plan: Plan) -> Plan:
    """The plan without the outputs of which a file exists (`--no-clobber`)."""
    _check_memory(plan)
    kept = tuple(output for output in plan.outputs if not output_exists(output, plan.volume))
    return replace(plan, outputs=kept)


def _check_file(path: Path, overwrite: bool, taken: set[Path]) -> None:
    _check_name(path, taken)
    if path.is_dir():
        raise BakeError(f"{path}: is a folder, expected a file name")
    if not overwrite and path.exists():
        raise BakeError(f"{path}: already exists; use --overwrite to replace it or --no-clobber to keep it")


def _check_name(path: Path, taken: set[Path]) -> None:
    if path in taken:
        raise UsageError(f"--out {path}: two outputs would write this file; give each a name of its own")
    taken.add(path)


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
    """The outputs' sizes per file system against its free space, less what an earlier bake has left there."""
    needed: dict[int, tuple[Path, int]] = {}
    for output in plan.outputs:
        folder = output.path.parent
        device = folder.stat().st_dev
        size = output_bytes(output, plan.volume) + scratch_bytes(output, plan.volume) - staged_bytes(output.path)
        needed[device] = (folder, needed.get(device, (folder, 0))[1] + max(0, size))
    for folder, size in needed.values():
        free = shutil.disk_usage(folder).free
        if size > free:
            raise BakeError(
                f"--size {format_size(plan.size)}: the bake needs up to {format_bytes(size)} in {folder.resolve()}, "
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
