"""The run that `solidgrain train` goes about: a new one, as the flags and the photographs make it, or one to go on with."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch

from solidgrain.bake.messages import tell, warn
from solidgrain.runtime.errors import TrainingError, UsageError
from solidgrain.train import misgivings
from solidgrain.train.collection import choose_held_out, photographs_in, read_members
from solidgrain.train.exemplar import FloatArray, measure_grain
from solidgrain.train.photograph import read_photograph, scaled
from solidgrain.train.run import (
    CHECKPOINT,
    Run,
    RunFolder,
    Source,
    create_run,
    held,
    pixels_sha256,
    undone_on_failure,
)
from solidgrain.train.settings import PRESET_ITERATIONS, Budget, Settings, preset
from solidgrain.train.space_run import SpaceRun, create_space_run, open_any
from solidgrain.train.variants import vary
from solidgrain.train.vgg import find_weights
from solidgrain.train.warm_start import learned, warm_start

SMALLEST_PATCH = 32  # pixels
FIXED = (
    "preset",
    "variant",
    "anisotropic",
    "upright",
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


def begin(arguments: argparse.Namespace, device: torch.device, stack: ExitStack | None) -> RunFolder:
    """The run to train: the one to go on with, or a new one.

    The first of several processes, the one with a stack, makes it, and holds it until the stack is left.
    """
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
    if isinstance(training, SpaceRun):
        for line in misgivings.of_space(training, arguments.warm_start):
            warn(line)
    return training


def resume(arguments: argparse.Namespace) -> RunFolder:
    """The run to go on with, under its own settings; --iterations, --minutes and --until-plateau replace its budget."""
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


def start(arguments: argparse.Namespace) -> Run:
    """A new run directory for the photograph, with what is to be said of it."""
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
    for line in misgivings.of_photograph(arguments.exemplar, exemplar):
        warn(line)
    settings = with_grain(settings, arguments.anisotropic, exemplar)
    of_photograph = "" if scale == 1 else pixels_sha256(photograph)
    source = Source(arguments.exemplar.name, arguments.license or "", arguments.credit or "", colorspace, scale, of_photograph)
    return create_run(arguments.out, settings, exemplar, source, make_budget(arguments, settings))


def start_space(arguments: argparse.Namespace) -> RunFolder:
    """A new run directory for a folder of photographs."""
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
    budget, held_out = make_budget(arguments, settings), held_out_names(arguments.hold_out)
    choose_held_out([path.name for path in photographs_in(arguments.space)], held_out, settings.seed)  # before all are read
    return create_space_run(arguments.out, settings, members, held_out, source, budget)


def make_settings(arguments: argparse.Namespace) -> Settings:
    """The preset, with what the flags change. Raises UsageError for a patch that is too small, SolidgrainError without VGG."""
    if arguments.upright and not arguments.anisotropic:
        raise UsageError("--upright: slices that stay upright turn about one axis; add --anisotropic")
    changes = {name: getattr(arguments, name) for name in ("patch", "batch", "seed", "precision", "upright")}
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


def with_grain(settings: Settings, anisotropic: str | None, exemplar: FloatArray) -> Settings:
    """The settings for an oriented material: the axis about which slices turn, and how long its structures start."""
    if anisotropic is None:
        return settings
    grain = measure_grain(exemplar)
    axis: Literal["x", "y"] = grain.axis if anisotropic == "auto" else "x" if anisotropic == "x" else "y"
    ratio = grain.ratio if settings.preset == "fast" and axis == grain.axis else 1.0
    return replace(settings, grain=axis, grain_ratio=ratio)


def make_budget(arguments: argparse.Namespace, settings: Settings) -> Budget:
    """How long to train: what the flags say, or the preset's iterations. Raises UsageError for a space with a plateau."""
    preset_name = settings.preset + (" space" if settings.latent else "")
    if arguments.until_plateau and settings.latent:
        raise UsageError("--until-plateau: is about a single exemplar; give a --space its --iterations or --minutes")
    if arguments.iterations is None and arguments.minutes is None:
        return Budget(PRESET_ITERATIONS[preset_name], until_plateau=arguments.until_plateau)
    return Budget(arguments.iterations, arguments.minutes, arguments.until_plateau)


def held_out_names(text: str | None) -> int | list[str]:
    """How many exemplars to hold out, or which. Raises UsageError if it is neither a number nor a file."""
    if text is None or text.isdecimal():
        return int(text or 0)
    try:
        return [line.strip() for line in Path(text).read_text("utf-8").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"--hold-out {text}: expected a number, or a file with a name per line ({error})") from error
