"""What evaluates a texture: the fused kernel where it can, ONNX Runtime otherwise or when it is asked for by name."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.bundle import SAMPLER, Bundle
from solidgrain.runtime.errors import ProviderError
from solidgrain.runtime.fold import read_weights
from solidgrain.runtime.kernel import KernelEngine, KernelMissingError
from solidgrain.runtime.lattice import Tiling
from solidgrain.runtime.onnx_engine import OnnxEngine
from solidgrain.runtime.provider import check_inputs, open_session
from solidgrain.runtime.texture_file import TextureData
from solidgrain.runtime.workers import Task

PRECISIONS = ("float32", "bfloat16")

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]


class Instance(Protocol):
    """One instance of a texture (texture, seed, tiling), ready to be evaluated by any number of threads."""

    def point_tasks(self, points: DoubleArray, rgb: FloatArray) -> list[Task]:
        """Calls that fill `rgb` [P, 3] with the colours of points [P, 3], in any order."""

    def grid_tasks(self, x: DoubleArray, y: DoubleArray, z: DoubleArray, rgb: FloatArray) -> list[Task]:
        """The same for the product of coordinates along each axis, `rgb` [len(z), len(y), len(x), 3]."""


class Engine(Protocol):
    """A texture on what evaluates it. `name` says what that is: "kernel:avx512", "CUDAExecutionProvider"."""

    name: str
    precision: str

    def instance(self, tiling: Tiling, seed: int) -> Instance: ...

    def check(self, tiling: Tiling) -> None:
        """Raises EvaluationError if there is no instance with such a tiling."""


def open_engine(bundle: Bundle, texture: TextureData, provider: str, precision: str) -> tuple[Engine, str]:
    """The engine that was asked for, and, for "auto" without the kernel, why the kernel is not it (otherwise empty).

    Raises ProviderError if provider or precision cannot be had, BundleError if the graph cannot be loaded.
    """
    if precision not in PRECISIONS:
        raise ProviderError(f"precision {precision!r}: expected {' or '.join(PRECISIONS)}")
    path, reason = bundle.folder / SAMPLER, ""
    if provider in ("auto", "kernel"):
        try:
            return _kernel_engine(path.read_bytes(), texture, precision), ""
        except KernelMissingError as error:
            if provider == "kernel" or precision != "float32":
                raise
            provider, reason = "cpu", str(error)
    if precision != "float32":
        raise ProviderError(f"precision {precision!r}: ONNX Runtime has float32 only; leave out the provider")
    session = open_session(path, provider)
    check_inputs(session, texture, path)
    return OnnxEngine(session, texture), reason


def _kernel_engine(model: bytes, texture: TextureData, precision: str) -> KernelEngine:
    try:
        weights = read_weights(model, texture)
    except ValueError as error:
        raise KernelMissingError(f"the fused kernel does not know this sampler ({error})") from error
    return KernelEngine(weights, texture, precision)
