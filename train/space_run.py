"""The run directory of a texture space: that of `run`, with a folder of exemplars in the place of one.

RUN/options.json          settings, provenance, every exemplar with its sha256 and whether it is held out
RUN/exemplars/0000.npy    pixels, [H, W, 3] uint16, in the order of options.json
"""

from __future__ import annotations

import resource
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from solidgrain.runtime.errors import TrainingError
from solidgrain.runtime.files import DAMAGED_ARRAY, replacing
from solidgrain.train.collection import Member, choose_held_out
from solidgrain.train.run import (
    EXEMPLARS,
    RunFolder,
    Source,
    common_options,
    creating,
    is_space,
    open_run,
    opening,
    pixels_sha256,
    source_revision,
    write_options,
)
from solidgrain.train.settings import Budget, Settings

OTHER_FILES = 1024  # that a training may have open: libraries, sockets of other processes


@dataclass(frozen=True)
class SpaceRun(RunFolder):
    """The training of a texture space."""

    members: tuple[Member, ...]
    held_out: frozenset[str]  # names of those that it is never trained on
    license: str  # of all of them
    credit: str

    @property
    def trained_on(self) -> list[Member]:
        return [member for member in self.members if member.name not in self.held_out]

    @property
    def sources(self) -> list[Source]:
        """Where the pixels that it is trained on came from."""
        return [Source(member.name, self.license, self.credit, member.colorspace) for member in self.trained_on]


def create_space_run(
    folder: Path,
    settings: Settings,
    members: Iterable[Member],
    held_out: int | Sequence[str],
    source: Source,
    budget: Budget,
) -> SpaceRun:
    """A new run directory; members are written as they come, and never held in memory together.

    `source` gives the licence and the credit of them all. Raises TrainingError if the folder already holds a run or cannot be
    written, ExemplarError if the members cannot be trained on.
    """
    with creating(folder):
        (folder / EXEMPLARS).mkdir(exist_ok=True)
        entries: list[dict[str, Any]] = []
        for number, member in enumerate(members):
            with replacing(_file(folder, number)) as file:
                np.save(file, member.pixels)
            facts = {"wraps": list(member.wraps), "colorspace": member.colorspace}
            entries.append({"exemplar": member.name, "sha256": pixels_sha256(member.pixels), **facts})
        names = choose_held_out([entry["exemplar"] for entry in entries], held_out, settings.seed)
        for entry in entries:
            entry["held_out"] = entry["exemplar"] in names
        run = RunFolder(folder, settings, budget, source_revision())
        write_options(run, {"exemplars": entries, "license": source.license, "credit": source.credit})
    return open_space_run(folder)


def open_space_run(folder: Path) -> SpaceRun:
    """An existing run directory of a texture space. Raises TrainingError if it is not one, or was tampered with."""
    with opening(folder) as options:
        if "exemplars" not in options:
            raise TrainingError(f"{folder}: the run of a single exemplar; expected one of a texture space")
        entries = options["exemplars"]
        allow_open_files(len(entries))
        members = tuple(_read_member(_file(folder, number), entry) for number, entry in enumerate(entries))
        held_out = frozenset(entry["exemplar"] for entry in entries if entry["held_out"])
        common = common_options(folder, options)
        return SpaceRun(*common, members, held_out, str(options["license"]), str(options["credit"]))


def open_any(folder: Path) -> RunFolder:
    """A run directory of either kind. Raises TrainingError if it is not one, or was tampered with."""
    return open_space_run(folder) if is_space(folder) else open_run(folder)


def allow_open_files(count: int) -> None:
    """Let this process have so many files open besides its others, as far as it may: a memory-mapped array keeps its own."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = count + OTHER_FILES if hard == resource.RLIM_INFINITY else min(count + OTHER_FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _read_member(path: Path, entry: dict[str, Any]) -> Member:
    try:
        pixels = np.lib.format.open_memmap(path, mode="r")
    except DAMAGED_ARRAY as error:
        raise TrainingError(f"{path}: missing or damaged ({error}); put it back, or start the run again elsewhere") from error
    if pixels_sha256(pixels) != entry["sha256"]:
        raise TrainingError(f"{path}: not the pixels that the run was started with (sha256 differs)")
    down, across = entry["wraps"]
    return Member(entry["exemplar"], pixels, (bool(down), bool(across)), entry["colorspace"])


def _file(folder: Path, number: int) -> Path:
    return folder / EXEMPLARS / f"{number:04d}.npy"
