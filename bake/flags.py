"""The flags of `solidgrain bake`, and the plan that they ask for."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from solidgrain.bake.arguments import (
    parse_box,
    parse_corner,
    parse_count,
    parse_matrix,
    parse_pixel_size,
    parse_positive,
    parse_scale,
    parse_seed,
    parse_shard,
    parse_size,
    parse_spacing,
    parse_tile,
    parse_vector,
)
from solidgrain.bake.distributed import parse_cluster
from solidgrain.runtime.errors import EvaluationError, UsageError

if TYPE_CHECKING:
    from solidgrain.bake.plan import Plan
    from solidgrain.bake.writers import Output
    from solidgrain.runtime import Texture

# Flags that are about every --out, and the names of their values.
SHARED = {"--colorspace": "colorspace", "--dither": "dither", "--mips": "mips", "--mip-filter": "mip_filter", "--for": "engine"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", nargs="?", metavar="SOURCE", help="embedded name, bundle, texture file or photograph (granite)")
    add_cut(parser.add_argument_group("the photograph"))
    _add_grid(parser.add_argument_group("the grid"))
    _add_outputs(parser.add_argument_group("the files"))
    _add_formats(parser.add_argument_group("settings of the formats"))
    _add_work(parser.add_argument_group("the work"))
    add("--dry-run", action="store_true", help="print the plan with bytes, memory and time, and stop")
    add("--json", action="store_true", help="print one JSON object on stdout")
    add("--quiet", action="store_true", help="no progress on stderr")


def add_cut(group: argparse._ArgumentGroup) -> None:
    """Which part of a photograph a space encodes."""
    add = group.add_argument
    add("--patch-scale", type=parse_scale, metavar="S", help="photograph's pixels per texture pixel; more take in more (1)")
    add("--crop", type=parse_corner, metavar="X,Y", help="upper left corner of what is encoded, in its pixels (the middle)")


def _add_grid(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add("--size", type=parse_size, metavar="N|XxYxZ", help="voxels, x by y by z (128)")
    add("--seed", type=parse_seed, metavar="N", help="which instance of the texture (0)")
    add("--origin", type=parse_vector, metavar="X,Y,Z", help="corner of the grid, exemplar pixels (0,0,0)")
    add("--spacing", type=parse_spacing, metavar="S|X,Y,Z", help="exemplar pixels per voxel (1)")
    add("--box", type=parse_box, metavar="X,Y,Z,X,Y,Z", help="both corners of the grid, instead of --origin and --spacing")
    add("--pixel-size", type=parse_pixel_size, metavar="METRES", help="of an exemplar pixel; the lengths above are then metres")
    add("--transform", type=parse_matrix, metavar="4x4", help="16 numbers, row by row: the grid's place in the texture")
    add("--tile", type=parse_tile, metavar="AXES", help="axes that repeat seamlessly, any of xyz")
    add("--samples", type=int, choices=(1, 8, 27), help="per voxel, averaged in linear light (1)")


def _add_outputs(group: argparse._ArgumentGroup) -> None:
    from solidgrain.bake.engines import ENGINES

    add = group.add_argument
    add("--out", type=Path, action="append", default=[], metavar="FILE", help="granite.####.exr, .vti, .vdb, …; repeatable")
    add("--preview", type=Path, metavar="FILE.png", help="a PNG with three slices and the turned block")
    add("--colorspace", metavar="NAME", help="of the --out files, from $OCIO or the built-in configuration (each format's own)")
    add("--dither", action="store_true", help="triangular dither before rounding to whole numbers, a function of the voxel")
    add("--mips", action="store_true", help="write the mip chain too, filtered in linear light")
    add("--mip-filter", choices=("box", "kaiser"), help="kaiser is sharper (box)")
    add("--for", dest="engine", choices=tuple(ENGINES), help="axis order, layout and limits of a game engine")


def _add_formats(group: argparse._ArgumentGroup) -> None:
    """A flag for each setting of each format in the table."""
    from solidgrain.bake.writers import formats

    rows = {row.name: row for row in formats().values()}
    for row in rows.values():
        for option in row.options:
            flag, default = f"--{row.name}-{option.name}", f"{option.help} ({option.default})"
            if option.choices:
                group.add_argument(flag, choices=option.choices, help=default)
            elif isinstance(option.default, int):
                group.add_argument(flag, type=parse_count, metavar="N", help=default)
            else:
                group.add_argument(flag, metavar="TEXT", help=default)


def _add_work(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add(
        "--bundle",
        metavar="FOLDER",
        help="the bundle that a texture file belongs to, or the space that encodes a photograph (stone)",
    )
    add("--provider", default="auto", help="auto: the fused kernel, else ONNX Runtime; kernel, cpu, cuda, directml, … (auto)")
    add("--precision", choices=("float32", "bfloat16"), help="bfloat16: faster, needs AMX or AVX-512 BF16 (float32)")
    add("--threads", type=parse_count, default=0, metavar="N", help="0: every processor that the process may use (0)")
    existing = group.add_mutually_exclusive_group()
    existing.add_argument("--overwrite", action="store_true", help="replace outputs that exist")
    existing.add_argument("--no-clobber", action="store_true", help="skip outputs that exist")
    existing.add_argument("--update", action="store_true", help="bake only what is not there, whole and of this plan")
    add("--resume", action="store_true", help="go on where a bake of the same plan was stopped")
    add("--shard", type=parse_shard, metavar="I/N", help="bake share I of N; solidgrain merge completes the files")
    add("--plan", type=Path, metavar="FILE", help="bake a plan that was saved: a .bake.json, or what --dry-run --json printed")
    add("--jobs", type=Path, metavar="FILE", help="bake all that a job file lists, .json or .toml")
    add("--continue-on-error", action="store_true", help="go on with the next job of --jobs when one fails")
    add(
        "--dask", type=parse_cluster, metavar="local:N|ADDRESS", help="bake on N local processes, or a Dask scheduler's workers"
    )
    add("--emit-openjd", type=Path, metavar="FOLDER", help="write a render-farm job (Open Job Description) instead of baking")
    add("--shards", type=parse_positive, metavar="N", help="of --dask and --emit-openjd (one per slab, at most 64)")


def make_plan(arguments: argparse.Namespace, texture: Texture) -> Plan:
    """The plan that the flags ask for. Raises UsageError when they contradict each other."""
    from solidgrain.bake.evaluate import check_place
    from solidgrain.bake.plan import Plan, located

    size = arguments.size or (128, 128, 128)
    origin, spacing = _placement(arguments, size)
    source = arguments.source or "granite"
    plan = Plan(
        source=located(source),
        texture=texture.name,
        texture_sha256=texture.data.sha256,
        sampler_sha256=texture.data.sampler_sha256,
        precision=texture.precision,
        seed=arguments.seed or 0,
        size=size,
        origin=origin,
        spacing=spacing,
        tile=arguments.tile or "",
        outputs=tuple(make_outputs(arguments)),
        transform=arguments.transform,
        samples=arguments.samples or 1,
        bundle=arguments.bundle and located(arguments.bundle),
    )
    try:
        check_place(plan, texture)
    except EvaluationError as error:
        raise UsageError(f"--size, --origin, --spacing, --transform and --tile: {error}") from error
    return plan


def make_outputs(arguments: argparse.Namespace) -> list[Output]:
    """The files that the flags name, by absolute paths, with the settings of their formats."""
    from solidgrain.bake.writers import PREVIEW, kind_of, make_output

    _check_uses(arguments)
    outputs = []
    for path in arguments.out:
        kind = kind_of(path)
        outputs.append(make_output(path.absolute(), kind, **asked_options(arguments, kind)))
    if arguments.preview:
        if arguments.preview.suffix.lower() != ".png":
            raise UsageError(f"--preview {arguments.preview}: expected a name that ends in .png")
        outputs.append(make_output(arguments.preview.absolute(), PREVIEW))
    return outputs


def asked_options(arguments: argparse.Namespace, kind: str) -> dict[str, str | int]:
    """What the flags say of a file of this kind, without what they leave to its format."""
    from solidgrain.bake.writers import formats

    row = formats()[kind]
    flags = {option.name: getattr(arguments, f"{row.name}_{option.name}".replace("-", "_")) for option in row.options}
    given = {name: value for name, value in flags.items() if value is not None}
    return {**_shared_options(arguments, kind), **given}


def check_dither(arguments: argparse.Namespace, outputs: Sequence[Output]) -> None:
    """Refuse `--dither` where no output's type rounds. Raises UsageError."""
    from solidgrain.bake.writers import rounds

    if arguments.dither and not any(map(rounds, outputs)):
        raise UsageError("--dither: no --out of whole numbers, of the types asked for; leave it out")


def unused(paths: Sequence[Path]) -> dict[str, str]:
    """The flags that none of these outputs has a use for, each with the reason."""
    from solidgrain.bake.writers import formats, kind_of, may_round

    written = {formats()[kind_of(path)].name for path in paths}
    others = [row for row in formats().values() if row.name not in written]
    found = {f"--{row.name}-{option.name}": "no --out of this format" for row in others for option in row.options}
    if not any(may_round(kind_of(path)) for path in paths):
        found["--dither"] = "no --out of whole numbers"
    if not written:
        found |= dict.fromkeys(SHARED, "the preview has no use for it, and there is no --out")
    return found


def _check_uses(arguments: argparse.Namespace) -> None:
    """Refuse flags that are about no output. Raises UsageError."""
    for flag, reason in unused(arguments.out).items():
        if getattr(arguments, SHARED.get(flag, flag[2:].replace("-", "_"))) not in (None, False):
            raise UsageError(f"{flag}: {reason}; leave it out")
    if arguments.colorspace == "":
        raise UsageError("--colorspace: expected a name, found nothing")


def _shared_options(arguments: argparse.Namespace, kind: str) -> dict[str, str | int]:
    """The options that outputs of every kind have."""
    if arguments.mip_filter and not arguments.mips:
        raise UsageError("--mip-filter: there are no levels to filter; add --mips")
    options: dict[str, str | int] = {"mips": (arguments.mip_filter or "box") if arguments.mips else ""}
    if arguments.colorspace is not None:
        options["colorspace"] = arguments.colorspace
    if arguments.dither:
        options["dither"] = 1
    if arguments.engine:
        from solidgrain.bake.engines import axes_for

        options |= {"engine": arguments.engine, "axes": axes_for(arguments.engine, kind)}
    return options


def _placement(
    arguments: argparse.Namespace, size: tuple[int, int, int]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Origin and spacing (x, y, z) in exemplar pixels."""
    scale = arguments.pixel_size or 1.0
    if arguments.box is None:
        origin, spacing = arguments.origin or (0.0, 0.0, 0.0), arguments.spacing
        if spacing is None:
            return _scaled(origin, scale), (1.0, 1.0, 1.0)
        return _scaled(origin, scale), _scaled(spacing, scale)
    if arguments.origin is not None or arguments.spacing is not None:
        raise UsageError("--box: says where the grid is already; leave out --origin and --spacing")
    low, high = arguments.box[:3], arguments.box[3:]
    steps = [(stop - start) / count for start, stop, count in zip(low, high, size, strict=True)]
    return _scaled(low, scale), _scaled(steps, scale)


def _scaled(values: object, scale: float) -> tuple[float, float, float]:
    x, y, z = (float(value) / scale for value in values)  # type: ignore[attr-defined]
    return (x, y, z)
