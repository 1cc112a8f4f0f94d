"""Running `sampler.onnx`: one instance of a texture, bound once, evaluated in chunks of constant shape."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.errors import EvaluationError
from solidgrain.runtime.lattice import Tiling
from solidgrain.runtime.noise import noise_offsets, noise_tables
from solidgrain.runtime.texture_file import TextureData

if TYPE_CHECKING:
    import onnxruntime

CPU_CHUNK = 2048  # points: the chunk's activations, 1 MB a layer, stay in the second-level cache
DEVICE_CHUNK = 131072  # points: enough to fill an accelerator

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]


class Instance:
    """One instance of a texture: its inputs to the graph, all but the points, placed on the session's device once."""

    def __init__(self, session: onnxruntime.InferenceSession, texture: TextureData, tiling: Tiling, seed: int) -> None:
        import onnxruntime

        self.session, self.name = session, texture.name
        provider = session.get_providers()[0]
        device = "cuda" if provider.startswith(("CUDA", "Tensorrt")) else "cpu"
        octaves = len(tiling.transforms)
        inputs = {
            "transforms": tiling.transforms,
            "lattice": tiling.lattice,
            "gamma": texture.gamma,
            "delta": texture.delta,
            "noise_weights": texture.noise_weights,
            "noise": noise_tables(seed, octaves),  # checks the seed
            "offsets": noise_offsets(seed, octaves),
        }
        place = onnxruntime.OrtValue.ortvalue_from_numpy
        self.inputs = {name: place(np.ascontiguousarray(value), device) for name, value in inputs.items()}
        self.chunk = CPU_CHUNK if provider.startswith("CPU") else DEVICE_CHUNK

    def evaluate(self, points: DoubleArray) -> FloatArray:
        """Colour at one chunk of points, [chunk, 3] float64 -> [chunk, 3], clipped to [0, 1].

        Raises EvaluationError if the sampler returns NaN.
        """
        import onnxruntime

        feed = {**self.inputs, "points": onnxruntime.OrtValue.ortvalue_from_numpy(points)}
        try:
            rgb: FloatArray = self.session.run_with_ort_values(["rgb"], feed)[0].numpy()
        except Exception as error:  # ONNX Runtime raises types of its own, without a common base
            raise EvaluationError(f"{self.name}: ONNX Runtime failed ({str(error).strip().splitlines()[0]})") from error
        if not np.isfinite(rgb).all():
            x, y, z = points[np.flatnonzero(~np.isfinite(rgb).all(axis=1))[0]]
            raise EvaluationError(f"{self.name}: the sampler returned NaN at ({x:g}, {y:g}, {z:g}); the texture is damaged")
        return np.clip(rgb, 0.0, 1.0)


def evaluate_points(instance: Instance, points: DoubleArray, threads: int) -> FloatArray:
    """Colour at any number of points [P, 3]."""
    rgb = np.empty((len(points), 3), np.float32)

    def fill(start: int) -> None:
        part = points[start : start + instance.chunk]
        padded = np.concatenate([part, np.repeat(part[-1:], instance.chunk - len(part), axis=0)])
        rgb[start : start + len(part)] = instance.evaluate(padded)[: len(part)]

    _run(fill, range(0, len(points), instance.chunk), threads)
    return rgb


def evaluate_lattice(instance: Instance, x: DoubleArray, y: DoubleArray, z: DoubleArray, threads: int) -> FloatArray:
    """Colour at the product of coordinates along each axis: [len(z), len(y), len(x), 3].

    The voxels are taken in memory order, a chunk at a time; the last chunk is filled up with its last voxel.
    """
    voxels = len(x) * len(y) * len(z)
    rgb = np.empty((voxels, 3), np.float32)

    def fill(start: int) -> None:
        index = np.minimum(np.arange(start, start + instance.chunk), voxels - 1)
        rows, column = np.divmod(index, len(x))
        plane, row = np.divmod(rows, len(y))
        points = np.stack([x[column], y[row], z[plane]], axis=1)
        stop = min(start + instance.chunk, voxels)
        rgb[start:stop] = instance.evaluate(points)[: stop - start]

    _run(fill, range(0, voxels, instance.chunk), threads)
    return rgb.reshape(len(z), len(y), len(x), 3)


def _run(fill: Callable[[int], None], starts: range, threads: int) -> None:
    """Fill every chunk, several at a time. The first error stops the rest."""
    if threads == 1 or len(starts) == 1:
        for start in starts:
            fill(start)
        return
    with ThreadPoolExecutor(threads) as pool:
        tasks = [pool.submit(fill, start) for start in starts]
        try:
            for task in tasks:
                task.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
