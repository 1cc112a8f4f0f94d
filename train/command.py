"""`solidgrain train`: a photograph, or a folder of them, becomes a run directory."""

from __future__ import annotations

import argparse
import shlex
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from solidgrain.bake.arguments import (
    parse_axis,
    parse_count,
    parse_minutes,
    parse_positive,
    parse_scale,
    parse_seed,
    parse_text,
)
from solidgrain.bake.messages import tell
from solidgrain.runtime.errors import TrainingError
from solidgrain.train.console import Progress, StopRequest
from solidgrain.train.variants import CHANGES, canonical

if TYPE_CHECKING:
    import torch

    from solidgrain.train.loop import Ending, Report
    from solidgrain.train.processes import Processes
    from solidgrain.train.run import RunFolder

FAILED, INTERRUPTED = 1, 130


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("exemplar", nargs="?", type=Path, metavar="EXEMPLAR", help="a photograph (PNG, JPEG, TIFF, EXR, ...)")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--out", type=Path, metavar="RUN", help="the run directory to make")
    where.add_argument("--resume", type=Path, metavar="RUN", help="go on with a run where its last checkpoint left it")
    add("--space", type=Path, metavar="FOLDER", help="learn a texture space from all photographs of a folder")
    add("--hold-out", metavar="N|FILE", help="of --space: exemplars never trained on, so many or those a file lists")
    add("--skip-unreadable", action="store_true", default=None, help="of --space: leave out files that cannot be used")
    add("--warm-start", type=Path, metavar="RUN", help="begin with the weights of another run, as far as they fit")
    add("--preset", choices=("fast", "paper"), help="fast: few CPU minutes; paper: the paper's settings (fast)")
    add(
        "--variant",
        type=canonical,
        choices=tuple(CHANGES),
        help="the method (paper), or what the paper compares it with: docs/training.md (paper)",
    )
    add("--iterations", type=parse_positive, metavar="N", help="stop after N iterations in all")
    add("--minutes", type=parse_minutes, metavar="M", help="stop after M minutes of training in all")
    add("--until-plateau", action="store_true", help="stop before, when slices come no nearer to the exemplar")
    add(
        "--anisotropic",
        nargs="?",
        const="auto",
        type=parse_axis,
        metavar="AXIS",
        help="oriented material: slices turn about the grain, image axis x or y (measured if not given)",
    )
    add(
        "--upright",
        action="store_true",
        default=None,
        help="with --anisotropic: neither mirrored nor seen from behind, for light from one side",
    )
    add(
        "--patch-scale",
        type=parse_scale,
        metavar="S",
        help="photograph's pixels per exemplar pixel; patches see more of it (1)",
    )
    add("--patch", type=parse_positive, metavar="PX", help="pixels along each side of a patch, at least 32, all along")
    add("--batch", type=parse_positive, metavar="N", help="patches per iteration")
    add("--seed", type=parse_seed, metavar="N", help="of all randomness (0)")
    add("--precision", choices=("auto", "float32", "bfloat16"), help="of plain forward passes (auto)")
    add("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to train (auto)")
    add("--threads", type=parse_count, default=0, metavar="N", help="0: every processor that the process may use (0)")
    add("--license", type=parse_text, metavar="TEXT", help="the photograph's licence, for the model card")
    add("--credit", type=parse_text, metavar="TEXT", help="whom to credit, for the model card")
    add("--quiet", action="store_true", help="no progress on stderr")


def run(arguments: argparse.Namespace) -> int:
    import torch

    from solidgrain.runtime.workers import usable_threads
    from solidgrain.train.processes import ElsewhereError, joined, local_device, processes_here
    from solidgrain.train.run import OPTIONS

    forbid_tf32()
    device = local_device(choose_device(arguments.device))
    torch.set_num_threads(arguments.threads or max(1, usable_threads() // processes_here()))
    with joined(device) as processes:
        try:
            return train_together(arguments, device, processes)
        except ElsewhereError:
            return FAILED
        except KeyboardInterrupt:  # it was not left the time to save
            folder: Path = arguments.resume or arguments.out
            if processes.first:
                if not (folder / OPTIONS).exists():
                    raise  # nothing to speak of was begun
                resume = f"solidgrain train --resume {shlex.quote(str(folder))}{budget_flags(arguments)}"
                tell(f"interrupted; go on from its last checkpoint with: {resume}")
            return INTERRUPTED


def train_together(arguments: argparse.Namespace, device: torch.device, processes: Processes) -> int:
    """Train in this process, among others perhaps. Returns the exit code; the first process says what happened."""
    from solidgrain.train.begin import begin

    with ExitStack() as stack:
        training = processes.one_after_another(lambda: begin(arguments, device, stack if processes.first else None))
        return train_on(training, arguments, device, processes)


def train_on(training: RunFolder, arguments: argparse.Namespace, device: torch.device, processes: Processes) -> int:
    from solidgrain.train.loop import train
    from solidgrain.train.run import CHECKPOINT

    stop = StopRequest(quiet=not processes.first)
    progress = Progress(training.budget, arguments.quiet, describe)
    with processes.errors_once():
        ending = train(training, training.budget, device, progress.show, stop.requested, progress.warn, processes)
    progress.end()
    if processes.first:
        tell(how_to_go_on(training, ending, budget_flags(arguments), processes))
    if ending.stopped:
        return INTERRUPTED
    return 0 if (training.folder / CHECKPOINT).exists() else FAILED


def describe(report: Report, done: float, left: float) -> str:
    return (
        f"iteration {report.iteration}, {report.seconds / report.iteration:.2f} s each, "
        f"{done:.0%}, {left / 60:.1f} min left, L_D {report.critic_loss:.2f}, L_style {report.style:.4f}"
    )


def how_to_go_on(training: RunFolder, ending: Ending, flags: str, processes: Processes) -> str:
    from solidgrain.train.run import CHECKPOINT

    folder = training.folder
    named = shlex.quote(str(folder))
    done = f"done after {ending.iteration} iterations" if training.budget.until_plateau else "done"
    if ending.stopped:
        together = f" in {processes.count} processes, each" if processes.count > 1 else ""
        return f"stopped{' and saved' * ending.saved}; go on{together} with: solidgrain train --resume {named}{flags}"
    if not (folder / CHECKPOINT).exists():
        return f"{folder}: {done}, and nothing is worth keeping; train again with another --seed"
    if training.settings.noise_at_input:
        return f"{folder}: {done}; its slices are in {folder / 'samples'}; a bundle cannot hold noise at the input"
    return f"{folder}: {done}; next: solidgrain export {named} --out BUNDLE"


def budget_flags(arguments: argparse.Namespace) -> str:
    """The budget as it was given, to be given again, where the run's own does not know it."""
    if not arguments.resume:
        return ""
    counts = (("--iterations", arguments.iterations), ("--minutes", arguments.minutes))
    given = "".join(f" {flag} {count}" for flag, count in counts if count is not None)
    return given + " --until-plateau" * bool(arguments.until_plateau)


def forbid_tf32() -> None:
    """Let float32 be float32 on GPUs, too: in TF32, which torch convolves in, gradient penalties keep ten bits of it."""
    import torch

    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False


def choose_device(name: str) -> torch.device:
    """Raises TrainingError for CUDA where there is none: no silent fall-back."""
    import torch

    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise TrainingError(
            f"--device cuda: torch {torch.__version__} sees no CUDA device; use --device cpu or install a CUDA build"
        )
    return torch.device("cuda" if name == "cuda" or (name == "auto" and available) else "cpu")
