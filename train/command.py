"""`solidgrain train`: a photograph becomes a run directory."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Literal

from solidgrain.runtime.errors import TrainingError

if TYPE_CHECKING:
    import torch

    from solidgrain.train.loop import Budget, Report
    from solidgrain.train.run import Run
    from solidgrain.train.settings import Settings

INTERRUPTED = 130


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("exemplar", nargs="?", type=Path, metavar="EXEMPLAR", help="a photograph (PNG, JPEG, TIFF, EXR, ...)")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--out", type=Path, metavar="RUN", help="the run directory to make")
    where.add_argument("--resume", type=Path, metavar="RUN", help="go on with a run where its last checkpoint left it")
    add("--preset", choices=("fast", "paper"), default="fast", help="fast: few CPU minutes; paper: the paper's settings (fast)")
    add("--iterations", type=int, metavar="N", help="stop after N iterations in all")
    add("--minutes", type=float, metavar="M", help="stop after M minutes of training in all")
    add(
        "--anisotropic",
        nargs="?",
        const="auto",
        choices=("auto", "x", "y"),
        metavar="AXIS",
        help="oriented material: slices turn about the grain, image axis x or y (measured if not given)",
    )
    add("--patch", type=int, metavar="PX", help="pixels along each side of a patch")
    add("--batch", type=int, metavar="N", help="patches per iteration")
    add("--seed", type=int, default=0, metavar="N", help="of all randomness (0)")
    add("--precision", choices=("auto", "float32", "bfloat16"), default="auto", help="of plain forward passes (auto)")
    add("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to train (auto)")
    add("--threads", type=int, default=0, metavar="N", help="0: every processor that the process may use (0)")
    add("--license", default="", metavar="TEXT", help="the photograph's licence, for the model card")
    add("--credit", default="", metavar="TEXT", help="whom to credit, for the model card")
    add("--quiet", action="store_true", help="no progress on stderr")


def run(arguments: argparse.Namespace) -> int:
    import torch

    from solidgrain.runtime.provider import usable_threads
    from solidgrain.train.loop import train

    check_budget(arguments)
    device = choose_device(arguments.device)
    torch.set_num_threads(arguments.threads or usable_threads())
    training = resume(arguments) if arguments.resume else start(arguments)
    budget = make_budget(arguments, training.settings)
    stop = StopRequest()
    train(training, budget, device, Progress(budget, arguments.quiet).show, stop.requested)
    folder = training.folder
    if stop.requested():
        print(f"stopped and saved; go on with: solidgrain train --resume {folder}", file=sys.stderr)
        return INTERRUPTED
    print(f"{folder}: done; next: solidgrain export {folder} --out BUNDLE", file=sys.stderr)
    return 0


def start(arguments: argparse.Namespace) -> Run:
    """A new run directory for the photograph, with a warning if one texture cannot describe it."""
    from solidgrain.train.exemplar import NONSTATIONARY, nonstationarity, read_exemplar
    from solidgrain.train.run import create_run

    if arguments.exemplar is None:
        raise TrainingError("no EXEMPLAR given; expected a photograph to learn from")
    settings = make_settings(arguments)
    exemplar = read_exemplar(arguments.exemplar, settings.patch)
    if (found := nonstationarity(exemplar)) > NONSTATIONARY:
        print(
            f"warning: {arguments.exemplar} changes across itself (nonstationarity {found:.2f}, above {NONSTATIONARY}); "
            "crop an even part of it for better results",
            file=sys.stderr,
        )
    settings = with_grain(settings, arguments.anisotropic, exemplar)
    return create_run(arguments.out, settings, exemplar, arguments.exemplar.name, arguments.license, arguments.credit)


def make_settings(arguments: argparse.Namespace) -> Settings:
    """The preset, with what the flags change. Raises TrainingError for values that make no sense."""
    from solidgrain.train.settings import preset

    changes: dict[str, Any] = {"seed": arguments.seed, "precision": arguments.precision}
    for name, least in (("patch", 32), ("batch", 1)):
        value = getattr(arguments, name)
        if value is not None:
            if value < least:
                raise TrainingError(f"--{name} {value}: expected at least {least}")
            changes[name] = value
    return preset(arguments.preset, **changes)


def with_grain(settings: Settings, anisotropic: str | None, exemplar: Any) -> Settings:
    """The settings for an oriented material: the axis about which slices turn, and how long its structures start."""
    from dataclasses import replace

    from solidgrain.train.exemplar import measure_grain

    if anisotropic is None:
        return settings
    grain = measure_grain(exemplar)
    axis: Literal["x", "y"] = grain.axis if anisotropic == "auto" else "x" if anisotropic == "x" else "y"
    ratio = grain.ratio if settings.preset == "fast" and axis == grain.axis else 1.0
    return replace(settings, grain=axis, grain_ratio=ratio)


def resume(arguments: argparse.Namespace) -> Run:
    from solidgrain.train.run import open_run

    if arguments.exemplar is not None:
        raise TrainingError(f"--resume {arguments.resume}: the run has its exemplar already; leave {arguments.exemplar} out")
    return open_run(arguments.resume)


def check_budget(arguments: argparse.Namespace) -> None:
    for name in ("iterations", "minutes"):
        value = getattr(arguments, name)
        if value is not None and not value > 0:
            raise TrainingError(f"--{name} {value}: expected more than 0")


def make_budget(arguments: argparse.Namespace, settings: Settings) -> Budget:
    """How long to train: what the flags say, or the preset's iterations."""
    from solidgrain.train.loop import Budget
    from solidgrain.train.settings import PRESET_ITERATIONS

    if arguments.iterations is None and arguments.minutes is None:
        return Budget(iterations=PRESET_ITERATIONS[settings.preset])
    return Budget(arguments.iterations, arguments.minutes)


def choose_device(name: str) -> torch.device:
    """Raises TrainingError for CUDA where there is none: no silent fall-back."""
    import torch

    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise TrainingError(
            f"--device cuda: torch {torch.__version__} sees no CUDA device; use --device cpu or install a CUDA build"
        )
    return torch.device("cuda" if name == "cuda" or (name == "auto" and available) else "cpu")


class StopRequest:
    """Ctrl-C or SIGTERM asks the loop to finish its iteration and save; a second one stops at once."""

    def __init__(self) -> None:
        self._requested = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._request)

    def requested(self) -> bool:
        return self._requested

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self._requested:
            raise KeyboardInterrupt
        self._requested = True
        print("\nfinishing this iteration; once more to stop at once", file=sys.stderr)


class Progress:
    """One line that rewrites itself on a terminal, a line every so often in a log."""

    def __init__(self, budget: Budget, quiet: bool) -> None:
        self.budget, self.quiet, self.terminal = budget, quiet, sys.stderr.isatty()
        self.printed = -60.0

    def show(self, report: Report) -> None:
        if self.quiet or (not self.terminal and report.seconds - self.printed < 30):
            return
        self.printed = report.seconds
        done = self.budget.progress(report.iteration, report.seconds)
        left = report.seconds * (1 - done) / done / 60
        line = (
            f"iteration {report.iteration}, {report.seconds / report.iteration:.2f} s each, "
            f"{done:.0%}, {left:.1f} min left, L_D {report.critic_loss:.2f}, L_style {report.style:.4f}"
        )
        print(f"\r{line}  " if self.terminal else line, end="" if self.terminal else "\n", file=sys.stderr, flush=True)
