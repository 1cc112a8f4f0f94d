"""Which writer a suffix selects. A new format is one module and one row here."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from solidgrain.bake.color import HALF_LARGEST, LINEAR, SRGB, color_options
from solidgrain.bake.writers.base import Option, Output, Volume, Writer
from solidgrain.bake.writers.mips import FILTERS, MippedWriter, level_output, level_volumes
from solidgrain.bake.writers.orient import SPOOL_BYTES, UPRIGHT, OrientedWriter, oriented, slab_bytes
from solidgrain.runtime.errors import UsageError
from solidgrain.runtime.workers import Workers


@dataclass(frozen=True)
class Format:
    """A file format: how to open it, its size at most, its settings, and what it cannot hold."""

    name: str  # of its flags: --<name>-<option>
    opener: Callable[[Output, Volume, Workers], Writer]
    size: Callable[[Output, Volume], int]  # bytes at most, of the final files
    colorspace: str  # of its colours, unless --colorspace says otherwise
    files: Callable[[Output, Volume], list[Path]] = lambda output, volume: [output.path]
    options: tuple[Option, ...] = ()
    scratch: Callable[[Output], int] = lambda output: 0  # bytes per voxel that its staging holds besides the final files
    sample_type: str = "float"  # what it holds, unless its option `type` says so
    linear_types: tuple[str, ...] = ()  # of its option `type`, those whose colours are linear instead: no header says sRGB
    levels_inside: bool = False  # mip levels are in the file itself
    check: Callable[[Output, Volume], None] = lambda output, volume: None  # raises UsageError or BakeError


def formats() -> dict[str, Format]:
    """Formats import their libraries when they are opened, so the whole table costs nothing."""
    from solidgrain.bake.writers import atlas, dds, exr, npy, preview, raw, vdb, vti

    atlas_of = partial(
        Format,
        "atlas",
        atlas.AtlasFile,
        atlas.size,
        files=atlas.files,
        options=atlas.OPTIONS,
        scratch=atlas.scratch,
        check=atlas.check,
    )
    return {
        ".exr": Format("exr", exr.ExrStack, exr.size, LINEAR, exr.files, exr.OPTIONS, check=exr.check),
        ".vti": Format("vti", vti.VtiFile, vti.size, SRGB, options=vti.OPTIONS),
        ".npy": Format("npy", npy.NpyFile, npy.size, SRGB),
        ".vdb": Format("vdb", vdb.VdbFile, vdb.size, LINEAR, options=vdb.OPTIONS, scratch=vdb.scratch, check=vdb.check),
        ".dds": Format(
            "dds",
            dds.DdsFile,
            dds.size,
            SRGB,
            options=dds.OPTIONS,
            linear_types=("rgba16f",),
            levels_inside=True,
            check=dds.check,
        ),
        ".raw": Format("raw", raw.RawFile, raw.size, SRGB, raw.files, raw.OPTIONS),
        ".atlas.png": atlas_of(SRGB, sample_type="uint8"),
        ".atlas.exr": atlas_of(LINEAR, sample_type="half"),
        PREVIEW: Format("preview", preview.PreviewFile, preview.size, SRGB),
    }


PREVIEW = "preview"  # the kind that no suffix selects


def suffixes() -> list[str]:
    return [suffix for suffix in formats() if suffix.startswith(".")]


def kind_of(path: Path) -> str:
    """The longest suffix of the table that a file name ends in. Raises UsageError if there is none."""
    fitting = [suffix for suffix in suffixes() if path.name.lower().endswith(suffix)]
    if not fitting:
        raise UsageError(f"--out {path}: unknown format {path.suffix!r}; pick one of {', '.join(suffixes())}")
    return max(fitting, key=len)


def make_output(path: Path, kind: str = "", /, **options: str | int) -> Output:
    """The output that a file name asks for, every option filled in. Raises UsageError for what no writer knows."""
    kind = kind or kind_of(path)
    row = formats()[kind]
    known = {option.name: option.default for option in row.options} | {
        "colorspace": LINEAR if options.get("type") in row.linear_types else row.colorspace,
        "colorconfig": "",
        **COMMON,
    }
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise UsageError(f"{path}: unknown option {unknown[0]!r} of {row.name}; pick one of {', '.join(sorted(known))}")
    for option in row.options:
        if option.choices and options.get(option.name, option.default) not in option.choices:
            raise UsageError(f"{path}: {option.name} {options[option.name]!r}, expected one of {', '.join(option.choices)}")
    if any(isinstance(value, int) and value < 0 for value in options.values()) or options.get("dither", 0) not in (0, 1):
        raise UsageError(f"{path}: expected whole numbers from 0, and 0 or 1 for dither, found {options}")
    _check_axes(path, str(options.get("axes", UPRIGHT)))
    if options.get("mips", "") not in ("", *FILTERS):
        raise UsageError(f"{path}: mips {options['mips']!r}, expected one of {', '.join(FILTERS)}")
    own = {option.name for option in row.options}
    filled = known | {name: value for name, value in options.items() if value != "" or name in own}
    output = Output(path, kind, filled | color_options(str(filled["colorspace"]), str(filled["colorconfig"])))
    return output if rounds(output) else replace(output, options={**output.options, "dither": 0})


def _check_axes(path: Path, axes: str) -> None:
    if sorted(axes[1::2]) != list("xyz") or not set(axes[::2]) <= set("+-") or len(axes) != 6:
        raise UsageError(f"{path}: axes {axes!r}, expected each of x, y and z once with its sign, such as +x-y+z")


COMMON: dict[str, str | int] = {"dither": 0, "mips": "", "axes": UPRIGHT, "engine": ""}  # options of every format


def open_writer(output: Output, volume: Volume, workers: Workers) -> Writer:
    """The writer of an output: its format's, with mip levels and turned as the output asks for."""
    axes = axes_of(output)
    if axes == UPRIGHT:
        return _upright(output, volume, workers)
    return OrientedWriter(output, volume, workers, axes, _upright)


def _upright(output: Output, volume: Volume, workers: Workers) -> Writer:
    row = formats()[output.kind]
    if output.options["mips"]:
        return MippedWriter(output, volume, workers, row.opener, row.levels_inside)
    return row.opener(output, volume, workers)


def axes_of(output: Output) -> str:
    """Which axes of the texture the x, y and z of an output's files are."""
    return SLICE_AXES.get(str(output.options.get("axis", "")), str(output.options["axes"]))


SLICE_AXES = {"x": "+y+z+x", "y": "+x+z+y"}  # of stacks whose slices lie across x or y


def _levels(output: Output, volume: Volume) -> list[tuple[Output, Volume]]:
    """An output and its volume as its files hold it; and those of its mip levels, where they are files of their own."""
    turned = oriented(volume, axes_of(output)) if axes_of(output) != UPRIGHT else volume
    below = level_volumes(turned) if output.options["mips"] and not formats()[output.kind].levels_inside else []
    return [(output, turned), *((level_output(output, level.level), level) for level in below)]


def output_files(output: Output, volume: Volume) -> list[Path]:
    """The files that an output will be, as absolute paths."""
    row = formats()[output.kind]
    return [path.absolute() for level in _levels(output, volume) for path in row.files(*level)]


def output_bytes(output: Output, volume: Volume) -> int:
    """The most bytes that an output can take (compressed formats take less)."""
    row, levels = formats()[output.kind], _levels(output, volume)
    inside = level_volumes(levels[0][1]) if output.options["mips"] and row.levels_inside else []
    return sum(row.size(*level) for level in [*levels, *((output, level) for level in inside)])


def scratch_bytes(output: Output, volume: Volume) -> int:
    """The bytes that a bake keeps beside an output until it is whole, besides its files."""
    row, spooled = formats()[output.kind], SPOOL_BYTES * volume.voxels if axes_of(output) != UPRIGHT else 0
    if not output.options["mips"]:
        return spooled + row.scratch(output) * volume.voxels
    reduced = 12 * volume.voxels * 2 // 7  # a quarter, an eighth of that, ...
    below = level_volumes(_levels(output, volume)[0][1])
    staged = sum(row.size(output, level) for level in below) if row.levels_inside else 0  # and in the file itself
    return spooled + reduced + staged + row.scratch(output) * (volume.voxels + sum(level.voxels for level in below))


def turned_bytes(output: Output, volume: Volume) -> int:
    """The colours, as float32, that a turned output is put together from at a time; 0 for one that is not turned."""
    return 0 if axes_of(output) == UPRIGHT else slab_bytes(oriented(volume, axes_of(output)))


def check_output(output: Output, volume: Volume) -> None:
    """Refuse what the format cannot hold. Raises UsageError or BakeError with the reason."""
    row = formats()[output.kind]
    held, turned = _levels(output, volume)[0]
    row.check(held, turned)
    if output.options["engine"] and output.options.get("axis", "z") != "z":
        raise UsageError(f"--for {output.options['engine']}: has axes of its own; leave out --{row.name}-axis")
    if output.options["engine"]:
        from solidgrain.bake.engines import check_engine

        check_engine(str(output.options["engine"]), held, turned)


def output_exists(output: Output, volume: Volume) -> bool:
    """Whether any file of an output exists already."""
    return any(os.path.lexists(path) for path in output_files(output, volume))


def clips(output: Output) -> bool:
    """Whether the files of an output hold whole numbers, which have no room for colours outside [0, 1]."""
    return _sample_type(output) in WHOLE_NUMBERS


def bounds(output: Output) -> tuple[float, float]:
    """The least and the greatest colour that its files can hold."""
    if clips(output):
        return 0.0, 1.0
    largest = float(HALF_LARGEST) if _sample_type(output) in HALVES else math.inf
    return -largest, largest


def rounds(output: Output) -> bool:
    """Whether its colours become whole numbers, blocks of them included: what dither is for."""
    return _sample_type(output) in ROUNDED


def may_round(kind: str) -> bool:
    """Whether a format has a type that `rounds`."""
    row = formats()[kind]
    types = [choice for option in row.options if option.name == "type" for choice in option.choices] or [row.sample_type]
    return any(choice in ROUNDED for choice in types)


def _sample_type(output: Output) -> str:
    return str(output.options.get("type", formats()[output.kind].sample_type))


BLOCKS = ("bc1", "bc7")
WHOLE_NUMBERS = ("uint8", "uint16", "rgba8")
ROUNDED = (*WHOLE_NUMBERS, *BLOCKS)
HALVES = ("half", "rgba16f")
