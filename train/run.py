"""The run directory: what a training leaves on disk, and how it is taken up again.

RUN/options.json     settings, exemplar, provenance
RUN/exemplar.npy     the pixels that it trains on, [H, W, 3] float32
RUN/stats.jsonl      one line per report: iteration, seconds, losses
RUN/samples/*.png    the exemplar, an axis-aligned and an oblique slice
RUN/checkpoint.pt    everything that the next iteration depends on, replaced whole
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch

from solidgrain.runtime.errors import TrainingError
from solidgrain.train import settings as settings_module
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.settings import Settings

CHECKPOINT, OPTIONS, EXEMPLAR, STATS = "checkpoint.pt", "options.json", "exemplar.npy", "stats.jsonl"


@dataclass(frozen=True)
class Provenance:
    """Where the pixels came from; goes into the bundle's manifest."""

    exemplar: str  # file name
    sha256: str  # of the pixels
    license: str
    credit: str


@dataclass(frozen=True)
class Run:
    """A training's directory with what never changes during it."""

    folder: Path
    settings: Settings
    provenance: Provenance
    exemplar: FloatArray
    revision: str  # of solidgrain when the run was started

    def save_checkpoint(self, state: dict[str, Any]) -> None:
        with _replacing(self.folder / CHECKPOINT) as file:
            torch.save(state, file)

    def load_checkpoint(self) -> dict[str, Any] | None:
        """The last complete checkpoint, or None before the first."""
        path = self.folder / CHECKPOINT
        if not path.exists():
            return None
        try:
            state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # torch raises a dozen unrelated types for damaged files
            raise TrainingError(
                f"{path}: damaged checkpoint ({type(error).__name__}); start the run again elsewhere"
            ) from error
        return state

    def append_stats(self, line: dict[str, Any]) -> None:
        with open(self.folder / STATS, "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def last_stats(self) -> dict[str, Any]:
        """The last line of the statistics, empty before the first."""
        path = self.folder / STATS
        lines = path.read_text("utf-8").splitlines() if path.exists() else []
        return dict(json.loads(lines[-1])) if lines else {}

    def rewind_stats(self, iteration: int) -> None:
        """Drop the lines after a checkpoint's iteration: a resumed run writes them again."""
        path = self.folder / STATS
        if path.exists():
            lines = [line for line in path.read_text("utf-8").splitlines() if _iteration_of(line) <= iteration]
            with _replacing(path) as file:
                file.write("".join(line + "\n" for line in lines).encode())


def create_run(folder: Path, settings: Settings, exemplar: FloatArray, name: str, license: str, credit: str) -> Run:
    """A new run directory. Raises TrainingError if the folder already holds a run or cannot be written."""
    if (folder / OPTIONS).exists():
        raise TrainingError(f"{folder}: already holds a run; continue it with --resume {folder}, or choose another --out")
    provenance = Provenance(name, hashlib.sha256(exemplar.tobytes()).hexdigest(), license, credit)
    try:
        (folder / "samples").mkdir(parents=True, exist_ok=True)
        with _replacing(folder / EXEMPLAR) as file:
            np.save(file, exemplar)
        revision = source_revision()
        options = {"settings": settings_module.to_json(settings), "provenance": vars(provenance), "revision": revision}
        with _replacing(folder / OPTIONS) as file:
            file.write(json.dumps(options, indent=2).encode() + b"\n")
    except OSError as error:
        raise TrainingError(f"{folder}: cannot write the run directory ({error.strerror})") from error
    return Run(folder, settings, provenance, exemplar, revision)


def open_run(folder: Path) -> Run:
    """An existing run directory. Raises TrainingError if it is not one, or was tampered with."""
    if not (folder / OPTIONS).is_file():
        raise TrainingError(f"{folder}: not a run directory (no {OPTIONS}); expected a folder made by solidgrain train --out")
    try:
        options = json.loads((folder / OPTIONS).read_text("utf-8"))
        settings = settings_module.from_json(options["settings"])
        provenance = Provenance(**options["provenance"])
        exemplar = np.load(folder / EXEMPLAR, allow_pickle=False)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainingError(f"{folder}: damaged run directory ({error}); start the run again elsewhere") from error
    if hashlib.sha256(exemplar.tobytes()).hexdigest() != provenance.sha256:
        raise TrainingError(f"{folder / EXEMPLAR}: not the pixels that the run was started with (sha256 differs)")
    return Run(folder, settings, provenance, exemplar, str(options["revision"]))


def source_revision() -> str:
    """The version of solidgrain, with the git revision where it runs from a checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        described = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return version("solidgrain")
    return f"{version('solidgrain')} ({described})"


def _iteration_of(line: str) -> float:
    try:
        return float(json.loads(line)["iteration"])
    except (ValueError, KeyError):
        return float("inf")  # the half line that a kill leaves behind


@contextmanager
def _replacing(path: Path) -> Iterator[BinaryIO]:
    """Write beside the file, then put it in place whole: a kill or a full disk leaves the old one."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
