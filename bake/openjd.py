"""Open Job Description: a bake as a job that render farms take (AWS Deadline Cloud, or `openjd run` on one machine).

Specification: "Open Job Description", Template Schemas 2023-09. A template in JSON (which is YAML, too) with two steps: Bake,
one task per shard, and Merge, which depends on it. The plan lies beside the template; its paths are absolute, because a
worker has a working folder of its own. The workers need solidgrain on their PATH and a file system in common.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from solidgrain.bake.farm import anywhere, shard_count
from solidgrain.bake.plan import Plan
from solidgrain.runtime.errors import BakeError
from solidgrain.runtime.files import replacing

JOB, PLAN = "job.json", "plan.json"
NAME_LENGTH = 64  # of a job's name, at most


def emit(
    plan: Plan, folder: Path, shards: int | None = None, overwrite: bool = False, provider: str = "auto", threads: int = 0
) -> list[Path]:
    """Write the template and the plan. Raises BakeError if they cannot be written, or exist and may not be replaced."""
    evaluation = ["--provider", provider] if provider != "auto" else []
    work = ["--threads", str(threads)] if threads else []
    files = {
        folder / JOB: template(plan, shard_count(plan, shards), evaluation, work, overwrite),
        folder / PLAN: anywhere(plan).to_json(),
    }
    if existing := next((path for path in files if path.exists() and not overwrite), None):
        raise BakeError(f"{existing}: already exists; use --overwrite to replace it")
    try:
        folder.mkdir(exist_ok=True)
        for path, values in files.items():
            with replacing(path) as file:
                file.write(json.dumps(values, indent=1).encode() + b"\n")
    except OSError as error:
        raise BakeError(f"--emit-openjd {folder}: cannot write there ({error.strerror})") from error
    return list(files)


def template(plan: Plan, shards: int, evaluation: list[str], work: list[str], overwrite: bool) -> dict[str, Any]:
    """The job: `shards` tasks that bake, with flags of `evaluation`, then one that merges; all with those of `work`."""
    work = [*work, *(["--overwrite"] if overwrite else [])]
    share = ["--shard", f"{{{{Task.Param.Shard}}}}/{shards}"]
    parameter = {"name": "Shard", "type": "INT", "range": f"1-{shards}" if shards > 1 else "1"}
    return {
        "specificationVersion": "jobtemplate-2023-09",
        "name": _name(plan),
        "description": f"{plan.texture}, {len(plan.outputs)} outputs in {shards} shards",
        "parameterDefinitions": [
            {"name": "Plan", "type": "PATH", "objectType": "FILE", "dataFlow": "IN", "default": PLAN},
        ],
        "steps": [
            {
                "name": "Bake",
                "parameterSpace": {"taskParameterDefinitions": [parameter]},
                "script": _script(["bake", "--plan", "{{Param.Plan}}", *share, *evaluation, *work, "--quiet"]),
            },
            {
                "name": "Merge",
                "dependencies": [{"dependsOn": "Bake"}],
                "script": _script(["merge", "{{Param.Plan}}", *work]),
            },
        ],
    }


def _script(arguments: list[str]) -> dict[str, Any]:
    return {"actions": {"onRun": {"command": "solidgrain", "args": arguments}}}


def _name(plan: Plan) -> str:
    """Short, printable, and without what the format would replace."""
    texture = "".join(letter for letter in plan.texture if letter.isprintable() and letter not in "{}")
    return f"solidgrain bake {texture}"[:NAME_LENGTH].rstrip()
