"""The README's picture: the exemplar, an axis-aligned and an oblique slice at the same scale, and a carved solid.

make pictures     needs the exemplar beside the checkout, or --exemplar PHOTO
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pyvista

from solidgrain.bake.opengl import off_screen_environment
from solidgrain.runtime import Texture, load
from solidgrain.train.exemplar import read_exemplar

HERE = Path(__file__).resolve().parent
EXEMPLAR = HERE.parents[1] / "shared" / "data" / "exemplars" / "stone128" / "Granite007A.png"
SIDE, SCALE, GAP = 128, 3, 16  # pixels of a slice, screen pixels per pixel, screen pixels between panels
PANEL = SIDE * SCALE
WHITE = np.float32(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--exemplar", type=Path, default=EXEMPLAR)
    exemplar = read_exemplar(parser.parse_args().exemplar, SIDE)[:SIDE, :SIDE]
    texture = load("granite")
    slices = [plane(texture, np.eye(3)), plane(texture, np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0])]
    flat = [np.kron(picture, np.ones((SCALE, SCALE, 1), np.float32)) for picture in (exemplar, *slices)]
    gap = np.full((PANEL, GAP, 3), WHITE)
    panels = [part for picture in [*flat, carved(texture)] for part in (picture, gap)][:-1]
    write(HERE / "granite.jpg", np.concatenate(panels, axis=1))


def plane(texture: Texture, rotation: np.ndarray) -> np.ndarray:
    """A slice of SIDE² pixels through the origin, turned."""
    y, x = np.mgrid[:SIDE, :SIDE] - SIDE / 2 + 0.5
    points = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3) @ rotation.T
    return texture.sample(points, seed=7).reshape(SIDE, SIDE, 3)


def carved(texture: Texture, radius: float = 90.0, cells: int = 360) -> np.ndarray:
    """A rounded cube with three round holes, cut out of the solid: colours are sampled on its surface, nothing is mapped."""
    ticks = np.linspace(-radius, radius, cells, dtype=np.float32)
    z, y, x = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    box = np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z)) - 0.74 * radius
    ball = np.sqrt(x * x + y * y + z * z) - 0.96 * radius
    holes = [0.40 * radius - np.hypot(a, b) for a, b in ((x, y), (y, z), (z, x))]
    distance = np.maximum.reduce([box, ball, *holes])
    grid = pyvista.ImageData(dimensions=distance.shape[::-1], spacing=(2 * radius / (cells - 1),) * 3, origin=(-radius,) * 3)
    grid.point_data["distance"] = distance.ravel()
    surface = grid.contour([0.0], scalars="distance")
    surface.point_data["rgb"] = (texture.sample(surface.points, seed=7) * 255 + 0.5).astype(np.uint8)
    off_screen_environment()
    plotter = pyvista.Plotter(off_screen=True, window_size=[2 * PANEL, 2 * PANEL])
    plotter.set_background("white")
    plotter.add_mesh(surface, scalars="rgb", rgb=True, smooth_shading=True, split_sharp_edges=True, ambient=0.45, diffuse=0.7)
    plotter.camera_position = [(3.1 * radius, -3.6 * radius, 2.4 * radius), (0, 0, -0.02 * radius), (0, 0, 1)]
    plotter.camera.view_angle = 24
    pixels = plotter.screenshot(return_img=True).astype(np.float32) / 255
    return pixels.reshape(PANEL, 2, PANEL, 2, 3).mean((1, 3))


def write(path: Path, picture: np.ndarray) -> None:
    image = oiio.ImageBuf(np.ascontiguousarray(picture, np.float32))
    image.specmod().attribute("Compression", "jpeg:92")
    if not image.write(os.fspath(path), oiio.UINT8):
        raise SystemExit(image.geterror())
    print(path)


if __name__ == "__main__":
    main()
