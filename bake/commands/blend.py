"""`solidgrain blend`: textures between two of a space, or one texture that goes from one to the other in space."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from solidgrain.bake.arguments import parse_length, parse_spacing, parse_steps, parse_vector
from solidgrain.bake.flags import add_cut
from solidgrain.bake.messages import tell, tell_next
from solidgrain.runtime.errors import EvaluationError, UsageError

if TYPE_CHECKING:
    from solidgrain.runtime import Space, Texture

START, STOP = 0.0, 128.0  # of --along


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("first", metavar="A", help="a texture file or a photograph")
    add("second", metavar="B", help="a texture file or a photograph")
    add("--out", type=Path, required=True, metavar="FILE", help="ab.sgt.npz; for several ab.####.sgt.npz, or a folder")
    add("--bundle", default="stone", metavar="SPACE", help="embedded name or bundle of the space (stone)")
    _add_at(parser.add_argument_group("textures between them"))
    _add_place(parser.add_argument_group("one texture, A here and B there"))
    add_cut(parser.add_argument_group("photographs"))
    add("--overwrite", action="store_true", help="replace files that exist")
    add("--json", action="store_true", help="print one JSON object on stdout")


def _add_at(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--at", type=parse_steps, metavar="W|FIRST:LAST:STEP", help="how far from A (0) to B (1): 0.5; 0:1:0.1, a texture each"
    )


def _add_place(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add("--along", choices=("x", "y", "z"), help="the axis along which A turns into B")
    add("--from", dest="start", type=parse_length, metavar="P", help=f"it is A up to there, exemplar pixels ({START:g})")
    add("--to", dest="stop", type=parse_length, metavar="P", help=f"it is B from there on ({STOP:g})")
    add("--mask", type=Path, metavar="FILE", help="a volume, .npy [z, y, x] or .vti: A where it is 0, B where it is 1")
    add("--mask-origin", type=parse_vector, metavar="X,Y,Z", help="corner of the mask, exemplar pixels (0,0,0)")
    add("--mask-spacing", type=parse_spacing, metavar="S|X,Y,Z", help="exemplar pixels per voxel of the mask (1)")


def run(arguments: argparse.Namespace) -> int:
    from solidgrain.bake.sequence import check_sequence, save_together, sequence_files
    from solidgrain.runtime import load_space

    _check_modes(arguments)
    space = load_space(arguments.bundle)
    first, second = _ends(arguments, space)
    files = sequence_files(arguments.out, len(arguments.at or (None,)), f"{first.name}-{second.name}")
    check_sequence(files, arguments.overwrite)
    blends = list(_blends(arguments, space, first, second))
    save_together([(file, texture) for file, (_, texture) in zip(files, blends, strict=True)])
    if arguments.json:
        rows = [
            {"texture": str(file), **place, "name": texture.name, "texture_sha256": texture.data.sha256}
            for file, (place, texture) in zip(files, blends, strict=True)
        ]
        print(json.dumps({"space": space.name, "sampler_sha256": space.bundle.sampler_sha256, "textures": rows}, indent=2))
    tell_next(files[0], space.bundle.sampler_sha256, arguments.bundle)
    return 0


def _check_modes(arguments: argparse.Namespace) -> None:
    """Raises UsageError unless the flags ask for one kind of blend."""
    modes = [flag for flag in ("at", "along", "mask") if getattr(arguments, flag) is not None]
    if len(modes) != 1:
        found = " and ".join(f"--{mode}" for mode in modes) or "none"
        raise UsageError(f"blend: expected one of --at, --along and --mask, found {found}")
    flags = {"start": ("--from", "along"), "stop": ("--to", "along")}
    flags |= {name: (f"--{name.replace('_', '-')}", "mask") for name in ("mask_origin", "mask_spacing")}
    for name, (flag, mode) in flags.items():
        if getattr(arguments, name) is not None and modes != [mode]:
            raise UsageError(f"{flag}: is about --{mode}, which is not there; leave it out")


def _ends(arguments: argparse.Namespace, space: Space) -> tuple[Texture, Texture]:
    """Both textures. What is cut of a photograph is cut of both, if they both are."""
    from solidgrain.bake.sources import WHERE_IT_IS, Cut, is_photograph, open_in_space

    cut, sources = Cut(arguments.patch_scale, arguments.crop), (arguments.first, arguments.second)
    if cut != WHERE_IT_IS and not any(map(is_photograph, sources)):
        raise UsageError("--patch-scale and --crop: are about photographs, and there are none; leave them out")
    first, second = (open_in_space(space, source, cut if is_photograph(source) else WHERE_IT_IS, tell) for source in sources)
    return first, second


def _blends(
    arguments: argparse.Namespace, space: Space, first: Texture, second: Texture
) -> Iterator[tuple[dict[str, Any], Texture]]:
    """The blends, and what to say of each."""
    if arguments.at is not None:
        for at in arguments.at:
            yield {"at": at}, space.blend(first, second, at)
    elif arguments.along is not None:
        start = START if arguments.start is None else arguments.start
        stop = STOP if arguments.stop is None else arguments.stop
        place = {"along": arguments.along, "from": start, "to": stop}
        try:
            yield place, space.blend_along(first, second, arguments.along, start, stop)
        except EvaluationError as error:
            raise UsageError(f"--from and --to: {error}") from error
    else:
        yield _by_mask(arguments, space, first, second)


def _by_mask(arguments: argparse.Namespace, space: Space, first: Texture, second: Texture) -> tuple[dict[str, Any], Texture]:
    from solidgrain.bake.masks import read_mask

    mask = read_mask(arguments.mask)
    origin = arguments.mask_origin or mask.origin or (0.0, 0.0, 0.0)
    spacing = arguments.mask_spacing or mask.spacing or (1.0, 1.0, 1.0)
    try:
        texture = space.blend_by(first, second, mask.values, origin, spacing)
    except EvaluationError as error:
        raise EvaluationError(f"--mask {arguments.mask}: {error}") from error
    return {"mask": str(arguments.mask), "origin": origin, "spacing": spacing}, texture
