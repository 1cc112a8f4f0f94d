"""What a command is given to evaluate: an embedded name, a bundle, a texture file, or a photograph that a space encodes."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from zipfile import is_zipfile

import numpy as np
import numpy.typing as npt

from solidgrain.runtime import BakeError, BundleError, ExemplarError, Space, Texture, UsageError, load_space
from solidgrain.runtime.space import DEFAULT_SPACE
from solidgrain.runtime.texture_file import read_texture
from solidgrain.train.photograph import SUFFIXES, read_photograph, scaled  # what a bake shares with training: no torch

if TYPE_CHECKING:
    from solidgrain.bake.plan import Plan

FloatArray = npt.NDArray[np.float32]


class Cut(NamedTuple):
    """Which part of a photograph is encoded."""

    scale: float | None = None  # photograph's pixels per texture pixel, None for 1
    corner: tuple[int, int] | None = None  # (x, y) of its upper left one, in the photograph's pixels; None for the middle


WHERE_IT_IS = Cut()
Note = Callable[[str], None]
TEXTURE_SUFFIX = ".sgt.npz"


def _silent(line: str) -> None:
    pass


def is_photograph(source: str) -> bool:
    """Whether a source is an image file: by its name, or a file that is no archive, as textures are. Whether it can be read is
    another question."""
    path = Path(source)
    return path.suffix.lower() in SUFFIXES or (path.is_file() and path.suffix != ".npz" and not is_zipfile(path))


def open_in_space(space: Space, source: str, cut: Cut = WHERE_IT_IS, on_note: Note = _silent) -> Texture:
    """A texture file of a space, which lies at one place of it, or the texture of a photograph.

    Raises UsageError, BundleError or ExemplarError.
    """
    if is_photograph(source):
        return encode_photograph(space, Path(source), cut, on_note)
    if cut != WHERE_IT_IS:
        raise UsageError(f"--patch-scale and --crop: are about photographs, {source} is a texture file; leave them out")
    if not Path(source).is_file():
        raise BundleError(f"{source}: no such file; expected a texture file ({TEXTURE_SUFFIX}) or a photograph")
    return space.open(space.owned(read_texture(Path(source))))


def encode_photograph(space: Space, path: Path, cut: Cut = WHERE_IT_IS, on_note: Note = _silent) -> Texture:
    """The texture of a photograph, called after its file. `on_note` is told in a line what of it was encoded.

    Raises ExemplarError if it cannot be read, or is too small for the cut.
    """
    photograph = read_photograph(path, 1)
    if photograph.warning:
        on_note(f"warning: {path}: {photograph.warning}")
    patch, note = cut_patch(photograph.pixels, space.patch, cut, str(path))
    on_note(note)
    return space.encode(patch, path.stem, cut.scale or 1.0)


def check_new(file: Path, overwrite: bool) -> None:
    """Raises UsageError for a name that is no texture file's, BakeError for a file that is to stay, or cannot be written."""
    from solidgrain.bake.checks import check_folder

    if not file.name.endswith(TEXTURE_SUFFIX):
        raise UsageError(f"--out {file}: expected a name that ends in {TEXTURE_SUFFIX}")
    if not file.parent.is_dir():
        raise UsageError(f"--out {file}: no folder {file.parent}; make it first")
    if file.exists() and not overwrite:
        raise BakeError(f"{file}: already exists; choose another --out, or --overwrite")
    check_folder(file)


class Encoded:
    """The textures of photographs that are to be baked, by the texture files that they become and their precision.

    A bake of a photograph saves the texture beside its first output, and its plan names that file: whoever verifies, resumes
    or shares the work needs neither the photograph nor an encoder that agrees to the last bit.
    """

    def __init__(self, on_note: Note = _silent) -> None:
        self.on_note = on_note
        self.textures: dict[tuple[Path, str], Texture] = {}
        self.made: list[Path] = []  # files that were not there before
        self._spaces: dict[tuple[str, str], Space] = {}  # by name and precision

    def settle(self, arguments: argparse.Namespace) -> None:
        """Encode the photograph that a bake's arguments name, and let them name its texture file instead.

        Raises UsageError if they cut what is no photograph, BakeError if the file is another texture's, and what encoding
        raises.
        """
        cut = Cut(arguments.patch_scale, arguments.crop)
        if not arguments.source or not is_photograph(arguments.source):
            if cut != WHERE_IT_IS:
                raise UsageError("--patch-scale and --crop: are about photographs, and SOURCE is none; leave them out")
            return
        texture = encode_photograph(self._space(arguments), Path(arguments.source), cut, self.on_note)
        folder = next((path.parent for path in (*arguments.out, arguments.preview) if path), Path())
        file = (folder / f"{texture.name}{TEXTURE_SUFFIX}").absolute()
        others = (other for (path, _), other in self.textures.items() if path == file)
        if any(other.data.sha256 != texture.data.sha256 for other in others):
            raise BakeError(f"{file}: two textures would be saved there; bake them into folders of their own")
        if file.exists() and not _holds(file, texture):
            raise BakeError(
                f"{file}: exists, and is another texture than {arguments.source} encodes to; move it away, choose another "
                "folder for --out, or bake the texture file itself"
            )
        self.textures.setdefault((file, _precision(arguments)), texture)
        arguments.source = str(file)

    def _space(self, arguments: argparse.Namespace) -> Space:
        """The space that encodes a photograph, loaded once."""
        key = (arguments.bundle or DEFAULT_SPACE, _precision(arguments))
        if key not in self._spaces:
            self._spaces[key] = load_space(key[0], provider=arguments.provider, precision=key[1], threads=arguments.threads)
        return self._spaces[key]

    def load(self, arguments: argparse.Namespace) -> Texture | None:
        """The texture that a bake's arguments name, if it is one of these."""
        return self.textures.get((Path(arguments.source), _precision(arguments))) if arguments.source else None

    def tell_missing(self) -> None:
        """Say which texture files a plan needs that only a bake would write."""
        for file in sorted({file for file, _ in self.textures if not file.exists()}):
            self.on_note(
                f"{file}: is not there yet, and the plan needs it; bake without --dry-run writes it, or solidgrain encode with "
                "the same --patch-scale and --crop"
            )

    def save(self, plans: Iterable[Plan]) -> None:
        """Write the texture files that plans with outputs need and that are not there, and let go of all textures.

        Raises BundleError if it cannot be done.
        """
        needed = {plan.source for plan in plans if plan.outputs}
        for (file, _), texture in self.textures.items():
            if str(file) in needed and not file.exists():
                self.made.append(file)
                texture.save(file)
        self.textures.clear()
        self._spaces.clear()

    def remove_unused(self, plans: Iterable[Plan]) -> None:
        """Remove the files that this run made for plans of which nothing is left: no output, and no part of one to resume."""
        from solidgrain.bake.checks import leaves_nothing

        used = {plan.source for plan in plans if not leaves_nothing(plan)}
        for file in self.made:
            if str(file) not in used and not _named_beside(file):
                file.unlink(missing_ok=True)


def _named_beside(file: Path) -> bool:
    """Whether a bake in a texture file's folder, done or begun, is of it: another process may have found it there."""
    bakes = (*file.parent.glob("*.bake.json"), *file.parent.glob(".*.baking/plan.json"))
    return any(json.dumps(f"./{file.name}") in path.read_text("utf-8", "replace") for path in bakes)


def _precision(arguments: argparse.Namespace) -> str:
    return arguments.precision or "float32"


def _holds(file: Path, texture: Texture) -> bool:
    """Whether a file is this texture's. One that is damaged or of another kind is not."""
    try:
        return read_texture(file).sha256 == texture.data.sha256
    except BundleError:
        return False


def cut_patch(pixels: FloatArray, size: int, cut: Cut, name: str) -> tuple[FloatArray, str]:
    """The patch [size, size, 3] of a photograph [H, W, 3] that is encoded, and a line that says which it is.

    The cut's square is scaled down by averaging in linear light. Raises ExemplarError where the photograph is too small.
    """
    scale = cut.scale or 1.0
    side, (height, width) = round(size * scale), pixels.shape[:2]
    if side > min(height, width):
        raise ExemplarError(
            f"{name}: {width}x{height} pixels, expected at least {side}x{side} ({size} at --patch-scale {scale:g}); "
            f"use a larger photograph or --patch-scale {math.floor(100 * min(height, width) / size) / 100:g}"
        )
    left, top = cut.corner if cut.corner else ((width - side) // 2, (height - side) // 2)
    if left + side > width or top + side > height:
        raise ExemplarError(
            f"{name}: --crop {left},{top}: {side}x{side} pixels from there leave its {width}x{height}; "
            f"expected at most {width - side},{height - side}"
        )
    share = side * side / (width * height)
    where = "at its middle" if cut.corner is None else f"from {left},{top}"
    advice = "; --patch-scale takes in more of it" if share < 0.25 and cut.scale is None else ""
    note = f"{name}: encodes {side}x{side} of {width}x{height} pixels {where}, {100 * share:.0f} % of the picture{advice}"
    return scaled(pixels[top : top + side, left : left + side], side / size), note
