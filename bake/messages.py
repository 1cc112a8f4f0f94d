"""What commands say besides their data: lines on stderr."""

from __future__ import annotations

import shlex
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


def tell(line: str) -> None:
    print(line, file=sys.stderr)


def warn(line: str) -> None:
    tell(f"warning: {line}")


def tell_error(message: object) -> None:
    tell(f"solidgrain: {message}")


def first_line(error: Exception, otherwise: str = "") -> str:
    """What another library's error says, in a line; for one that says nothing, something else, or its type."""
    said = str(error).strip()
    return said.splitlines()[0] if said else otherwise or type(error).__name__


def tell_next(file: Path, sampler_sha256: str, bundle: str) -> None:
    """How to bake a texture file; `bundle` names its space, which need not be said where it is found anyway."""
    from solidgrain.runtime.bundle import find_bundle

    words = [str(file), *([] if find_bundle(sampler_sha256, file.parent) else ["--bundle", bundle])]
    tell(f"{file}: next: solidgrain bake {shlex.join(words)} --size 128 --out out.vti")
