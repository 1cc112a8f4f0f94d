"""Several texture files at once: all of them appear, or none does."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from solidgrain.bake.frames import PATTERN, frame_paths
from solidgrain.bake.interrupts import uninterrupted
from solidgrain.bake.sources import TEXTURE_SUFFIX, check_new
from solidgrain.runtime import BakeError, Texture, UsageError
from solidgrain.runtime.files import temporary_name


def sequence_files(out: Path, count: int, name: str) -> list[Path]:
    """The files of so many textures: of a frame pattern, or called `name` in a folder. Raises UsageError."""
    if out.is_dir():  # whatever the name is, it is no pattern
        return [out / f"{name}{f'.{k:04d}' * (count > 1)}{TEXTURE_SUFFIX}" for k in range(count)]
    if count > 1 and len(PATTERN.findall(out.name)) != 1:
        example = f"{out.name.removesuffix(TEXTURE_SUFFIX)}.####{TEXTURE_SUFFIX}"
        raise UsageError(f"--out {out}: expected a frame pattern for {count} textures, such as {example}, or a folder")
    return frame_paths(out, count, 0)


def check_sequence(files: Sequence[Path], overwrite: bool) -> None:
    """Raises UsageError for names that are no texture files', BakeError if a file is there and is to stay."""
    for file in files:
        check_new(file, overwrite)


def save_together(textures: Sequence[tuple[Path, Texture]]) -> None:
    """Save each texture to its file. If one cannot be written, none is, and what was there before is there again.

    Raises BundleError or BakeError.
    """
    hidden = [temporary_name(file) for file, _ in textures]
    try:
        for temporary, (_, texture) in zip(hidden, textures, strict=True):
            texture.save(temporary)
        with uninterrupted():
            _put_in_place(hidden, [file for file, _ in textures])
    finally:
        for temporary in hidden:
            temporary.unlink(missing_ok=True)


def _put_in_place(hidden: Sequence[Path], files: Sequence[Path]) -> None:
    moved: list[tuple[Path, Path]] = []  # from where, to where
    try:
        for temporary, file in zip(hidden, files, strict=True):
            former = temporary.with_suffix(".old")
            for source, target in ((file, former), (temporary, file)):
                if source.exists():
                    os.replace(source, target)
                    moved.append((source, target))
    except OSError as error:
        for source, target in reversed(moved):
            os.replace(target, source)
        raise BakeError(f"{file}: cannot put it in place ({error.strerror}); nothing was changed") from error
    for source, target in moved:
        if source in files:
            target.unlink()
