"""Which writer a suffix selects. A new format is one module and one row here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from solidgrain.bake.color import LINEAR, SRGB
from solidgrain.bake.writers.base import Option, Output, Volume, Writer
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
    check: Callable[[Output, Volume], None] = lambda output, volume: None  # raises UsageError or BakeError


def formats() -> dict[str, Format]:
    """Formats import their libraries when they are opened, so the whole table costs nothing."""
    from solidgrain.bake.writers import exr, npy, preview, vti

    return {
        ".exr": Format("exr", exr.ExrStack, exr.size, LINEAR, exr.files, exr.OPTIONS, exr.check),
        ".vti": Format("vti", vti.VtiFile, vti.size, SRGB, options=vti.OPTIONS),
        ".npy": Format("npy", npy.NpyFile, npy.size, SRGB),
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


def make_output(path: Path, kind: str = "", **options: str | int) -> Output:
    """The output that a file name asks for, every option filled in. Raises UsageError for what no writer knows."""
    kind = kind or kind_of(path)
    row = formats()[kind]
    known = {option.name: option.default for option in row.options} | {"colorspace": row.colorspace, **COMMON}
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise UsageError(f"{path}: unknown option {unknown[0]!r} of {row.name}; pick one of {', '.join(sorted(known))}")
    for option in row.options:
        if option.choices and options.get(option.name, option.default) not in option.choices:
            raise UsageError(f"{path}: {option.name} {options[option.name]!r}, expected one of {', '.join(option.choices)}")
    return Output(path, kind, known | {name: value for name, value in options.items() if value != ""})


COMMON: dict[str, str | int] = {"dither": 0}  # options of every format


def open_writer(output: Output, volume: Volume, workers: Workers) -> Writer:
    return formats()[output.kind].opener(output, volume, workers)


def output_files(output: Output, volume: Volume) -> list[Path]:
    """The files that an output will be, as absolute paths."""
    return [path.absolute() for path in formats()[output.kind].files(output, volume)]


def output_bytes(output: Output, volume: Volume) -> int:
    """The most bytes that an output can take (compressed formats take less)."""
    return formats()[output.kind].size(output, volume)


def check_output(output: Output, volume: Volume) -> None:
    """Refuse what the format cannot hold. Raises UsageError or BakeError with the reason."""
    formats()[output.kind].check(output, volume)


def output_exists(output: Output, volume: Volume) -> Path | None:
    """The first file of an output that exists already."""
    return next((path for path in output_files(output, volume) if path.exists()), None)
