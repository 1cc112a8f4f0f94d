"""`make pictures`: granite.jpg and gallery.jpg, in which every embedded texture is a row.

python -m docs.pictures [--exemplars FOLDER] [--out FOLDER]

A row is the photograph, an axis-aligned and an oblique slice, and an object cut out of the solid, all at the same scale.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from docs.carving import SHAPES, Distance, draw
from docs.embedded import EXEMPLARS, HERE, embedded_textures, exemplar_of, find_photograph, say
from solidgrain.export.evaluation import planes_of
from solidgrain.export.sheet import GAP, Page, Pixels
from solidgrain.runtime import SolidgrainError, Texture, load_texture
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.slices import Planes

SIDE = 128  # exemplar pixels along each side of a panel
LARGE, SMALL = 3, 2  # screen pixels per exemplar pixel, of granite.jpg and of the gallery
MOST = 1_000_000  # bytes of the gallery
QUALITIES = range(92, 40, -4)
SEED = 7


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--exemplars", type=Path, default=EXEMPLARS, metavar="FOLDER", help="where the photographs are")
    parser.add_argument("--out", type=Path, default=HERE, metavar="FOLDER", help=f"where the pictures go ({HERE})")
    arguments = parser.parse_args(argv)
    gallery = Page(4 * SIDE * SMALL + 5 * GAP)
    for number, (name, bundle) in enumerate(embedded_textures().items()):
        photograph = find_photograph(bundle, arguments.exemplars)
        texture, shape = load_texture(bundle.folder), SHAPES[number % len(SHAPES)]
        gallery.show(list(zip(labels(name, texture), panels(texture, photograph, shape, SMALL), strict=True)))
        if name == "granite":
            write(arguments.out / "granite.jpg", side_by_side(panels(texture, photograph, SHAPES[0], LARGE)))
    write(arguments.out / "gallery.jpg", gallery.pixels())


def labels(name: str, texture: Texture) -> tuple[str, str, str, str]:
    """What is written under a row's panels."""
    photograph = Path(exemplar_of(texture.bundle)["exemplar"]).stem
    grain = planes_of(texture.bundle).grain
    oblique = "oblique slice" if grain == "none" else f"slice turned about {grain}, the grain"
    return f"{name}: {photograph}", "axis-aligned slice", oblique, "cut out of the solid"


def panels(texture: Texture, photograph: FloatArray | None, shape: Distance, scale: int) -> list[Pixels]:
    """A row's four pictures, `scale` screen pixels per exemplar pixel; white where there is no photograph."""
    crop = np.ones((SIDE, SIDE, 3), np.float32) if photograph is None else middle(photograph)
    grain = planes_of(texture.bundle).grain
    slices = [plane(texture, rotation) for rotation in (np.eye(3), oblique_rotation(grain))]
    enlarged = [picture.repeat(scale, 0).repeat(scale, 1) for picture in (crop, *slices)]
    carved = draw(texture, shape, SIDE * scale, SIDE, up="z" if grain == "none" else grain, seed=SEED)
    return [quantized(picture) for picture in (*enlarged, carved)]


def middle(photograph: FloatArray) -> FloatArray:
    """SIDE² pixels from its middle, with white beside what is smaller."""
    top, left = (max(extent - SIDE, 0) // 2 for extent in photograph.shape[:2])
    crop = photograph[top : top + SIDE, left : left + SIDE]
    panel = np.ones((SIDE, SIDE, 3), np.float32)
    panel[: len(crop), : crop.shape[1]] = crop
    return panel


def oblique_rotation(grain: str) -> np.ndarray:
    """A fixed plane that is none of the axes'.

    Of an oriented texture it turns about the grain only: no loss ever saw a plane across it, in which the solid is what it
    happens to be.
    """
    if grain == "none":
        return np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
    return Planes(grain).example().numpy()


def plane(texture: Texture, rotation: np.ndarray) -> FloatArray:
    """A slice of SIDE² pixels through the origin, turned."""
    y, x = np.mgrid[:SIDE, :SIDE] - SIDE / 2 + 0.5
    points = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3) @ rotation.T
    return texture.sample(points, SEED).reshape(SIDE, SIDE, 3)


def quantized(picture: FloatArray) -> Pixels:
    return np.round(picture.clip(0, 1) * 255).astype(np.uint8)


def side_by_side(pictures: Sequence[Pixels]) -> Pixels:
    gap = np.full((len(pictures[0]), GAP, 3), 255, np.uint8)
    return np.concatenate([part for picture in pictures for part in (picture, gap)][:-1], axis=1)


def write(path: Path, picture: Pixels) -> None:
    """A JPEG, of the highest quality that keeps it below `MOST`."""
    for quality in QUALITIES:
        image = oiio.ImageBuf(np.ascontiguousarray(picture))
        image.specmod().attribute("Compression", f"jpeg:{quality}")
        if not image.write(os.fspath(path)):
            raise SolidgrainError(f"{path}: cannot write ({image.geterror().strip()})")
        if path.stat().st_size < MOST:
            break
    say(f"{path}: {path.stat().st_size / 1024:.0f} KB, quality {quality}")


if __name__ == "__main__":
    try:
        main()
    except SolidgrainError as error:
        sys.exit(f"error: {error}")
