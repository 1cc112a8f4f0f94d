"""Many bakes from one file: `--jobs jobs.json` (or .toml).

A job's keys are the flags of `solidgrain bake` with `_` for `-`, and `name` and `texture`; `defaults` hold for all jobs that
have a use for them. An output is a file name, or an object with `path` and settings of its format. Relative paths are relative
to the job file's folder. All jobs are checked before the first is baked.
"""

from __future__ import annotations

import argparse
import difflib
import json
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from solidgrain.bake.modes import WORK
from solidgrain.runtime.errors import BakeError, SolidgrainError, UsageError

if TYPE_CHECKING:
    from solidgrain.bake.plan import Plan
    from solidgrain.bake.writers import Output
    from solidgrain.runtime import Texture

DONE, FAILED, SKIPPED = "done", "failed", "skipped"
OWN = ("name", "texture", "bundle", "out", "preview")  # keys that are more than the value of a flag
PLAIN = frozenset((*WORK, "out", "preview"))  # flags that are no setting of a job, or one of its own keys

Load = Callable[[argparse.Namespace], "Texture"]
ToDo = Callable[["Plan", argparse.Namespace], "Plan"]
Bake = Callable[["Plan", "Texture", argparse.Namespace], dict[str, Any]]


@dataclass(frozen=True)
class Job:
    """A bake as its flags would say it. `settings` are of single outputs, by their paths."""

    name: str
    where: str  # file and place, for errors
    arguments: argparse.Namespace
    settings: dict[Path, dict[str, str | int]]

    @property
    def texture(self) -> tuple[str, str | None, str | None]:
        """What tells its texture from another job's."""
        return (self.arguments.source or "granite", self.arguments.bundle, self.arguments.precision or "float32")


@dataclass(frozen=True)
class Planned:
    """A job that can be baked. Its plan lacks the outputs that need nothing."""

    job: Job
    plan: Plan


class JobParser(argparse.ArgumentParser):
    """The flags of `solidgrain bake`, for the values of a job."""

    def __init__(self) -> None:
        from solidgrain.bake.flags import add_arguments

        super().__init__(add_help=False, allow_abbrev=False)
        add_arguments(self)

    @property
    def keys(self) -> list[str]:
        """What a job may say besides its own keys."""
        flags = (flag for action in self._actions for flag in action.option_strings)
        return sorted({flag.lstrip("-").replace("-", "_") for flag in flags} - PLAIN)

    def is_switch(self, flag: str) -> bool:
        """Whether a flag has no value."""
        return next(action.nargs == 0 for action in self._actions if flag in action.option_strings)

    def error(self, message: str) -> NoReturn:
        flag = re.match(r"argument --([a-z-]+): ", message)
        raise UsageError(f"{flag[1].replace('-', '_')}: {message[flag.end() :]}" if flag else message)


def read_jobs(path: Path, work: argparse.Namespace) -> list[Job]:
    """The jobs of a file, to be worked off as the flags `work` say. Raises UsageError."""
    from solidgrain.bake.schema import read_data, validate

    values = read_data(path)
    validate(values, "jobs", str(path))
    parser, defaults = JobParser(), values.get("defaults", {})
    jobs: list[Job] = []
    for number, own in enumerate(values["jobs"]):
        where = f"{path}: jobs[{number}] {own['name']!r}"
        if any(job.name == own["name"] for job in jobs):
            raise UsageError(f"{where}: another job has this name, give each its own")
        with _named(where):
            jobs.append(_read_job(parser, {**_of_use(defaults, own, path.parent), **own}, where, path.parent, work))
    return jobs


def _of_use(defaults: dict[str, Any], own: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The defaults that a job has a use for: not the settings of formats that it does not write, nor what it says otherwise."""
    from solidgrain.bake.flags import unused
    from solidgrain.bake.sources import is_photograph

    values = {**defaults, **own}
    idle = {flag[2:].replace("-", "_") for flag in unused([Path(output["path"]) for output in _outputs(values)])}
    if not values.get("mips"):
        idle.add("mip_filter")
    if not is_photograph(os.fspath(folder / values.get("texture", ""))):
        idle |= {"patch_scale", "crop"}
    if "box" in own:
        idle |= {"origin", "spacing"}
    if {"origin", "spacing"} & own.keys():
        idle.add("box")
    return {key: value for key, value in defaults.items() if key not in idle}


def _outputs(values: dict[str, Any]) -> list[dict[str, Any]]:
    """A job's outputs, each with its path and settings."""
    given = values.get("out", [])
    return [{"path": out} if isinstance(out, str) else dict(out) for out in (given if isinstance(given, list) else [given])]


def _read_job(parser: JobParser, values: dict[str, Any], where: str, folder: Path, work: argparse.Namespace) -> Job:
    arguments = argparse.Namespace(**{name: value for name, value in vars(work).items() if name in WORK})
    parser.parse_args(
        [word for key, value in values.items() if key not in OWN for word in _flag(parser, key, value)], arguments
    )
    arguments.source = _source(values.get("texture"), folder)
    arguments.bundle = _source(values.get("bundle"), folder)
    outputs = _outputs(values)
    settings = {(folder / out.pop("path")).absolute(): out for out in outputs}
    if len(settings) < len(outputs):
        raise UsageError("out: two outputs have the same name")
    arguments.out = list(settings)
    arguments.preview = folder / values["preview"] if "preview" in values else None
    if not arguments.out and not arguments.preview:
        raise UsageError("nothing to write: give it out or preview")
    return Job(values["name"], where, arguments, settings)


def _flag(parser: JobParser, key: str, value: Any) -> list[str]:
    """A key and its value as words of a command line."""
    if key not in parser.keys:
        close = difflib.get_close_matches(key, [*parser.keys, *OWN], 1)
        advice = f"; did you mean {close[0]}?" if close else ", expected a flag of solidgrain bake"
        if key in WORK:
            advice = f": how all jobs are worked off is said beside --jobs, by --{key.replace('_', '-')}"
        raise UsageError(f"unknown key {key!r}{advice}")
    flag = f"--{key.replace('_', '-')}"
    switch, found = parser.is_switch(flag), json.dumps(value)
    if switch != isinstance(value, bool):
        raise UsageError(f"{key}: expected {'true or false' if switch else 'a value'}, found {found}")
    if switch:
        return [flag] if value else []
    return [f"{flag}={','.join(map(str, _flat(value)))}"]


def _flat(value: Any) -> Iterator[Any]:
    from solidgrain.bake.schema import whole

    if isinstance(value, list):
        for part in value:
            yield from _flat(part)
    else:
        yield whole(value)


def _source(name: str | None, folder: Path) -> str | None:
    """A texture or bundle by its embedded name, or by its path from the job file's folder."""
    from solidgrain.bake.plan import is_there
    from solidgrain.runtime.bundle import embedded_bundles, embedded_folder

    if name is None:
        return None
    if name not in embedded_bundles():
        return os.fspath(folder / name) if os.sep in name or (folder / name).exists() else name
    if is_there(folder / name):
        return os.fspath(folder / name)
    return os.fspath(embedded_folder(name)) if is_there(Path(name)) else name  # not what lies in the working folder


def plan_jobs(
    jobs: Sequence[Job], settle: Callable[[argparse.Namespace], None], load: Load, to_do: ToDo
) -> tuple[list[Planned], dict[object, Texture]]:
    """Plans for all jobs and their textures, each loaded once, after every check. Raises what speaks against any of them.

    `settle` turns photographs among the sources into texture files.
    """
    from solidgrain.bake.checks import check_disk
    from solidgrain.bake.flags import make_plan

    textures: dict[object, Texture] = {}
    planned: list[Planned] = []
    for job in jobs:
        with _named(job.where):
            settle(job.arguments)
            if job.texture not in textures:
                textures[job.texture] = load(job.arguments)
            plan = make_plan(job.arguments, textures[job.texture])
            plan = replace(plan, outputs=tuple(with_settings(output, job) for output in plan.outputs))
            planned.append(Planned(job, plan))
    checked = []
    for one in planned:
        with _named(one.job.where):
            checked.append(replace(one, plan=to_do(one.plan, one.job.arguments)))
    check_disk([one.plan for one in checked])
    _check_names(planned)  # last: the list of a volume's files is bounded by its memory, which is checked now
    return checked, textures


def with_settings(output: Output, job: Job) -> Output:
    """One of a job's outputs, with what the job says of it alone. Raises UsageError."""
    from solidgrain.bake.engines import axes_for
    from solidgrain.bake.flags import asked_options
    from solidgrain.bake.schema import checked_output
    from solidgrain.bake.writers import PREVIEW
    from solidgrain.bake.writers.orient import UPRIGHT

    own = {"engine" if key == "for" else key: value for key, value in job.settings.get(output.path, {}).items()}
    if "engine" in own and "axes" not in own:
        own["axes"] = axes_for(str(own["engine"]), output.kind) if own["engine"] else UPRIGHT
    asked = {} if output.kind == PREVIEW else asked_options(job.arguments, output.kind)  # its type decides what the others are
    return checked_output(replace(output, options=asked), f"out {output.path.name}", **own)


def _check_names(planned: Sequence[Planned]) -> None:
    """No two jobs may write the same file, or work in the same staging folder."""
    from solidgrain.bake.manifest import manifest_path
    from solidgrain.bake.writers import output_files

    taken: dict[str, str] = {}
    for one in planned:
        own: dict[str, str] = {}
        for output in one.plan.outputs:
            folder = output.path.parent.resolve()
            names = [*(path.name for path in output_files(output, one.plan.volume)), manifest_path(output.path).name]
            own |= {str(folder / name): one.job.name for name in names}
        if clash := next((name for name in own if name in taken), None):
            raise UsageError(f"{one.job.where}: would write {clash}, as job {taken[clash]!r} does; give each its own files")
        taken |= own


def bake_jobs(
    planned: Sequence[Planned],
    textures: dict[object, Texture],
    bake: Bake,
    on_error: Callable[[str], None],
    continue_on_error: bool,
) -> list[dict[str, Any]]:
    """Bake one job after the other; after a failure the rest is skipped, unless told to go on. Returns a line for each job."""
    report: list[dict[str, Any]] = []
    for one, texture in in_turn(planned, textures):
        if any(line["status"] == FAILED for line in report) and not continue_on_error:
            report.append(_line(one, SKIPPED, note="a job before it failed"))
            continue
        report.append(_bake_job(one, texture, bake))
        if report[-1]["error"]:
            on_error(report[-1]["error"])
    return report


def in_turn(planned: Sequence[Planned], textures: dict[object, Texture]) -> Iterator[tuple[Planned, Texture]]:
    """Each job with its texture, which is let go of after the last of its jobs: it holds the tables of an instance."""
    for number, one in enumerate(planned):
        needed = any(later.job.texture == one.job.texture for later in planned[number + 1 :])
        yield one, textures[one.job.texture] if needed else textures.pop(one.job.texture)


def _bake_job(one: Planned, texture: Texture, bake: Bake) -> dict[str, Any]:
    if not one.plan.outputs:
        return _line(one, SKIPPED, note="its files are there")
    try:
        result = bake(one.plan, texture, one.job.arguments)
    except SolidgrainError as error:
        return _line(one, FAILED, error=f"{one.job.where}: {error}")
    except Exception as error:  # whatever it is, it must not cost the other jobs
        return _line(one, FAILED, error=f"{one.job.where}: {type(error).__name__}: {error}")
    return _line(one, DONE, seconds=result["seconds"], files=result["files"])


def _line(one: Planned, status: str, **values: Any) -> dict[str, Any]:
    return {"name": one.job.name, "status": status, "seconds": 0.0, "files": [], "error": None, "note": None, **values}


@contextmanager
def _named(where: str) -> Iterator[None]:
    """Errors that say which job they are about, and call its settings as it does: mip_filter, not --mip-filter."""
    try:
        yield
    except SolidgrainError as error:
        kind = UsageError if isinstance(error, UsageError) else BakeError
        raise kind(f"{where}: {_with_keys(str(error))}") from error


def _with_keys(message: str) -> str:
    keys = {*JobParser().keys, *OWN}

    def key(flag: re.Match[str]) -> str:
        name = flag[1].replace("-", "_")
        return name if name in keys else flag[0]

    return re.sub(r"(?<!\S)--([a-z][a-z-]*)", key, message)
