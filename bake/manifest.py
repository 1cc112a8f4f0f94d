"""What lies beside a finished output: `granite.vti.bake.json`, the plan that it was baked from and its files' checksums."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from solidgrain.bake.farm import seen_from
from solidgrain.bake.frames import in_hashes
from solidgrain.bake.plan import Plan, hash_of
from solidgrain.bake.store import sha256_of
from solidgrain.bake.writers import Output
from solidgrain.runtime.errors import BakeError
from solidgrain.runtime.files import replacing

SUFFIX = ".bake.json"
STAGED = "manifest.json"


def manifest_path(output: Path) -> Path:
    """`a.vti` -> `a.vti.bake.json`: a manifest of its own for every output."""
    return output.with_name(f"{in_hashes(output).name}{SUFFIX}")


def stage_manifest(plan: Plan, output: Output, files: list[dict[str, Any]], staging: Path) -> None:
    """Write, in the staging folder, that an output is complete. `files` have a name ("final"), "bytes" and "sha256"."""
    values = {
        "plan": seen_from(output.path.parent, plan).to_json(),
        "output": in_hashes(output.path).name,
        "work": hash_of(plan.work(output)),
        "files": {file["final"]: {"bytes": file["bytes"], "sha256": file["sha256"]} for file in files},
    }
    with replacing(staging / STAGED) as file:
        file.write(json.dumps(values, indent=1).encode() + b"\n")


def place_manifest(output: Output, staging: Path) -> None:
    """Put it beside its files, which are all in place."""
    os.replace(staging / STAGED, manifest_path(output.path))


def forget_manifest(output: Output) -> dict[str, Any]:
    """Remove the manifest of files that are about to be replaced. Returns its `files`, none if it is not one of ours."""
    path = manifest_path(output.path)
    try:
        manifest = read_manifest(path)
    except BakeError:
        manifest = {"output": "", "files": {}}
    path.unlink(missing_ok=True)
    files: dict[str, Any] = manifest["files"]
    return files if manifest["output"] == in_hashes(output.path).name else {}


def remove_stale(replaced: dict[str, Any], output: Output, files: list[dict[str, Any]]) -> None:
    """Remove what a replaced bake has left besides the new files, such as the last slices of a deeper stack.

    Only files that are still what was baked then.
    """
    for name in set(replaced) - {file["final"] for file in files}:
        path = output.path.parent / name
        if path.is_file() and sha256_of(path) == replaced[name]["sha256"]:
            path.unlink()


def read_manifest(path: Path) -> dict[str, Any]:
    """Raises BakeError if it is missing or not a manifest."""
    try:
        values = json.loads(path.read_bytes())
    except OSError as error:
        advice = "; name what was baked as it was given to --out, such as a.vti or a.####.exr"
        raise BakeError(f"{path}: cannot read the manifest ({error.strerror}){advice}") from error
    except (ValueError, RecursionError) as error:
        raise BakeError(f"{path}: not JSON ({error}); bake again with --overwrite") from error
    if not isinstance(values, dict) or not {"plan", "output", "work", "files"} <= set(values) or not _lists_files(values):
        raise BakeError(f"{path}: not a manifest of solidgrain bake; expected plan, output, work and files")
    return values


def _lists_files(values: dict[str, Any]) -> bool:
    files = values["files"]
    if not isinstance(values["output"], str) or not isinstance(files, dict) or not files:
        return False
    return all(
        isinstance(file, dict) and isinstance(file.get("bytes"), int) and isinstance(file.get("sha256"), str)
        for file in files.values()
    )


def damaged_files(manifest: dict[str, Any], folder: Path) -> list[str]:
    """What is wrong with the files of a manifest: a line for each that is missing or not what was written."""
    wrong = []
    for name, expected in manifest["files"].items():
        path = folder / name
        try:
            if not path.is_file():
                wrong.append(f"{path}: missing")
            elif path.stat().st_size != expected["bytes"]:
                wrong.append(f"{path}: {path.stat().st_size} bytes, expected {expected['bytes']}")
            elif sha256_of(path) != expected["sha256"]:
                wrong.append(f"{path}: its checksum is not the one that was written")
        except OSError as error:
            wrong.append(f"{path}: cannot read it ({error.strerror})")
    return wrong


def own_manifest(plan: Plan, output: Output) -> dict[str, Any] | None:
    """The manifest of an output, if it is of this very plan."""
    try:
        manifest = read_manifest(manifest_path(output.path))
    except BakeError:
        return None
    return manifest if manifest["work"] == hash_of(plan.work(output)) else None


def is_complete(plan: Plan, output: Output) -> bool:
    """Whether the files of an output are there, whole, and of this very plan."""
    manifest = own_manifest(plan, output)
    return manifest is not None and not damaged_files(manifest, output.path.parent)
