"""`solidgrain train`: a photograph, or a folder of them, becomes a run directory."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from solidgrain.bake.arguments import parse_count, parse_minutes, parse_positive, parse_scale, parse_seed, parse_text
from solidgrain.bake.messages import tell, warn
from solidgrain.runtime.errors import TrainingError, UsageError
from solidgrain.train.console import Progress, StopRequest
from solidgrain.train.variants import CHANGES, canonical

if TYPE_CHECKING:
    import torch

    from solidgrain.train.exemplar import FloatArray
    from solidgrain.train.loop import Ending, Report
    from solidgrain.train.processes import Processes
    from solidgrain.train.run import Run, RunFolder
    from solidgrain.train.settings import Budget, Settings
    from solidgrain.train.space_run import SpaceRun

FAILED, INTERRUPTED = 1, 130
MOST_NAMES = 5  # of photographs, in a line
SMALLEST_PATCH = 32  # pixels
FIXED = (
    "preset",
    "variant",
    "anisotropic",
    "patch_scale",
    "patch",
    "batch",
    "seed",
    "precision",
    "license",
    "credit",
    "space",
    "hold_out",
    "skip_unreadable",
    "warm_start",
)  # what a run settles for good


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
        choices=("auto", "x", "y"),
        metavar="AXIS",
        help="oriented material: slices turn about the grain, image axis x or y (measured if not given)",
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

    device = local_device(choose_device(arguments.device))
    torch.set_num_threads(arguments.threads or max(1, usable_threads() // processes_here()))
    with joined(device) as processes:
        try:
            return train_together(arguments, device, processes)
        except ElsewhereError:
            return FAILED
        except KeyboardInterrupt:
            if processes.first:
                tell_of_interruption(arguments)
            return INTERRUPTED


def tell_of_interruption(arguments: argparse.Namespace) -> None:
    """Of a training that was not left the time to save."""
    from solidgrain.train.run import OPTIONS

    folder: Path = arguments.resume or arguments.out
    if not (folder / OPTIONS).exists():
        raise KeyboardInterrupt  # nothing to speak of was begun
    resume = f"solidgrain train --resume {shlex.quote(str(folder))}{budget_flags(arguments)}"
    tell(f"interrupted; go on from its last checkpoint with: {resume}")


def train_together(arguments: argparse.Namespace, device: torch.device, processes: Processes) -> int:
    """Train in this process, among others perhaps. Returns the exit code; the first process says what happened."""
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
    stopped = processes.any(stop.requested())
    progress.end()
    if processes.first:
        tell(how_to_go_on(training, stopped, ending, budget_flags(arguments), processes))
    if stopped:
        return INTERRUPTED
    return 0 if (training.folder / CHECKPOINT).exists() else FAILED


def describe(report: Report, done: float, left: float) -> str:
    return (
        f"iteration {report.iteration}, {report.seconds / report.iteration:.2f} s each, "
        f"{done:.0%}, {left / 60:.1f} min left, L_D {report.critic_loss:.2f}, L_style {report.style:.4f}"
    )


def how_to_go_on(training: RunFolder, stopped: bool, ending: Ending, flags: str, processes: Processes) -> str:
    from solidgrain.train.run import CHECKPOINT

    folder = training.folder
    named = shlex.quote(str(folder))
    done = f"done after {ending.iteration} iterations" if training.budget.until_plateau else "done"
    if stopped:
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


def begin(arguments: argparse.Namespace, device: torch.device, stack: ExitStack | None) -> RunFolder:
    """The run to train: the one to go on with, or a new one.

    The first of several processes, the one with a stack, makes it, and holds it until the stack is left.
    """
    from solidgrain.train.run import held, undone_on_failure
    from solidgrain.train.warm_start import learned, warm_start

    if stack:
        stack.enter_context(held(arguments.resume or arguments.out))
    if arguments.resume:
        return resume(arguments)
    if not stack:
        return open_any(arguments.out)
    other = arguments.warm_start and learned(arguments.warm_start)  # before there is a run directory
    with undone_on_failure(arguments.out):
        training = start_space(arguments) if arguments.space else start(arguments)
        if other:
            taken, left = warm_start(training, other, device)
            tell(f"{arguments.warm_start}: took over {taken} of {taken + left} parameter tensors")
    for line in misgivings(training, arguments.warm_start):
        warn(line)
    return training


def open_any(folder: Path) -> RunFolder:
    """A run directory of either kind."""
    from solidgrain.train.run import is_space, open_run
    from solidgrain.train.space_run import open_space_run

    return open_space_run(folder) if is_space(folder) else open_run(folder)


def start_space(arguments: argparse.Namespace) -> RunFolder:
    """A new run directory for a folder of photographs."""
    from solidgrain.train.collection import read_members
    from solidgrain.train.run import Source
    from solidgrain.train.space_run import create_space_run

    if arguments.patch_scale is not None:
        raise UsageError("--patch-scale: is about one photograph, not about those of a --space; resize those that need it")
    if arguments.exemplar is not None:
        raise UsageError(f"--space {arguments.space}: learns from all its photographs; leave {arguments.exemplar} out")
    settings = make_settings(arguments)
    if arguments.anisotropic == "auto":
        raise UsageError("--anisotropic: say x or y; the grain of all photographs of a --space must run the same way")
    if arguments.anisotropic:
        settings = replace(settings, grain=arguments.anisotropic)

    smallest = max(settings.patch, settings.encoded_patch)
    members = read_members(arguments.space, smallest, bool(arguments.skip_unreadable), warn)
    source = Source("", arguments.license or "", arguments.credit or "")
    budget = make_budget(arguments, settings)
    return create_space_run(arguments.out, settings, members, held_out_names(arguments.hold_out), source, budget)


def misgivings(run: RunFolder, warm_start: Path | None) -> list[str]:
    """What is to be said of a space's photographs; of a single one it has been."""
    from solidgrain.train.space_run import SpaceRun

    lines = (about_uneven(run), about_seen(run, warm_start)) if isinstance(run, SpaceRun) else ()
    return [line for line in lines if line]


def about_uneven(run: SpaceRun) -> str:
    """Which photographs one texture cannot describe, or ""."""
    from solidgrain.train.exemplar import NONSTATIONARY, nonstationarity

    changes = {member.name: nonstationarity(member.exemplar) for member in run.trained_on}
    uneven = [f"{name} ({change:.2f})" for name, change in changes.items() if change > NONSTATIONARY]
    count = f"{len(uneven)} of {len(run.trained_on)} photographs"
    what = f"change across themselves (nonstationarity above {NONSTATIONARY})"
    return f"{count} {what}: {some(uneven)}; crop even parts of them for better results" if uneven else ""


def about_seen(run: SpaceRun, warm_start: Path | None) -> str:
    """Which held-out photographs the weights that this run begins with were trained on, as far as is known, or ""."""
    from solidgrain.runtime.bundle import embedded_folder, open_bundle
    from solidgrain.train.run import pixels_sha256
    from solidgrain.train.space_run import SpaceRun

    seen: set[str] = set()
    start = run.settings.critic_start if not warm_start else ""
    if warm_start and warm_start.is_dir():
        other = open_any(warm_start)
        start = other.settings.critic_start  # what that run began with has come along
        if isinstance(other, SpaceRun):
            seen = {pixels_sha256(member.pixels) for member in other.trained_on}
    elif warm_start and run.held_out:
        return f"--warm-start {warm_start}: what it was trained on is not known; held-out photographs may be among it"
    if start:
        manifest = open_bundle(embedded_folder(start)).manifest
        seen |= {entry["sha256"] for entry in manifest["training"].get("exemplars", [])}
    names = sorted(
        member.name for member in run.members if member.name in run.held_out and pixels_sha256(member.pixels) in seen
    )
    teacher = warm_start or f"the critic of {run.settings.critic_start}"
    return f"{len(names)} held-out photographs were trained on by {teacher}: {some(names)}; hold out others" if names else ""


def some(names: Sequence[str]) -> str:
    """The first of many names."""
    return ", ".join(names[:MOST_NAMES]) + ", ..." * (len(names) > MOST_NAMES)


def held_out_names(text: str | None) -> int | list[str]:
    """How many exemplars to hold out, or which. Raises UsageError if it is neither a number nor a file."""
    if text is None or text.isdecimal():
        return int(text or 0)
    try:
        return [line.strip() for line in Path(text).read_text("utf-8").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"--hold-out {text}: expected a number, or a file with a name per line ({error})") from error


def start(arguments: argparse.Namespace) -> Run:
    """A new run directory for the photograph, with a warning if one texture cannot describe it."""
    from solidgrain.train.photograph import read_photograph, scaled
    from solidgrain.train.run import Source, create_run, pixels_sha256

    if arguments.exemplar is None:
        raise UsageError("no EXEMPLAR given; expected a photograph to learn from, or --space FOLDER")
    if strange := [flag for flag in ("hold_out", "skip_unreadable") if getattr(arguments, flag) is not None]:
        raise UsageError(f"--{strange[0].replace('_', '-')}: is about the photographs of a --space; leave it out")
    settings = make_settings(arguments)
    scale = arguments.patch_scale or 1.0
    if scale < 1:
        raise UsageError(f"--patch-scale {scale:g}: expected 1 or more; photographs are reduced, never enlarged")
    photograph, colorspace, warning = read_photograph(arguments.exemplar, round(settings.patch * scale))
    exemplar = scaled(photograph, scale)
    if warning:
        warn(f"{arguments.exemplar}: {warning}")
    warn_if_uneven(arguments.exemplar, exemplar)
    settings = with_grain(settings, arguments.anisotropic, exemplar)
    of_photograph = "" if scale == 1 else pixels_sha256(photograph)
    source = Source(arguments.exemplar.name, arguments.license or "", arguments.credit or "", colorspace, scale, of_photograph)
    return create_run(arguments.out, settings, exemplar, source, make_budget(arguments, settings))


def warn_if_uneven(path: Path, exemplar: FloatArray) -> None:
    """Say that one texture cannot describe a photograph, if that is so."""
    from solidgrain.train.exemplar import NONSTATIONARY, nonstationarity

    if (found := nonstationarity(exemplar)) > NONSTATIONARY:
        warn(
            f"{path} changes across itself (nonstationarity {found:.2f}, above {NONSTATIONARY}); "
            "crop an even part of it for better results"
        )


def make_settings(arguments: argparse.Namespace) -> Settings:
    """The preset, with what the flags change. Raises UsageError for a patch that is too small, SolidgrainError without VGG."""
    from solidgrain.train.settings import preset
    from solidgrain.train.variants import vary
    from solidgrain.train.vgg import find_weights

    changes = {name: getattr(arguments, name) for name in ("patch", "batch", "seed", "precision")}
    changes = {name: value for name, value in changes.items() if value is not None}
    if "patch" in changes:
        changes["later_patch"] = 0  # what was asked for, all along
    if arguments.warm_start:
        changes["warm_start"] = arguments.warm_start.resolve().name
    if changes.get("patch", SMALLEST_PATCH) < SMALLEST_PATCH:
        raise UsageError(f"--patch {arguments.patch}: expected at least {SMALLEST_PATCH}")
    kind = " space" if arguments.space else ""
    settings = vary(preset((arguments.preset or "fast") + kind, **changes), arguments.variant or "paper")
    if settings.style_features == "vgg":
        find_weights()  # before there is a run directory
    return settings


def with_grain(settings: Settings, anisotropic: str | None, exemplar: Any) -> Settings:
    """The settings for an oriented material: the axis about which slices turn, and how long its structures start."""
    from solidgrain.train.exemplar import measure_grain

    if anisotropic is None:
        return settings
    grain = measure_grain(exemplar)
    axis: Literal["x", "y"] = grain.axis if anisotropic == "auto" else "x" if anisotropic == "x" else "y"
    ratio = grain.ratio if settings.preset == "fast" and axis == grain.axis else 1.0
    return replace(settings, grain=axis, grain_ratio=ratio)


def resume(arguments: argparse.Namespace) -> RunFolder:
    """The run to go on with, under its own settings; --iterations, --minutes and --until-plateau replace its budget."""
    from solidgrain.train.run import CHECKPOINT

    if arguments.exemplar is not None:
        raise UsageError(f"--resume {arguments.resume}: the run has its exemplar already; leave {arguments.exemplar} out")
    if given := [f"--{name.replace('_', '-')}" for name in FIXED if getattr(arguments, name) is not None]:
        raise UsageError(f"--resume {arguments.resume}: the run has settled {', '.join(given)} already; leave them out")
    training = open_any(arguments.resume)
    if training.settings.warm_start and not (arguments.resume / CHECKPOINT).exists():
        raise TrainingError(
            f"--resume {arguments.resume}: was stopped before it had the weights of {training.settings.warm_start}; remove it, "
            "and begin again with --warm-start"
        )
    if arguments.iterations is None and arguments.minutes is None and not arguments.until_plateau:
        return training
    return replace(training, budget=make_budget(arguments, training.settings))


def make_budget(arguments: argparse.Namespace, settings: Settings) -> Budget:
    """How long to train: what the flags say, or the preset's iterations. Raises UsageError for a space with a plateau."""
    from solidgrain.train.settings import PRESET_ITERATIONS, Budget

    preset_name = settings.preset + (" space" if settings.latent else "")

    if arguments.until_plateau and settings.latent:
        raise UsageError("--until-plateau: is about a single exemplar; give a --space its --iterations or --minutes")
    if arguments.iterations is None and arguments.minutes is None:
        return Budget(PRESET_ITERATIONS[preset_name], until_plateau=arguments.until_plateau)
    return Budget(arguments.iterations, arguments.minutes, arguments.until_plateau)


def choose_device(name: str) -> torch.device:
    """Raises TrainingError for CUDA where there is none: no silent fall-back.

    Float32 is then float32 on GPUs, too: in TF32, which torch convolves in, gradient penalties keep ten bits of it.
    """
    import torch

    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise TrainingError(
            f"--device cuda: torch {torch.__version__} sees no CUDA device; use --device cpu or install a CUDA build"
        )
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    return torch.device("cuda" if name == "cuda" or (name == "auto" and available) else "cpu")
