"""`solidgrain adapt`: a texture of a space, fitted to one photograph."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from solidgrain.bake.arguments import parse_count, parse_positive, parse_seconds, parse_seed
from solidgrain.bake.flags import add_cut
from solidgrain.bake.messages import tell, tell_next, warn
from solidgrain.runtime.errors import UsageError
from solidgrain.runtime.space import DEFAULT_SPACE
from solidgrain.train.command import INTERRUPTED, choose_device, forbid_tf32
from solidgrain.train.console import Progress, StopRequest

if TYPE_CHECKING:
    import torch

    from solidgrain.runtime.space import Space
    from solidgrain.runtime.texture_file import TextureData
    from solidgrain.train.adapt import Adapted, Features, Report
    from solidgrain.train.photograph import FloatArray
    from solidgrain.train.settings import Budget, Settings

WHY = {
    "budget": "all that it may",
    "plateau": "L_style no longer falls",
    "stopped": "stopped, what there is is saved",
    "diverged": "L_style diverged",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("photo", type=Path, metavar="PHOTO", help="a photograph (PNG, JPEG, TIFF, EXR, ...)")
    add("--out", type=Path, required=True, metavar="FILE", help="the texture file to write, .sgt.npz")
    add("--bundle", default=DEFAULT_SPACE, metavar="SPACE", help=f"embedded name or bundle of the space ({DEFAULT_SPACE})")
    add("--critic", type=Path, metavar="FILE", help="the space's critic, from export --companion (critic.npz in the bundle)")
    add("--features", choices=("critic", "vgg"), default="critic", help="what compares slices with the photograph (critic)")
    add(
        "--iterations",
        type=parse_positive,
        metavar="N",
        help="at most (600, or as many as --seconds allow); alone, there is no limit of time",
    )
    add("--seconds", type=parse_seconds, metavar="S", help="at most (120); the result then depends on the machine's speed")
    add_cut(parser.add_argument_group("the photograph"))
    add("--seed", type=parse_seed, default=0, metavar="N", help="of all randomness (0)")
    add("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to compute (auto)")
    add("--threads", type=parse_count, default=0, metavar="N", help="0: every processor that the process may use (0)")
    add("--overwrite", action="store_true", help="replace the file if it exists")
    add("--json", action="store_true", help="print one JSON object on stdout")
    add("--quiet", action="store_true", help="no progress on stderr")


def run(arguments: argparse.Namespace) -> int:
    import torch

    from solidgrain.bake.sources import check_new
    from solidgrain.runtime import load_space
    from solidgrain.runtime.workers import usable_threads
    from solidgrain.train.adapt import FrozenSampler, adapt

    check_flags(arguments)
    check_new(arguments.out, arguments.overwrite)
    forbid_tf32()
    device = choose_device(arguments.device)
    threads = arguments.threads or usable_threads()
    torch.set_num_threads(threads)
    space = load_space(arguments.bundle, threads=threads)
    features, settings = open_features(space, arguments, device)
    start, material = read_photo(space, arguments)
    sampler = FrozenSampler(space.bundle, start, device)
    budget = make_budget(arguments)
    stop, progress = StopRequest(arguments.quiet), Progress(budget, arguments.quiet, describe)
    found = adapt(
        start, sampler, material, features, settings, budget, device, on_report=progress.show, should_stop=stop.requested
    )
    progress.end()
    if found.iterations == 0:
        tell(f"stopped before the first iteration; {arguments.out} is not written")
        return INTERRUPTED
    space.open(found.texture).save(arguments.out)
    say(found, space, arguments)
    return INTERRUPTED if found.ended == "stopped" else 0


def describe(report: Report, done: float, left: float) -> str:
    return f"iteration {report.iteration}, at most {left:.0f} s left, L_style {report.style:.4f}"


def check_flags(arguments: argparse.Namespace) -> None:
    if arguments.features == "vgg" and arguments.critic:
        raise UsageError("--features vgg: compares without a critic; leave --critic out")
    if arguments.out.exists() and arguments.photo.exists() and arguments.out.samefile(arguments.photo):
        raise UsageError(f"--out {arguments.out}: is the photograph itself; choose another name")


def make_budget(arguments: argparse.Namespace) -> Budget:
    from solidgrain.train.adapt import ITERATIONS, SECONDS
    from solidgrain.train.settings import Budget

    if arguments.iterations is None and arguments.seconds is None:
        return Budget(ITERATIONS, SECONDS / 60)
    if arguments.seconds is None:
        return Budget(arguments.iterations)
    return Budget(arguments.iterations, arguments.seconds / 60)


def open_features(space: Space, arguments: argparse.Namespace, device: torch.device) -> tuple[Features, Settings]:
    """What compares slices with the photograph, and the settings of both. Raises BundleError without a critic that fits."""
    from solidgrain.train.adapt import critic_features, vgg_features
    from solidgrain.train.companion import find_companion, read_companion, seen_settings

    if arguments.features == "vgg":
        features, settings = vgg_features(device), seen_settings(space.bundle.manifest["training"].get("settings"))
    else:
        companion = read_companion(find_companion(space.bundle, arguments.critic), space.bundle)
        features, settings = critic_features(companion, device), companion.settings
    return features, replace(settings, seed=arguments.seed)


def read_photo(space: Space, arguments: argparse.Namespace) -> tuple[TextureData, FloatArray]:
    """What E and Q make of the photograph, and the pixels to adapt to: all of it, or with --crop what E sees."""
    from solidgrain.bake.sources import Cut, cut_patch
    from solidgrain.train.misgivings import of_photograph
    from solidgrain.train.photograph import read_photograph, scaled

    photograph = read_photograph(arguments.photo, 1)
    if photograph.warning:
        warn(f"{arguments.photo}: {photograph.warning}")
    cut = Cut(arguments.patch_scale, arguments.crop)
    patch, note = cut_patch(photograph.pixels, space.patch, cut, str(arguments.photo))
    tell(note)
    start = space.own(space.encode(patch, arguments.photo.stem, cut.scale or 1.0))
    material = patch if cut.corner else scaled(photograph.pixels, cut.scale or 1.0)
    for line in of_photograph(arguments.photo, material):
        warn(line)
    return start, material


def say(found: Adapted, space: Space, arguments: argparse.Namespace) -> None:
    """What came of it."""
    report = {
        "texture": str(arguments.out),
        "name": found.texture.name,
        "space": space.name,
        "sampler_sha256": found.texture.sampler_sha256,
        "texture_sha256": found.texture.sha256,
        "patch_scale": found.texture.scale,
        "crop": arguments.crop,
        "features": arguments.features,
        "style_start": found.start,
        "style_end": found.end,
        "iterations": found.iterations,
        "seconds": round(found.seconds, 1),
        "ended": found.ended,
    }
    if arguments.json:
        print(json.dumps(report, indent=2))
    if found.ended == "diverged":
        warn(f"L_style diverged at iteration {found.iterations}; the best before that is kept")
    if found.end >= found.start:
        warn("L_style has not fallen; the texture is the one that the encoder gives")
    spent = f"{found.iterations} iterations, {found.seconds:.0f} s"
    tell(f"L_style {found.start:.4f} -> {found.end:.4f}, {spent} ({WHY[found.ended]})")
    tell_next(arguments.out, found.texture.sampler_sha256, arguments.bundle)
