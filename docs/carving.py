"""Objects cut out of a solid texture, drawn by marching rays: where a ray meets the object, the solid is asked for its colour.

Objects are signed distances in units of their own size: negative inside, zero on the surface, never larger than the distance to
it (Hart 1996). z is up; points are arrays [P, 3].
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from solidgrain.runtime import Texture

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]
Distance = Callable[[DoubleArray], DoubleArray]  # points [P, 3] -> [P]

EYE = np.array([3.1, -3.6, 2.4])  # in which direction the eye lies
LIGHT = np.array([0.25, -0.75, 0.9]) / np.linalg.norm([0.25, -0.75, 0.9])
VIEW = np.radians(24)  # of the picture's height
FILL = 0.47  # radius of an object over the picture's height
STEPS, NEAR = 256, 2e-3  # of a ray at most; how near to the surface it stops, in radii
SAMPLES = 3  # rays per pixel along each axis
WAVES = 4.2  # of the gyroid, in radians per radius
RINGS = ((0.25, 0.34, 0.07), (0.4, -0.55, 0.08), (0.47, -0.71, 0.12))  # of the pawn: radius, height, thickness
AMBIENT, DIFFUSE = 0.45, 0.85  # of linear light


def overlap(*distances: DoubleArray) -> DoubleArray:
    """What lies in all of several objects."""
    return np.asarray(np.maximum.reduce(distances))


def union(*distances: DoubleArray) -> DoubleArray:
    """What lies in any of several objects."""
    return np.asarray(np.minimum.reduce(distances))


def ball(p: DoubleArray) -> DoubleArray:
    return np.asarray(np.linalg.norm(p, axis=1) - 0.98)


def holed_cube(p: DoubleArray) -> DoubleArray:
    """A cube rounded by a ball, with a round hole along each axis."""
    x, y, z = p.T
    holes = [0.42 - np.hypot(a, b) for a, b in ((x, y), (y, z), (z, x))]
    return overlap(np.abs(p).max(1) - 0.76, ball(p), *holes)


def cut_ball(p: DoubleArray) -> DoubleArray:
    """A ball without the eighth that faces the eye: three cuts at right angles meet in its middle."""
    x, y, z = p.T
    return overlap(ball(p), -overlap(-x, y, -z))


def pawn(p: DoubleArray) -> DoubleArray:
    """A pawn, turned on a lathe: a head, a cone, a collar, and two rings to stand on."""
    radius, z = np.hypot(p[:, 0], p[:, 1]), p[:, 2]
    head = np.hypot(radius, z - 0.66) - 0.31
    cone = overlap((radius - 0.26 + 0.28 * z) / np.hypot(1, 0.28), z - 0.42, -0.65 - z)
    rings = [np.hypot(np.maximum(radius - r, 0), z - height) - thick for r, height, thick in RINGS]
    return union(head, cone, *rings)


def gyroid(p: DoubleArray) -> DoubleArray:
    """A ball through which a gyroid has cut its two mazes of channels."""
    waves = WAVES * p
    wall = np.abs((np.sin(waves) * np.cos(np.roll(waves, -1, axis=1))).sum(1)) - 0.55
    return overlap(ball(p), wall / (1.8 * WAVES))


SHAPES: tuple[Distance, ...] = (holed_cube, cut_ball, pawn, gyroid)


def draw(texture: Texture, shape: Distance, side: int, pixels: float, up: str = "z", seed: int = 7) -> FloatArray:
    """An object on white, [side, side, 3], with the texture's axis `up` upright.

    At the object's middle the picture's height is `pixels` exemplar pixels.
    """
    radius = FILL * pixels
    rays = side * SAMPLES
    eye, directions = _rays(rays)
    travelled, met = _march(shape, np.broadcast_to(eye, directions.shape), directions)
    points = eye + travelled[met, None] * directions[met]
    places = radius * np.roll(points, "zxy".index(up), axis=1)
    linear = texture.sample(places, seed).astype(np.float64) ** 2.2 * _light(shape, points)[:, None]
    picture = np.ones((rays * rays, 3))
    picture[met] = linear.clip(0, 1)
    mean = picture.reshape(side, SAMPLES, side, SAMPLES, 3).mean((1, 3))
    return np.asarray(mean ** (1 / 2.2), np.float32)


def _rays(count: int) -> tuple[DoubleArray, DoubleArray]:
    """The eye, and the directions [count², 3] in which it looks, row by row from the top."""
    toward = EYE / np.linalg.norm(EYE)
    right = np.cross([0, 0, 1], toward) / np.linalg.norm(np.cross([0, 0, 1], toward))
    up = np.cross(toward, right)
    ticks = ((np.arange(count) + 0.5) / count - 0.5) * 2 * np.tan(VIEW / 2)
    across, above = np.meshgrid(ticks, -ticks)
    directions = (across[..., None] * right + above[..., None] * up - toward).reshape(-1, 3)
    return toward / (2 * FILL * np.tan(VIEW / 2)), directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _march(shape: Distance, start: DoubleArray, directions: DoubleArray) -> tuple[DoubleArray, npt.NDArray[np.bool_]]:
    """How far each ray travels, [P], and whether it meets the object."""
    end = np.linalg.norm(start, axis=1) + 1.5
    travelled, distance = np.zeros(len(start)), np.full(len(start), np.inf)
    going = np.arange(len(start))
    for _ in range(STEPS):
        distance[going] = shape(start[going] + travelled[going, None] * directions[going])
        travelled[going] += distance[going]
        going = going[(distance[going] > NEAR) & (travelled[going] < end[going])]
    return travelled, distance <= 4 * NEAR  # a ray that grazes the surface runs out of steps shortly before it


def _light(shape: Distance, points: DoubleArray) -> DoubleArray:
    """Linear light at points [P, 3] of the surface: from all sides that are open, and from a lamp where it is seen."""
    steps = 2e-3 * np.eye(3)
    normals = np.stack([shape(points + step) - shape(points - step) for step in steps], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-9)
    reach = (0.05, 0.12, 0.25)
    open_sides = np.mean([np.clip(shape(points + r * normals) / r, 0, 1) for r in reach], axis=0)
    _, hidden = _march(shape, points + 8 * NEAR * normals, np.broadcast_to(LIGHT, points.shape))
    return np.asarray(AMBIENT * open_sides + DIFFUSE * (normals @ LIGHT).clip(0) * ~hidden)
