"""What evaluates a blend in space: each texture's own engine where it is alone, and `blend.onnx` in between.

Which of them a point is left to depends on its weight, and that on the point alone: a weight of exactly 0 or 1 is the texture's
own engine, to the bit, whatever the chunk, the slab or the other points are. The fused kernel does not know transitions: they
run in ONNX Runtime.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.blend_file import BlendData
from solidgrain.runtime.bundle import BLEND, Bundle
from solidgrain.runtime.engine import Engine, Instance, open_engine
from solidgrain.runtime.errors import BundleError, EvaluationError, ProviderError
from solidgrain.runtime.lattice import Tiling
from solidgrain.runtime.mask import Repeats
from solidgrain.runtime.noise import RESOLUTION, noise_offsets, noise_tables
from solidgrain.runtime.onnx_engine import DEVICE_CHUNK, PlacedGraph, padded
from solidgrain.runtime.provider import open_session
from solidgrain.runtime.workers import Task

if TYPE_CHECKING:
    import onnxruntime

CPU_CHUNK = 256  # points of a transition: as fast as more at a time, and what a brick has few of is not filled up to many
CPU_BRICK, DEVICE_BRICK = (16, 32, 32), (32, 64, 64)  # voxels (z, y, x) of a task
EXACT = 1e-9  # relative: by how much a period may miss the mask's

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]


def open_blend_engine(bundle: Bundle, blend: BlendData, provider: str, precision: str) -> tuple[Engine, str]:
    """As `solidgrain.runtime.engine.open_engine`: both textures on the engine that was asked for, transitions on ONNX Runtime.

    Raises ProviderError for the kernel by name and for bfloat16, which transitions do not run in, and BundleError for a
    bundle without `blend.onnx`.
    """
    path = bundle.folder / BLEND
    if BLEND not in bundle.manifest["files"]:
        raise BundleError(f"{bundle.folder}: has no {BLEND}, which blends in space need; export the space again")
    if provider == "kernel":
        raise ProviderError("provider 'kernel': the fused kernel does not know transitions between textures; leave it out")
    if precision != "float32":
        raise ProviderError(f"precision {precision!r}: transitions between textures are float32; leave it out")
    (first, note), (second, _) = (open_engine(bundle, texture, provider, precision) for texture in blend.ends)
    session = open_session(path, "cpu" if provider == "auto" else provider)
    expected = {name: list(array.shape) for name, array in blend.arrays().items()}
    octaves = len(blend.transforms) // 2
    expected |= {"offsets": [octaves, 3], "lattice": [2 * octaves, 3, 3], "noise": [octaves, *[RESOLUTION] * 3]}
    expected |= {name: ["knots", *expected[name][1:]] for name in ("gamma", "delta")}
    found = {node.name: list(node.shape) for node in session.get_inputs()}
    wrong = [name for name, shape in expected.items() if found.get(name) != shape]
    if wrong or not {"points", "weight"} <= found.keys() or [node.name for node in session.get_outputs()] != ["rgb"]:
        named = wrong[0] if wrong else "points, weight or rgb"
        raise BundleError(f"{path}: not for these textures ({named} is {found.get(named)}); export the space again")
    return BlendEngine(session, blend, (first, second)), note


class BlendEngine:
    """A blend in space on the engines of both textures, and a session for what lies between them."""

    precision = "float32"

    def __init__(self, session: onnxruntime.InferenceSession, blend: BlendData, ends: tuple[Engine, Engine]) -> None:
        self.session, self.blend, self.ends = session, blend, ends
        self.on_cpu = str(session.get_providers()[0]).startswith("CPU")
        self.name = "+".join(dict.fromkeys([ends[0].name, str(session.get_providers()[0])]))

    def instance(self, tiling: Tiling, seed: int) -> BlendInstance:
        return BlendInstance(self, tiling, seed)

    def check(self, tiling: Tiling) -> None:
        """Raises EvaluationError if the mask does not repeat as such a tiling does."""
        self.repeats(tiling)

    def repeats(self, tiling: Tiling) -> Repeats:
        """Along which of its axes the mask is read again and again. Raises EvaluationError if that would leave a seam.

        A period of the grid is a step of the mask: along each of its axes it must be none, or whole turns of the volume, or
        the mask must not change there at all.
        """
        mask, repeats = self.blend.mask, [False, False, False]
        for tiled, axis in itertools.product(range(3), range(3)):
            step = tiling.matrix[axis, tiled] * tiling.period[tiled]
            if abs(step) <= EXACT * tiling.period[tiled] or mask.constant[axis]:
                continue
            turns = step / mask.extent[axis]
            if round(turns) == 0 or abs(turns - round(turns)) > EXACT * abs(turns):
                name = "xyz"[axis]
                raise EvaluationError(
                    f"{self.blend.name}: a tile along {'xyz'[tiled]} repeats after {abs(step):g} pixels of {name}, "
                    f"its mask after {mask.extent[axis]:g}; use that period, or leave {'xyz'[tiled]} out"
                )
            repeats[axis] = True
        return (repeats[0], repeats[1], repeats[2])


class BlendInstance:
    """One instance of a blend in space, ready to be evaluated by any number of threads."""

    def __init__(self, engine: BlendEngine, tiling: Tiling, seed: int) -> None:
        """Raises EvaluationError for a seed out of range, or a tiling that would leave a seam in the mask."""
        blend = engine.blend
        self.mask, self.repeats, self.matrix = blend.mask, engine.repeats(tiling), tiling.matrix
        octaves = len(tiling.transforms) // 2
        self.ends: tuple[Instance, ...] = tuple(
            end.instance(_rows(tiling, slice(octaves * k, octaves * (k + 1))), seed) for k, end in enumerate(engine.ends)
        )
        inputs = {
            **blend.arrays(),
            "transforms": tiling.transforms,
            "lattice": tiling.lattice,
            "noise": noise_tables(seed, octaves),
            "offsets": noise_offsets(seed, octaves),
        }
        self.transition = PlacedGraph(engine.session, inputs, blend.name)
        self.chunk = CPU_CHUNK if engine.on_cpu else DEVICE_CHUNK
        self.brick = CPU_BRICK if engine.on_cpu else DEVICE_BRICK

    def point_tasks(self, points: DoubleArray, rgb: FloatArray) -> list[Task]:
        """Calls that fill `rgb` [P, 3] with the colours of points [P, 3], in any order, in any threads."""
        size = int(np.prod(self.brick))
        return [partial(self._points, points[k : k + size], rgb[k : k + size]) for k in range(0, len(points), size)]

    def grid_tasks(self, x: DoubleArray, y: DoubleArray, z: DoubleArray, rgb: FloatArray) -> list[Task]:
        """The same for the product of coordinates along each axis, `rgb` [len(z), len(y), len(x), 3], brick by brick."""
        runs = [
            [slice(k, k + side) for k in range(0, len(axis), side)] for axis, side in zip((z, y, x), self.brick, strict=True)
        ]
        return [partial(self._brick, x[i], y[j], z[k], rgb[k, j, i]) for k, j, i in itertools.product(*runs)]

    def _brick(self, x: DoubleArray, y: DoubleArray, z: DoubleArray, rgb: FloatArray) -> None:
        """A block of a grid: by the texture that it is all of, or point by point."""
        corners = np.array(list(itertools.product(*((axis.min(), axis.max()) for axis in (x, y, z)))))
        places = self._placed(corners)  # the extremes of an affine map; its rounding is monotonic along each axis
        colors = np.empty(rgb.shape, np.float32)
        alone = self.mask.constant_within(places.min(0), places.max(0), self.repeats)
        if alone is None:
            planes, rows, columns = np.meshgrid(z, y, x, indexing="ij")
            self._points(np.stack([columns, rows, planes], axis=-1).reshape(-1, 3), colors.reshape(-1, 3))
        else:
            _run(self.ends[alone].grid_tasks(x, y, z, colors))
        rgb[:] = colors

    def _points(self, points: DoubleArray, rgb: FloatArray) -> None:
        """Each point by the texture that it is all of, or by the transition."""
        weights = self.mask.weights(self._placed(points), self.repeats)
        for weight, end in zip((0, 1), self.ends, strict=True):
            inside = np.flatnonzero(weights == weight)
            colors = np.empty((len(inside), 3), np.float32)
            _run(end.point_tasks(points[inside], colors))
            rgb[inside] = colors
        between = np.flatnonzero((weights > 0) & (weights < 1))
        for start in range(0, len(between), self.chunk):
            part = between[start : start + self.chunk]
            values = padded(points[part], self.chunk), padded(weights[part], self.chunk)
            rgb[part] = self.transition.colors(points=values[0], weight=values[1])[: len(part)]

    def _placed(self, points: DoubleArray) -> DoubleArray:
        """Points [P, 3] of the grid in the textures' coordinates, where the mask is; elementwise: chunks do not matter."""
        x, y, z = points.T
        rows = [row[0] * x + row[1] * y + row[2] * z for row in self.matrix]
        return np.stack(rows, axis=1)


def _rows(tiling: Tiling, rows: slice) -> Tiling:
    """The tiling of some octaves."""
    return replace(tiling, transforms=tiling.transforms[rows], lattice=tiling.lattice[rows], distortion=tiling.distortion[rows])


def _run(tasks: Sequence[Task]) -> None:
    """One after the other, in this thread: whoever calls is a task itself."""
    for task in tasks:
        task()
