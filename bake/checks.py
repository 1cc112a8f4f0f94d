"""The checks that need no evaluation: can the formats hold it, does it fit on disk and in memory, may it be written?"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from solidgrain.bake.engines import ATLASES
from solidgrain.bake.manifest import is_complete, manifest_path, own_manifest
from solidgrain.bake.plan import Plan, format_bytes, format_size
from solidgrain.bake.staging import discard_staging, is_begun, is_foreign, staged_bytes, staging_folder
from solidgrain.bake.writers import PREVIEW, Output, check_output, output_bytes, output_exists, output_files, scratch_bytes
from solidgrain.runtime.errors import BakeError, UsageError

THROUGH_OIIO = (*ATLASES, PREVIEW)  # kinds


def check_plan(plan: Plan, overwrite: bool, begun: Sequence[Output] = (), shard: tuple[int, int] | None = None) -> None:
    """Refuse what cannot work, before any voxel is evaluated. Raises BakeError or UsageError with the reason.

    Outputs that are `begun` may have files in place: those that a kill left behind between two renames. With `shard`, slices
    first .. stop - 1, only their share of the disk must be free.
    """
    for output in plan.outputs:
        check_output(output, plan.volume)
        check_folder(output.path)
        _check_text(output)
    _check_memory(plan)  # before any list as long as the volume is made
    check_disk([plan], shard)
    taken: set[Path] = set()
    for output in plan.outputs:
        for path in output_files(output, plan.volume):
            _check_file(path, overwrite or output in begun, taken)
    for output in plan.outputs:
        _check_own(output.path, taken)


def without_existing(plan: Plan) -> Plan:
    """The plan without the outputs of which a file exists (`--no-clobber`), unless a kill left the rest of them to be done."""
    _check_memory(plan)

    def begun(output: Output) -> bool:
        return is_begun(output.path) and not is_foreign(output.path, plan.work(output))

    kept = (output for output in plan.outputs if begun(output) or not output_exists(output, plan.volume))
    return replace(plan, outputs=tuple(kept))


def without_complete(plan: Plan, discard: bool = True) -> Plan:
    """The plan without the outputs that are whole and of this plan.

    With `discard`, what a kill has left of them is removed. What another plan waits for beside them stays.
    """
    complete = {output.path: output for output in plan.outputs if is_complete(plan, output)}
    for path, output in complete.items():
        if discard and not is_foreign(path, plan.work(output)):
            discard_staging(path)
    return replace(plan, outputs=tuple(output for output in plan.outputs if output.path not in complete))


def leaves_nothing(plan: Plan) -> bool:
    """Whether a bake of a plan that failed left no output, and no part of one."""
    return bool(plan.outputs) and not any(
        staging_folder(output.path).exists() or own_manifest(plan, output) for output in plan.outputs
    )


def _check_file(path: Path, overwrite: bool, taken: set[Path]) -> None:
    _check_name(path, taken)
    if path.is_dir():
        raise BakeError(f"{path}: is a folder, expected a file name")
    if not overwrite and os.path.lexists(path):  # a link to nowhere is somebody's, too
        raise BakeError(f"{path}: already exists; use --overwrite to replace it (or, of bake, --no-clobber to keep it)")


def _check_name(path: Path, taken: set[Path]) -> None:
    real = path.parent.resolve() / path.name
    if real in taken:
        raise UsageError(f"--out {path}: two outputs would write this file; give each a name of its own")
    taken.add(real)


def _check_own(output: Path, taken: set[Path]) -> None:
    """What a bake makes beside an output: its manifest and its staging folder."""
    manifest, staging = manifest_path(output), staging_folder(output)
    _check_name(manifest.absolute(), taken)
    if manifest.is_dir() or (staging.exists() and not staging.is_dir()):
        wrong = manifest if manifest.is_dir() else staging
        raise BakeError(f"{wrong}: is in the way of what a bake of {output.name} keeps there; move it")


def _check_text(output: Output) -> None:
    """OpenImageIO takes names as text."""
    try:
        if output.kind in THROUGH_OIIO:
            os.fspath(output.path).encode()
    except UnicodeEncodeError as error:
        raise BakeError(f"{output.path}: the name is not UTF-8, with which OpenImageIO writes no file; rename it") from error


def check_folder(path: Path) -> None:
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
            f"{format_bytes(available)} are available; bake a smaller x by y, or where files lie across them, less depth"
        )


def check_disk(plans: Sequence[Plan], shard: tuple[int, int] | None = None) -> None:
    """The outputs' sizes per file system against its free space, less what an earlier bake has left there."""
    needed: dict[int, tuple[Path, int]] = {}
    for plan in plans:
        share = 1.0 if shard is None else (shard[1] - shard[0]) / plan.size[2]
        for output in plan.outputs:
            folder = output.path.parent
            device = folder.stat().st_dev
            size = int(share * (output_bytes(output, plan.volume) + scratch_bytes(output, plan.volume)))
            size -= staged_bytes(output.path) if shard is None else 0
            needed[device] = (folder, needed.get(device, (folder, 0))[1] + max(0, size))
    for folder, size in needed.values():
        free = shutil.disk_usage(folder).free
        if size > free:
            who = f"--size {format_size(plans[0].size)}: the bake needs" if len(plans) == 1 else f"all {len(plans)} jobs need"
            raise BakeError(
                f"{who} up to {format_bytes(size)} in {folder.resolve()}, {format_bytes(free)} are free; bake less or elsewhere"
            )


def available_memory() -> int | None:
    """Bytes that this process could still take, or None where the system does not tell."""
    of_machine = _fields(Path("/proc/meminfo")).get("MemAvailable:")
    limits = [] if of_machine is None else [1024 * of_machine]
    return min(limits + _left_by_groups(), default=None)


def _left_by_groups(root: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> list[int]:
    """What the control groups of this process, a container's or a job's, still allow it (Linux, cgroup v2)."""
    try:
        group = next(line[3:] for line in own.read_text().splitlines() if line.startswith("0::"))
    except (OSError, StopIteration):
        return []
    left = []
    for folder in (root / group.strip("/"), *(root / group.strip("/")).parents):
        try:
            limit, used = (int((folder / name).read_text()) for name in ("memory.max", "memory.current"))
        except (OSError, ValueError):  # none here, or "max"
            continue
        left.append(max(0, limit - used + _fields(folder / "memory.stat").get("inactive_file", 0)))
    return left


def _fields(path: Path) -> dict[str, int]:
    """The whole numbers that a file of the kernel lists by name; none of one that is not there."""
    try:
        lines = [line.split() for line in path.read_text("ascii").splitlines()]
    except OSError:
        return {}
    return {line[0]: int(line[1]) for line in lines if len(line) > 1 and line[1].isdecimal()}
