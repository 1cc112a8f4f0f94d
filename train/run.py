"""The run directory: what a training leaves on disk, and how it is taken up again.

RUN/options.json     settings, exemplar, provenance
RUN/exemplar.npy     the pixels that it trains on, [H, W, 3] float32
RUN/stats.jsonl      one line per report: iteration, seconds, losses
RUN/samples/*.png    the exemplar, an axis-aligned and an oblique slice
RUN/checkpoint.pt    everything that the next iteration depends on, replaced whole; torch's format, packed (packing.py)
RUN/lock             while a process trains it
"""

from __future__ import annotations

import hashlib
import io
import json
import shlex
import shutil
import subprocess
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from solidgrain.runtime.errors import TrainingError
from solidgrain.runtime.files import DAMAGED_ARRAY, locked, remove_temporaries, replacing
from solidgrain.train import settings as settings_module
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.packing import pack, unpack
from solidgrain.train.settings import Budget, Settings

PARTS = ("critic", "sampler", "average", "critic_optimiser", "sampler_optimiser")  # the state of each is in a checkpoint
CHECKPOINT_KEYS = {*PARTS, "iteration", "seconds", "generator"}
CHECKPOINT, OPTIONS, EXEMPLAR, STATS = "checkpoint.pt", "options.json", "exemplar.npy", "stats.jsonl"
EXEMPLARS, SAMPLES, LOCK = "exemplars", "samples", "lock"
CONTENTS = (CHECKPOINT, OPTIONS, EXEMPLAR, STATS, EXEMPLARS, SAMPLES)


@dataclass(frozen=True)
class Source:
    """Where the pixels came from; goes into the bundle's manifest."""

    exemplar: str  # file name
    license: str
    credit: str
    colorspace: str = ""  # what its colours were read as, "" in runs that do not say
    scale: float = 1.0  # photograph's pixels per exemplar pixel
    photograph_sha256: str = ""  # of its pixels before they were reduced, whose average rounds as the processor does


@dataclass(frozen=True)
class RunFolder:
    """A training's directory with what never changes during it, whatever it is trained on."""

    folder: Path
    settings: Settings
    budget: Budget
    revision: str  # of solidgrain when the run was started

    def save_checkpoint(self, state: dict[str, Any]) -> None:
        """Replace the checkpoint. Raises TrainingError if it cannot be written; the one before is then untouched."""
        buffer = io.BytesIO()  # torch's own writer turns a full disk into errors of many types
        torch.save(state, buffer)
        with self._written(CHECKPOINT), replacing(self.folder / CHECKPOINT) as file:
            file.write(pack(buffer.getbuffer()))

    def load_checkpoint(self) -> dict[str, Any] | None:
        """The last complete checkpoint, or None before the first."""
        path = self.folder / CHECKPOINT
        return read_checkpoint(path, CHECKPOINT_KEYS) if path.exists() else None

    def append_stats(self, line: dict[str, Any]) -> None:
        with self._written(STATS), open(self.folder / STATS, "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def stats_until(self, iteration: int) -> list[dict[str, Any]]:
        """The lines of the statistics up to an iteration, without the half line that a kill may leave behind."""
        path = self.folder / STATS
        lines = [_parsed(line) for line in path.read_text("utf-8").splitlines()] if path.exists() else []
        return [line for line in lines if line.get("iteration", iteration + 1) <= iteration]

    def rewind_stats(self, iteration: int) -> None:
        """Drop the lines after a checkpoint's iteration: a resumed run writes them again."""
        kept = self.stats_until(iteration)
        with self._written(STATS), replacing(self.folder / STATS) as file:
            file.write("".join(json.dumps(line) + "\n" for line in kept).encode())

    @contextmanager
    def _written(self, name: str) -> Iterator[None]:
        """Failed writes, as errors that say what to do."""
        try:
            yield
        except OSError as error:
            raise TrainingError(
                f"{self.folder / name}: cannot write ({error.strerror}); the last checkpoint is whole: "
                f"make space and go on with --resume {shlex.quote(str(self.folder))} and the budget that was given, if one was"
            ) from error


def read_checkpoint(path: Path, wanted: Collection[str]) -> dict[str, Any]:
    """A checkpoint file that holds what is wanted. Raises TrainingError if it does not, or is damaged."""
    try:
        state: dict[str, Any] = torch.load(io.BytesIO(unpack(path.read_bytes())), map_location="cpu", weights_only=True)
        if missing := set(wanted) - state.keys():
            raise KeyError(f"no {', '.join(sorted(missing))}")
    except OSError as error:
        raise TrainingError(f"{path}: cannot read ({error.strerror})") from error
    except MemoryError:
        raise
    except Exception as error:  # torch raises a dozen unrelated types for damaged files
        raise TrainingError(f"{path}: damaged checkpoint ({type(error).__name__}); start the run again elsewhere") from error
    return state


@dataclass(frozen=True)
class Run(RunFolder):
    """The training of a single exemplar."""

    source: Source
    exemplar: FloatArray

    @property
    def sha256(self) -> str:
        """Of the exemplar's pixels."""
        return pixels_sha256(self.exemplar)

    def settings_at(self, iteration: int) -> Settings:
        """The settings of one iteration: later patches are larger, where the exemplar has room for them."""
        settings = self.settings
        fits = 0 < settings.later_room * settings.later_patch <= min(self.exemplar.shape[:2])
        return replace(settings, patch=settings.later_patch) if fits and iteration >= settings.later_from else settings


def create_run(folder: Path, settings: Settings, exemplar: FloatArray, source: Source, budget: Budget) -> Run:
    """A new run directory. Raises TrainingError if the folder already holds a run or cannot be written."""
    run = Run(folder, settings, budget, source_revision(), source, exemplar)
    with creating(folder):
        with replacing(folder / EXEMPLAR) as file:
            np.save(file, exemplar)
        write_options(run, {"source": vars(source), "exemplar_sha256": run.sha256})
    return run


def open_run(folder: Path) -> Run:
    """The run directory of a single exemplar. Raises TrainingError if it is not one, or was tampered with."""
    with opening(folder) as options:
        if "exemplars" in options:
            raise TrainingError(f"{folder}: the run of a texture space; expected one of a single exemplar")
        exemplar = np.load(folder / EXEMPLAR, allow_pickle=False)
        run = Run(*common_options(folder, options), Source(**options["source"]), exemplar)
        intact = run.sha256 == options["exemplar_sha256"]
    if not intact:
        raise TrainingError(f"{folder / EXEMPLAR}: not the pixels that the run was started with (sha256 differs)")
    return run


def is_space(folder: Path) -> bool:
    """Whether a run directory is a texture space's. Raises TrainingError if it is no run directory."""
    with opening(folder) as options:
        return "exemplars" in options


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """A run directory, or one that is to be, for this process alone. Raises TrainingError if another one trains it."""
    absent = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = locked(folder / LOCK)
    except BlockingIOError as error:
        raise TrainingError(f"{folder}: another process is training it; wait for it, or choose another --out") from error
    except OSError as error:
        raise TrainingError(f"{folder}: cannot write the run directory ({error.strerror})") from error
    with lock:
        try:
            for ours in (folder, folder / SAMPLES) if (folder / OPTIONS).exists() else ():
                remove_temporaries(ours)
            yield
        finally:
            (folder / LOCK).unlink(missing_ok=True)
            remove_empty(absent)


@contextmanager
def creating(folder: Path) -> Iterator[None]:
    """A run directory in the making. Raises TrainingError if the folder holds a run, or parts of one, or cannot be written.

    Whatever goes wrong inside, nothing half-made is left behind.
    """
    if (folder / OPTIONS).exists():
        quoted = shlex.quote(str(folder))
        raise TrainingError(f"{folder}: already holds a run; continue it with --resume {quoted}, or choose another --out")
    for path in (folder / name for name in CONTENTS):  # a checkpoint would be taken up, as this run's own
        if path.is_file() or (path.is_dir() and any(path.iterdir())):
            raise TrainingError(f"{path}: is there already, without a run; remove it or choose another --out")
    try:
        with undone_on_failure(folder):
            (folder / SAMPLES).mkdir(parents=True, exist_ok=True)
            yield
    except OSError as error:
        raise TrainingError(f"{folder}: cannot write the run directory ({error.strerror or error})") from error


@contextmanager
def undone_on_failure(folder: Path) -> Iterator[None]:
    """What is made of a run directory inside goes away again if it fails there; what was in the folder before stays."""
    before = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    if OPTIONS in before:  # a run, and perhaps a training that goes on in it
        yield
        return
    absent = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        yield
    except BaseException:
        for path in (folder / name for name in CONTENTS if name not in before):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                with suppress(OSError):  # what went wrong first is to be heard
                    path.unlink(missing_ok=True)
        remove_empty(absent)
        raise


def remove_empty(folders: Sequence[Path]) -> None:
    """Remove folders, each in the next one, up to the first with something in it."""
    with suppress(OSError):
        for folder in folders:
            folder.rmdir()


def write_options(run: RunFolder, specific: dict[str, Any]) -> None:
    """What makes a folder a run directory; written last."""
    settled = {"settings": settings_module.to_json(run.settings), **specific}
    options = {**settled, "budget": vars(run.budget), "revision": run.revision}
    with replacing(run.folder / OPTIONS) as file:
        file.write(json.dumps(options, indent=2).encode() + b"\n")


@contextmanager
def opening(folder: Path) -> Iterator[dict[str, Any]]:
    """The options of a run directory. Raises TrainingError if it is not one, or if what is read of it is damaged."""
    if not (folder / OPTIONS).is_file():
        raise TrainingError(f"{folder}: not a run directory (no {OPTIONS}); expected a folder made by solidgrain train --out")
    try:
        yield dict(json.loads((folder / OPTIONS).read_text("utf-8")))
    except PermissionError as error:
        raise TrainingError(f"{error.filename}: cannot read ({error.strerror})") from error
    except (*DAMAGED_ARRAY, KeyError, TypeError) as error:
        raise TrainingError(f"{folder}: damaged run directory ({error}); start the run again elsewhere") from error


def common_options(folder: Path, options: dict[str, Any]) -> tuple[Path, Settings, Budget, str]:
    """What every run's options hold, as the arguments of `RunFolder`."""
    return folder, settings_module.from_json(options["settings"]), Budget(**options["budget"]), str(options["revision"])


def pixels_sha256(pixels: np.ndarray[Any, Any]) -> str:
    return hashlib.sha256(np.ascontiguousarray(pixels).data).hexdigest()


def source_revision() -> str:
    """The version of solidgrain, with the git revision where it runs from a checkout of its own."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)  # installed below someone else's checkout, it is not tracked
        return f"{version('solidgrain')} ({git('describe', '--always', '--dirty')})"
    except (OSError, subprocess.CalledProcessError):
        return version("solidgrain")


def _parsed(line: str) -> dict[str, Any]:
    try:
        parsed = json.loads(line)
    except ValueError:
        return {}
    return parsed if isinstance(parsed, dict) else {}
