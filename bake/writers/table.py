"""Which writer a suffix selects. A new format is one module and one row here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from solidgrain.bake.writers.base import Output, Volume, Writer
from solidgrain.runtime.errors import UsageError
from solidgrain.runtime.workers import Workers


@dataclass(frozen=True)
class Format:
    """A file format: how to open it, its size at most, and the files that a path stands for."""

    opener: Callable[[Output, Volume, Workers], Writer]
    size: Callable[[Output, Volume], int]
    files: Callable[[Output, Volume], list[Path]]
    encoding: str  # of its colours


def _formats() -> dict[str, Format]:
    """Formats import their libraries when they are opened, so the whole table costs nothing."""
    from solidgrain.bake.writers import exr, npy, preview, vti

    return {
        ".exr": Format(exr.ExrStack, exr.size, exr.files, "lin_rec709_scene"),
        ".vti": Format(vti.VtiFile, vti.size, _single, "srgb_rec709_scene"),
        ".npy": Format(npy.NpyFile, npy.size, _single, "srgb_rec709_scene"),
        "preview": Format(preview.PreviewFile, preview.size, _single, "srgb_rec709_scene"),
    }


def _single(output: Output, volume: Volume) -> list[Path]:
    return [output.path]


def suffixes() -> list[str]:
    return [suffix for suffix in _formats() if suffix.startswith(".")]


def make_output(path: Path, **options: str | int) -> Output:
    """The output that a file name asks for. Raises UsageError for a suffix that nothing writes."""
    if path.suffix.lower() not in suffixes():
        raise UsageError(f"--out {path}: unknown format {path.suffix!r}; pick one of {', '.join(suffixes())}")
    return Output(path, path.suffix.lower(), options)


def open_writer(output: Output, volume: Volume, workers: Workers) -> Writer:
    return _formats()[output.kind].opener(output, volume, workers)


def output_files(output: Output, volume: Volume) -> list[Path]:
    """The files that an output will be, as absolute paths."""
    return [path.absolute() for path in _formats()[output.kind].files(output, volume)]


def encoding(output: Output) -> str:
    """The colour encoding that the files of an output hold, by its colour interop name."""
    return _formats()[output.kind].encoding


def output_bytes(output: Output, volume: Volume) -> int:
    """The most bytes that an output can take (compressed formats take less)."""
    return _formats()[output.kind].size(output, volume)


def output_exists(output: Output, volume: Volume) -> Path | None:
    """The first file of an output that exists already."""
    return next((path for path in output_files(output, volume) if path.exists()), None)
