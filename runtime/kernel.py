"""The fused kernel: noise and perceptron of whole blocks of points in one native call (`native/kernel.h`).

It is optional. Where it was not built, cannot be loaded or does not know a bundle's graph, the runtime evaluates through ONNX
Runtime, and the reason is there to be asked for. Two environment variables, for tests and for diagnosis:

    SOLIDGRAIN_KERNEL          off, or the one path to use: amx, avx512bf16, avx512, avx2 or portable
    SOLIDGRAIN_KERNEL_LIBRARY  a library file to load instead of the installed one
"""

from __future__ import annotations

import base64
import csv
import ctypes
import hashlib
import os
import struct
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.errors import EvaluationError, ProviderError
from solidgrain.runtime.fold import fold
from solidgrain.runtime.lattice import Tiling
from solidgrain.runtime.noise import noise_offsets, noise_tables
from solidgrain.runtime.texture_file import TextureData
from solidgrain.runtime.workers import Task

ABI = 1  # SOLIDGRAIN_ABI of native/kernel.h
PATHS = ("amx", "avx512bf16", "avx512", "avx2", "portable")
BFLOAT16_PATHS = ("amx", "avx512bf16")
BRICK = 4096  # voxels
WORK_PER_TASK = 4 * BRICK * 128**2  # points times squared width: some milliseconds, a fifth of a second on the slowest path
STEEPEST = 2.0**13  # texels per pixel: times the farthest point below 2^53, so that cells are exact (within one: below 2^40)

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]


class KernelMissingError(ProviderError):
    """There is no fused kernel for what was asked; the message says why."""


class _Description(ctypes.Structure):
    """`SamplerDescription`."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in ("octaves", "width", "hidden_layers", "bfloat16", "tiled")),
        *((name, ctypes.c_void_p) for name in ("transforms", "offsets", "lattice", "noise", "weights")),
    )


def kernel_paths() -> tuple[str, ...]:
    """The paths that this build and this processor have, best first. Raises KernelMissingError if there is no kernel."""
    if os.environ.get("SOLIDGRAIN_KERNEL", "") == "off":
        raise KernelMissingError("the fused kernel is switched off (SOLIDGRAIN_KERNEL=off)")
    return tuple(_library(_library_file()).solidgrain_paths().decode().split(","))


def choose_path(precision: str) -> str:
    """The best path for a precision, or the one that SOLIDGRAIN_KERNEL names.

    Raises ProviderError if that is not to be had, KernelMissingError if there is no kernel, or none of this precision.
    """
    wanted = os.environ.get("SOLIDGRAIN_KERNEL", "")
    if wanted not in ("", "off", *PATHS):
        raise ProviderError(f"SOLIDGRAIN_KERNEL={wanted}: expected off or one of {', '.join(PATHS)}")
    offered = kernel_paths()
    if wanted and wanted not in offered:
        raise ProviderError(f"SOLIDGRAIN_KERNEL={wanted}: this processor has {', '.join(offered)}")
    path = wanted or offered[0]
    if precision == "bfloat16" and path not in BFLOAT16_PATHS:
        raise KernelMissingError(
            f"precision 'bfloat16': needs AMX or AVX-512 BF16, which this processor lacks or the system keeps from this "
            f"process (the fused kernel runs on {path}); use float32"
        )
    return path


class KernelEngine:
    """A texture's folded weights, on one path of the kernel."""

    def __init__(self, weights: Sequence[FloatArray], texture: TextureData, precision: str) -> None:
        """Raises KernelMissingError if there is no kernel for this precision or this width."""
        self.path, self.precision = choose_path(precision), precision
        if texture.gamma.shape[1] % 16:
            raise KernelMissingError(
                f"the sampler is {texture.gamma.shape[1]} units wide, the fused kernel takes multiples of 16"
            )
        if np.abs(texture.transforms).sum(2).max() > STEEPEST:
            raise KernelMissingError(f"an octave has more than {STEEPEST:g} texels per pixel")
        self.texture, self.folded = texture, fold(list(weights), texture)
        self.bricks_per_task = max(1, min(4, WORK_PER_TASK // (BRICK * texture.gamma.shape[1] ** 2)))
        self.library = _library(_library_file())
        self.name = f"kernel:{self.path}"

    def instance(self, tiling: Tiling, seed: int) -> KernelInstance:
        return KernelInstance(self, tiling, seed)

    def check(self, tiling: Tiling) -> None:
        """Any tiling will do."""


class KernelInstance:
    """One instance of a texture in the kernel's memory, some 30 MB. Read by any number of threads, freed when forgotten."""

    def __init__(self, engine: KernelEngine, tiling: Tiling, seed: int) -> None:
        """Raises EvaluationError for a seed out of range, or when memory does not suffice."""
        texture, octaves = engine.texture, len(tiling.transforms)
        layers, width = texture.gamma.shape
        arrays: dict[str, npt.NDArray[Any]] = {
            "noise": noise_tables(seed, octaves),  # checks the seed
            "transforms": np.ascontiguousarray(tiling.transforms),
            "offsets": noise_offsets(seed, octaves),
            "lattice": np.ascontiguousarray(tiling.lattice),
            "weights": engine.folded,
        }
        description = _Description(octaves, width, layers, engine.precision == "bfloat16", any(tiling.period))
        for name, array in arrays.items():
            setattr(description, name, array.ctypes.data)
        self.library, self.name, self.bricks_per_task = engine.library, texture.name, engine.bricks_per_task
        self.handle: int | None = self.library.solidgrain_open(ctypes.byref(description), engine.path.encode())
        if not self.handle:
            raise EvaluationError(f"{self.name}: not enough memory for the fused kernel")

    def __del__(self) -> None:
        if getattr(self, "handle", None):
            self.library.solidgrain_close(self.handle)

    def point_tasks(self, points: DoubleArray, rgb: FloatArray) -> list[Task]:
        """Calls that fill `rgb` [P, 3] with the colours of points [P, 3], in any order, in any threads."""
        count = BRICK * self.bricks_per_task
        return [partial(self._points, points[k : k + count], rgb[k : k + count]) for k in range(0, len(points), count)]

    def grid_tasks(self, x: DoubleArray, y: DoubleArray, z: DoubleArray, rgb: FloatArray) -> list[Task]:
        """The same for the product of coordinates along each axis, `rgb` [len(z), len(y), len(x), 3]."""
        bricks = self.library.solidgrain_bricks(len(x), len(y), len(z))
        count = self.bricks_per_task
        return [partial(self._bricks, x, y, z, k, min(count, bricks - k), rgb) for k in range(0, bricks, count)]

    def _points(self, points: DoubleArray, rgb: FloatArray) -> None:
        found = self.library.solidgrain_points(self.handle, points.ctypes.data, len(points), rgb.ctypes.data)
        if self._is_wrong(found):
            raise EvaluationError.of_nan(self.name, points[found])

    def _bricks(self, x: DoubleArray, y: DoubleArray, z: DoubleArray, first: int, count: int, rgb: FloatArray) -> None:
        axes = [item for axis in (x, y, z) for item in (axis.ctypes.data, len(axis))]
        found = self.library.solidgrain_grid(self.handle, *axes, first, count, rgb.ctypes.data)
        if self._is_wrong(found):
            rows, column = divmod(found, len(x))
            plane, row = divmod(rows, len(y))
            raise EvaluationError.of_nan(self.name, (x[column], y[row], z[plane]))

    def _is_wrong(self, found: int) -> bool:
        """Whether what a call returned is the index of a colour that is not finite. Raises EvaluationError without memory."""
        if found == -2:
            raise EvaluationError(f"{self.name}: not enough memory for the fused kernel")
        return found >= 0


def _library_file() -> Path:
    """The kernel's library. Raises KernelMissingError if it was not built."""
    named = os.environ.get("SOLIDGRAIN_KERNEL_LIBRARY")
    if named:
        return Path(named).absolute()  # a bare name would be looked for in the system's folders
    found = sorted(Path(__file__).parent.glob("_kernel*"))
    if not found:
        raise KernelMissingError("the fused kernel was not built; install solidgrain where a C++17 compiler is")
    return found[0]


@cache
def _library(path: Path) -> ctypes.CDLL:
    """The loaded library. Raises KernelMissingError if the file is missing, cut short, foreign or of another version."""
    try:
        _check_whole(path)
        _check_recorded(path)
        library = ctypes.CDLL(os.fspath(path))
        abi = library.solidgrain_abi()
        if abi != ABI:
            raise ValueError(f"{path} is made for interface {abi}, expected {ABI}")
        _declare(library)
    except (OSError, AttributeError, ValueError) as error:
        raise KernelMissingError(f"the fused kernel cannot be loaded ({error}); install solidgrain again") from error
    return library


def _declare(library: ctypes.CDLL) -> None:
    """Results and arguments of every function. Raises AttributeError if one is missing."""
    integer, pointer = ctypes.c_int64, ctypes.c_void_p
    for name, result, arguments in (
        ("solidgrain_paths", ctypes.c_char_p, ()),
        ("solidgrain_open", pointer, (pointer, ctypes.c_char_p)),
        ("solidgrain_close", None, (pointer,)),
        ("solidgrain_points", integer, (pointer, pointer, integer, pointer)),
        ("solidgrain_bricks", integer, (integer, integer, integer)),
        ("solidgrain_grid", integer, (pointer, *(pointer, integer) * 3, integer, integer, pointer)),
    ):
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments


def _check_recorded(path: Path) -> None:
    """Raises ValueError if a library is not the bytes that were installed: calling into damaged code ends the process.

    A wheel's RECORD has the sha256 of its files ("Recording installed projects", Python packaging specifications); a library
    without one, such as an editable install's, is taken as it is.
    """
    for record in path.parents[2].glob("solidgrain-*.dist-info/RECORD") if len(path.parents) > 2 else ():
        with open(record, encoding="utf-8", newline="") as file:
            for name, digest, _ in csv.reader(file):
                if record.parents[1] / name == path and digest.startswith("sha256="):
                    found = hashlib.sha256(path.read_bytes()).digest()
                    if base64.urlsafe_b64encode(found).rstrip(b"=").decode() != digest.removeprefix("sha256="):
                        raise ValueError(f"{path} is not the file that was installed (sha256 differs)")


def _check_whole(path: Path) -> None:
    """Raises ValueError if an ELF file is cut short: loading one ends the process with a bus error.

    Section headers come last; the ELF header says where they end (System V ABI, "ELF Header").
    """
    with open(path, "rb") as file:
        header = file.read(64)
    if header[:5] != b"\x7fELF\x02":
        return  # another kind of library: its loader will tell
    if len(header) < 64:
        raise ValueError(f"{path} is cut short")
    order = ">" if header[5] == 2 else "<"
    (start,), (size, count) = struct.unpack_from(f"{order}Q", header, 40), struct.unpack_from(f"{order}HH", header, 58)
    if path.stat().st_size < start + size * count:
        raise ValueError(f"{path} is cut short")
