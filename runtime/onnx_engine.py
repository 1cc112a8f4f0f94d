"""The sampler's graph in ONNX Runtime, on the execution provider that was asked for, in chunks of constant shape."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from contextlib import nullcontext
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.errors import EvaluationError
from solidgrain.runtime.lattice import Tiling
from solidgrain.runtime.noise import noise_offsets, noise_tables
from solidgrain.runtime.provider import memory_device
from solidgrain.runtime.texture_file import TextureData
from solidgrain.runtime.workers import Task

if TYPE_CHECKING:
    import onnxruntime

CPU_CHUNK = 2048  # points: the chunk's activations, 1 MB a layer, stay in the second-level cache
DEVICE_CHUNK = 131072  # points: enough to fill an accelerator
DEVICE_TURN = threading.Lock()  # one chunk at a time is all that fits one, and DirectML's sessions are not for several threads

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]
Number = TypeVar("Number", np.float32, np.float64)


class OnnxEngine:
    """A texture in a session."""

    precision = "float32"

    def __init__(self, session: onnxruntime.InferenceSession, texture: TextureData) -> None:
        self.session, self.texture = session, texture
        self.name = str(session.get_providers()[0])

    def instance(self, tiling: Tiling, seed: int) -> OnnxInstance:
        return OnnxInstance(self, tiling, seed)

    def check(self, tiling: Tiling) -> None:
        """Any tiling will do."""


class OnnxInstance:
    """One instance of a texture in a session."""

    def __init__(self, engine: OnnxEngine, tiling: Tiling, seed: int) -> None:
        """Raises EvaluationError for a seed out of range."""
        octaves = len(tiling.transforms)
        inputs: dict[str, npt.NDArray[Any]] = {
            "transforms": tiling.transforms,
            "lattice": tiling.lattice,
            "gamma": engine.texture.gamma,
            "delta": engine.texture.delta,
            "noise_weights": engine.texture.noise_weights,
            "noise": noise_tables(seed, octaves),  # checks the seed
            "offsets": noise_offsets(seed, octaves),
        }
        self.graph = PlacedGraph(engine.session, inputs, engine.texture.name)
        self.chunk = CPU_CHUNK if engine.name.startswith("CPU") else DEVICE_CHUNK

    def point_tasks(self, points: DoubleArray, rgb: FloatArray) -> list[Task]:
        """Calls that fill `rgb` [P, 3] with the colours of points [P, 3], in any order, in any threads."""
        return [partial(self._points, points, rgb, start) for start in range(0, len(points), self.chunk)]

    def grid_tasks(self, x: DoubleArray, y: DoubleArray, z: DoubleArray, rgb: FloatArray) -> list[Task]:
        """The same for the product of coordinates along each axis, `rgb` [len(z), len(y), len(x), 3].

        The voxels are taken in memory order, a chunk at a time; the last chunk is filled up with its last voxel.
        """
        flat = rgb.reshape(-1, 3)
        return [partial(self._voxels, x, y, z, flat, start) for start in range(0, len(flat), self.chunk)]

    def _points(self, points: DoubleArray, rgb: FloatArray, start: int) -> None:
        part = points[start : start + self.chunk]
        rgb[start : start + len(part)] = self.graph.colors(points=padded(part, self.chunk))[: len(part)]

    def _voxels(self, x: DoubleArray, y: DoubleArray, z: DoubleArray, rgb: FloatArray, start: int) -> None:
        stop = min(start + self.chunk, len(rgb))
        rows, column = np.divmod(np.minimum(np.arange(start, start + self.chunk), len(rgb) - 1), len(x))
        plane, row = np.divmod(rows, len(y))
        points = np.stack([x[column], y[row], z[plane]], axis=1)
        rgb[start:stop] = self.graph.colors(points=points)[: stop - start]


class PlacedGraph:
    """A graph, and its inputs placed on the session's device once: all but those that change from chunk to chunk."""

    def __init__(self, session: onnxruntime.InferenceSession, inputs: Mapping[str, npt.NDArray[Any]], texture: str) -> None:
        import onnxruntime

        self.session, self.name = session, texture
        self.turn = nullcontext() if session.get_providers()[0].startswith("CPU") else DEVICE_TURN
        place, device = onnxruntime.OrtValue.ortvalue_from_numpy, memory_device(session.get_providers()[0])
        self.inputs = {name: place(np.ascontiguousarray(value), device) for name, value in inputs.items()}

    def colors(self, points: DoubleArray, **others: FloatArray) -> FloatArray:
        """Colour at one chunk of points, [chunk, 3] float64 -> [chunk, 3], clipped to [0, 1]; `others` are inputs too.

        Raises EvaluationError if the sampler returns NaN.
        """
        binding = self.session.io_binding()
        for name, value in self.inputs.items():
            binding.bind_ortvalue_input(name, value)
        for name, array in {"points": points, **others}.items():
            binding.bind_cpu_input(name, array)
        binding.bind_output("rgb")
        try:
            with self.turn:
                self.session.run_with_iobinding(binding)
            rgb: FloatArray = binding.copy_outputs_to_cpu()[0]
        except Exception as error:  # ONNX Runtime raises types of its own, without a common base
            raise EvaluationError(f"{self.name}: ONNX Runtime failed ({str(error).strip().splitlines()[0]})") from error
        if not np.isfinite(rgb).all():
            raise EvaluationError.of_nan(self.name, points[np.flatnonzero(~np.isfinite(rgb).all(axis=1))[0]])
        return np.clip(rgb, 0.0, 1.0)


def padded(rows: npt.NDArray[Number], count: int) -> npt.NDArray[Number]:
    """So many rows: those, then the last of them again and again."""
    return np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)])
