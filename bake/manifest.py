"""What lies beside a finished output: `granite.vti.bake.json`, the plan that it was baked from and its files' checksums."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from solidgrain.bake.frames import PATTERN
from solidgrain.bake.plan import Plan, hash_of
from solidgrain.bake.store import sha256_of
from solidgrain.bake.writers import Output
from solidgrain.runtime.errors import BakeError
from solidgrain.runtime.files import replacing

SUFFIX = ".bake.json"


def manifest_path(output: Path) -> Path:
    """`a.vti` -> `a.vti.bake.json`, `a.####.exr` -> `a.exr.bake.json`."""
    name = PATTERN.sub("", output.name, count=1).replace("..", ".").lstrip(".")
    return output.with_name(f"{name}{SUFFIX}")


def write_manifest(plan: Plan, output: Output, files: list[dict[str, Any]], staging: Path) -> Path:
    """Say that an output is complete. `files` have a name ("final"), "bytes" and "sha256".

    It is written in the staging folder, which a kill leaves to the next bake, and then put in place.
    """
    values = {
        "plan": plan.to_json(),
        "output": output.path.name,
        "work": hash_of(plan.work(output)),
        "files": {file["final"]: {"bytes": file["bytes"], "sha256": file["sha256"]} for file in files},
    }
    path, staged = manifest_path(output.path), staging / "manifest.json"
    with replacing(staged) as file:
        file.write(json.dumps(values, indent=1).encode() + b"\n")
    os.replace(staged, path)
    return path


def read_manifest(path: Path) -> dict[str, Any]:
    """Raises BakeError if it is missing or not a manifest."""
    try:
        values = json.loads(path.read_bytes())
    except OSError as error:
        raise BakeError(f"{path}: cannot read the manifest ({error.strerror})") from error
    except ValueError as error:
        raise BakeError(f"{path}: not JSON ({error}); bake again with --overwrite") from error
    if not isinstance(values, dict) or not {"plan", "output", "work", "files"} <= set(values):
        raise BakeError(f"{path}: not a manifest of solidgrain bake; expected plan, output, work and files")
    return values


def damaged_files(manifest: dict[str, Any], folder: Path) -> list[str]:
    """What is wrong with the files of a manifest: a line for each that is missing or not what was written."""
    wrong = []
    for name, expected in manifest["files"].items():
        path = folder / name
        if not path.is_file():
            wrong.append(f"{path}: missing")
        elif path.stat().st_size != expected["bytes"]:
            wrong.append(f"{path}: {path.stat().st_size} bytes, expected {expected['bytes']}")
        elif sha256_of(path) != expected["sha256"]:
            wrong.append(f"{path}: its checksum is not the one that was written")
    return wrong


def is_complete(plan: Plan, output: Output) -> bool:
    """Whether the files of an output are there, whole, and of this very plan."""
    try:
        manifest = read_manifest(manifest_path(output.path))
    except BakeError:
        return False
    return manifest["work"] == hash_of(plan.work(output)) and not damaged_files(manifest, output.path.parent)
