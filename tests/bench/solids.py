"""Solids that are known in full: colour as a function of the point, for judging what was learned from one slice of them.

Each is built from hashed lattices, so it has no end, repeats nowhere that a test could look and needs no memory: layered wood
(rings about a far pith, fibres, pores), granite (crystals in a warped Voronoi partition, each of one mineral) and marble (veins
along the zero sets of warped noise). A solid takes points [P, 3] (x, y, z) in exemplar pixels and a seed, which picks the
instance, and returns rgb [P, 3] float32 in [0, 1], sRGB-encoded.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

DoubleArray = npt.NDArray[np.float64]
FloatArray = npt.NDArray[np.float32]
LongArray = npt.NDArray[np.int64]
WordArray = npt.NDArray[np.uint64]
Solid = Callable[[DoubleArray, int], FloatArray]
Color = tuple[float, float, float]

CHUNK = 1 << 15  # points at a time
CORNERS = np.array(list(itertools.product((0, 1), repeat=3)), np.int64)
NEIGHBOURS = np.array(list(itertools.product((-1, 0, 1), repeat=3)), np.int64)
MULTIPLIERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)  # odd, one per axis
PITH = 2600.0  # pixels from the exemplar's first row


def wood(points: DoubleArray, seed: int) -> FloatArray:
    """Rings about a pith along x, far below in y: xy is a quarter-sawn board, and the grain runs along x."""
    y, z = points[:, 1], points[:, 2]
    wander = 11 * fractal(points * (0.0025, 0.008, 0.008), seed) + 0.9 * fractal(points * (0.012, 0.12, 0.12), seed + 1)
    radius = np.hypot(y + PITH, z) + wander
    uneven = radius / 15 + 0.5 * noise(np.stack([radius / 60, 0 * y, 0 * y], 1) + 0.37, seed + 2)
    year = np.floor(uneven)
    within = uneven - year
    strength = 0.35 + 0.65 * unit(hashed(np.stack([year, 0 * y, 0 * y], 1).astype(np.int64), seed + 3))
    late = strength * smooth(0.1, 0.86, within) ** 1.6 * (1 - smooth(0.86, 1.0, within))  # darkens slowly, ends soon
    fibre = fractal(points * (0.018, 0.42, 0.42), seed + 4, 3)
    streak = fractal(points * (0.005, 0.07, 0.07), seed + 5)
    palette = ((0.90, 0.77, 0.59), (0.80, 0.62, 0.43), (0.67, 0.47, 0.29), (0.51, 0.33, 0.19), (0.36, 0.21, 0.12))
    rgb = ramp(0.20 + 0.55 * late + 0.17 * fibre + 0.15 * streak, palette)
    pores = smooth(0.42, 0.80, noise(points * (0.045, 0.5, 0.5), seed + 8)) * (1 - smooth(0.15, 0.75, within))
    return (rgb * (1 - 0.40 * pores[:, None])).clip(0, 1).astype(np.float32)


def granite(points: DoubleArray, seed: int) -> FloatArray:
    """Crystals of pink and white feldspar and grey quartz, from 8 to 40 pixels across, and flakes of biotite in clusters."""
    bent = points + 3.5 * vectors(points * 0.07, seed) + 1.6 * vectors(points * 0.2, seed + 20)
    crystal, gap = voronoi(bent / 21, seed + 3, spread=0.45)
    flake, flake_gap = voronoi(bent / 7.5, seed + 4, spread=0.3)
    kind, tone = unit(crystal), unit(hashed(crystal[:, None], 1))[:, None]
    fine, mottled = fractal(points * 0.4, seed + 5)[:, None], fractal(points * 0.07, seed + 6)[:, None]
    lamellae = np.sin(along(points, hashed(crystal[:, None], 2)) * 1.9)[:, None]  # twins, a direction per crystal
    pink = np.array((0.76, 0.61, 0.54)) * (0.88 + 0.18 * tone) + 0.018 * lamellae + 0.045 * fine + 0.06 * mottled
    white = np.array((0.83, 0.80, 0.76)) * (0.84 + 0.18 * tone) + 0.016 * lamellae + 0.050 * fine + 0.05 * mottled
    quartz = np.array((0.56, 0.545, 0.535)) * (0.72 + 0.36 * tone) + 0.035 * fine + 0.11 * mottled  # glassy: no cleavage
    rgb = np.select([(kind < 0.34)[:, None], (kind < 0.64)[:, None]], [pink, white], quartz)
    seam = unit(hashed(crystal[:, None], 4)) * np.exp(-((gap / 0.05) ** 2))  # some borders are open cracks
    rgb = rgb * (1 - 0.20 * seam)[:, None]
    share = 0.12 + 0.22 * fractal(points * 0.018, seed + 7)
    tint = unit(hashed(flake[:, None], 3))[:, None]
    biotite = np.array((0.13, 0.125, 0.125)) * (0.5 + 1.3 * tint) + 0.05 * fine
    dark = ((unit(flake) < share) * smooth(0.0, 0.12, flake_gap))[:, None]
    return (rgb + dark * (biotite - rgb)).clip(0, 1).astype(np.float32)


def marble(points: DoubleArray, seed: int) -> FloatArray:
    """White calcite clouded with grey, crossed by veins of three generations that come and go; no direction is preferred."""
    bent = points + 24 * vectors(points * 0.012, seed) + 7 * vectors(points * 0.04, seed + 3)
    cloud = fractal(bent * 0.014, seed + 6, 3)
    wide = vein(fractal(bent * 0.0125, seed + 7, 3), 0.05 + 0.07 * noise(points * 0.02, seed + 8))
    wide *= 0.25 + 0.75 * smooth(-0.35, 0.35, noise(points * 0.014, seed + 15))
    thin = vein(fractal(bent * 0.024, seed + 9), 0.025) * smooth(-0.1, 0.5, noise(points * 0.015, seed + 10))
    hair = vein(noise(bent * 0.055, seed + 11), 0.02) * smooth(0.0, 0.6, noise(points * 0.02, seed + 12))
    grain = fractal(points * 0.4, seed + 13)
    shade = 0.31 - 0.30 * cloud + 0.46 * wide + 0.45 * thin + 0.32 * hair + 0.05 * grain
    rgb = ramp(shade, ((0.955, 0.95, 0.94), (0.87, 0.87, 0.87), (0.69, 0.70, 0.72), (0.47, 0.49, 0.52), (0.33, 0.34, 0.37)))
    rust = ((thin + 0.5 * wide) * smooth(0.1, 0.6, noise(points * 0.014, seed + 14)))[:, None]  # iron in some of the veins
    return np.asarray((rgb + rust * np.array((0.12, 0.02, -0.12))).clip(0, 1), np.float32)


SOLIDS: dict[str, Solid] = {"granite": granite, "marble": marble, "wood": wood}


def colors(solid: Solid, points: DoubleArray, seed: int) -> FloatArray:
    """A solid at any number of points, in bounded memory. Instances share no noise: each has 2^14 seeds of its own."""
    chunks = (points[start : start + CHUNK] for start in range(0, len(points), CHUNK))
    return np.concatenate([solid(chunk, seed << 14) for chunk in chunks])


def hashed(lattice: LongArray | WordArray, seed: int) -> WordArray:
    """Whole coordinates [..., k <= 3] -> one random word each (the finaliser of SplitMix64; Steele et al. 2014)."""
    words = (lattice.astype(np.uint64) * MULTIPLIERS[: lattice.shape[-1]]).sum(-1, dtype=np.uint64)
    words = words + np.uint64((seed + 1) * 0xD1342543DE82EF95 % 2**64)
    words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(words ^ (words >> np.uint64(31)), np.uint64)


def unit(words: WordArray) -> DoubleArray:
    """Words -> [0, 1)."""
    return np.asarray((words >> np.uint64(11)) * 2.0**-53, np.float64)


def noise(points: DoubleArray, seed: int) -> DoubleArray:
    """Gradient noise (Perlin 2002) of one feature per unit: mean 0, deviation near 0.5, within about ±1.5."""
    cell = np.floor(points).astype(np.int64)
    inside = points - cell
    fade = inside**3 * (inside * (inside * 6 - 15) + 10)
    total = np.zeros(len(points))
    for corner in CORNERS:
        words = hashed(cell + corner, seed)
        gradient = np.stack([(words >> np.uint64(shift)) & np.uint64(0xFFFF) for shift in (0, 16, 32)], 1) / 32767.5 - 1
        weight = np.where(corner, fade, 1 - fade).prod(1)
        total += weight * (gradient * (inside - corner)).sum(1)
    return 2.0 * total


def fractal(points: DoubleArray, seed: int, octaves: int = 2) -> DoubleArray:
    """Noise and its halves at twice the frequency."""
    return np.asarray(
        np.sum([noise(points * 2.0**k + 17.3 * k, seed + 1000 * k) / 2**k for k in range(octaves)], 0), np.float64
    )


def vectors(points: DoubleArray, seed: int) -> DoubleArray:
    """Three independent noises, for warping."""
    return np.stack([noise(points, seed + k) for k in range(3)], 1)


def voronoi(points: DoubleArray, seed: int, spread: float) -> tuple[WordArray, DoubleArray]:
    """The word of the nearest of one random site per lattice cell (Worley 1996), and how much farther the second nearest is.

    Sites draw up to `spread` nearer, each by its own share, so that some cells outgrow others.
    """
    cell = np.floor(points).astype(np.int64)
    nearest, second = np.full(len(points), np.inf), np.full(len(points), np.inf)
    owner = np.zeros(len(points), np.uint64)
    for neighbour in NEIGHBOURS:
        words = hashed(cell + neighbour, seed)
        jitter = np.stack([(words >> np.uint64(shift)) & np.uint64(0x1FFFFF) for shift in (0, 21, 42)], 1) / 2**21
        reach = spread * unit(hashed(words[:, None], seed + 1))
        distance = np.sqrt(((cell + neighbour + jitter - points) ** 2).sum(1)) - reach
        closer = distance < nearest
        second = np.where(closer, nearest, np.minimum(second, distance))
        owner, nearest = np.where(closer, hashed(words[:, None], seed), owner), np.minimum(nearest, distance)
    return owner, second - nearest


def along(points: DoubleArray, words: WordArray) -> DoubleArray:
    """How far each point lies along a direction that its word picks, in pixels."""
    axes = np.stack([(words >> np.uint64(shift)) & np.uint64(0x1FFFFF) for shift in (0, 21, 42)], 1) / 2**20 - 1
    axes /= np.linalg.norm(axes, axis=1, keepdims=True) + 1e-9
    return np.asarray((points * axes).sum(1))


def vein(field: DoubleArray, width: DoubleArray | float) -> DoubleArray:
    """1 on the zero set of a field, falling off over a width (in the field's units)."""
    return np.asarray(np.exp(-np.abs(field) / np.maximum(width, 0.008)))


def smooth(low: float, high: float, value: DoubleArray) -> DoubleArray:
    """0 below low, 1 above high, a cubic between."""
    t = ((value - low) / (high - low)).clip(0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def ramp(shade: DoubleArray, palette: Sequence[Color]) -> DoubleArray:
    """Colours [P, 3] of shades from 0 (the palette's first) to 1 (its last)."""
    stops = np.linspace(0, 1, len(palette))
    return np.stack([np.interp(shade, stops, channel) for channel in zip(*palette, strict=True)], 1)
