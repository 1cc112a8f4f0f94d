"""What the bench measures: rates of evaluators, of the libraries that they are compared with, and of whole commands."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from solidgrain.export.bundle import Details, write_bundle
from solidgrain.runtime import load
from solidgrain.runtime.noise import noise_offsets, noise_tables
from tests.toy import toy_weights

CLI = [sys.executable, "-m", "solidgrain.bake.cli"]
WIDTH, HIDDEN_LAYERS = 128, 5
SHARE = 1.0  # seconds that every way gets in a round of the bench
BLOCK = (8, 256, 256)  # z, y, x
SLOW_BLOCK = (2, 256, 256)


def best(action: Callable[[], object], times: int = 3) -> float:
    """Seconds of the fastest of several calls."""
    found = []
    for _ in range(times):
        started = time.perf_counter()
        action()
        found.append(time.perf_counter() - started)
    return min(found)


def fastest(action: Callable[[], object], seconds: float = SHARE) -> float:
    """Seconds of the fastest of the calls that begin within so many seconds, two at least."""
    ends, found = time.perf_counter() + seconds, [best(action, 1)]
    while len(found) < 2 or time.perf_counter() < ends:
        found.append(best(action, 1))
    return min(found)


def flops(octaves: int) -> int:
    """Floating-point operations of the folded perceptron per voxel; the noise lookup comes on top."""
    return 2 * (octaves * WIDTH + (HIDDEN_LAYERS - 1) * WIDTH**2 + 3 * WIDTH)


@contextmanager
def bundle(octaves: int) -> Iterator[Path]:
    """A random sampler of the full size: what it draws is of no importance to its speed."""
    with tempfile.TemporaryDirectory() as folder:
        yield write_bundle(Path(folder) / "bench", toy_weights(octaves, WIDTH), Details(name="bench", patch=64))


@contextmanager
def kernel_path(path: str) -> Iterator[None]:
    os.environ["SOLIDGRAIN_KERNEL"] = path
    try:
        yield
    finally:
        del os.environ["SOLIDGRAIN_KERNEL"]


def texture_rates(folder: Path, threads: int, path: str, precision: str = "float32") -> dict[str, float]:
    """Voxels per second through the runtime: a grid, a grid that tiles, and points in no order. Path "cpu": ONNX Runtime."""
    shape = SLOW_BLOCK if path in ("cpu", "portable") else BLOCK
    count = shape[0] * shape[1] * shape[2]
    points = np.random.default_rng(0).uniform(0, 256, (count // 4, 3))
    with kernel_path("off" if path == "cpu" else path):
        texture = load(folder, provider="auto", precision=precision, threads=threads)
        texture.grid((1, 8, 8)), texture.grid((1, 8, 8), tile="xyz", period=(256, 256, 256))
        return {
            "grid": count / fastest(lambda: texture.grid(shape)),
            "tiled": count / fastest(lambda: texture.grid(shape, tile="xyz", period=(256, 256, 256)), SHARE / 2),
            "points": len(points) / fastest(lambda: texture.sample(points), SHARE / 2),
        }


def graph_rate(folder: Path, threads: int, points: int = 2**16) -> float:
    """The exported graph as any other program would run it: one session, one call, ONNX Runtime's own threads."""
    import onnxruntime

    texture = load(folder, provider="cpu")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(str(folder / "sampler.onnx"), options, providers=["CPUExecutionProvider"])
    octaves = len(texture.transforms)
    feed = {
        **texture.data.arrays(),
        "points": slice_points(points),
        "offsets": noise_offsets(0, octaves),
        "lattice": np.tile(64 * np.eye(3), (octaves, 1, 1)),
        "noise": noise_tables(0, octaves),
    }
    return points / fastest(lambda: session.run(["rgb"], feed))


def torch_rate(octaves: int, threads: int, points: int = 2**16) -> float:
    """The sampler as it was trained, eager, float32, with weights of no importance."""
    from dataclasses import replace

    import torch

    from solidgrain.train.noise import runtime_noise
    from solidgrain.train.sampler import Sampler
    from solidgrain.train.settings import FAST

    torch.set_num_threads(threads)
    sampler = Sampler(replace(FAST, octaves=octaves), torch.Generator().manual_seed(0))
    where = torch.from_numpy(slice_points(points) / 64).float()[None]
    noise = runtime_noise(0, octaves, where)
    with torch.no_grad():
        return points / fastest(lambda: sampler(noise, where))


def torch_rate_without_avx512(octaves: int, threads: int) -> float:
    """The same in a process whose torch, oneDNN and MKL use AVX2 at most."""
    code = f"from tests.bench.measure import torch_rate; print(torch_rate({octaves}, {threads}))"
    limits = {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2", "MKL_ENABLE_INSTRUCTIONS": "AVX2"}
    return float(run([sys.executable, "-c", code], {**limits, "PYTHONPATH": str(Path.cwd())}))


def gemm_rate(precision: str, threads: int, size: int = 2048) -> float:
    """Floating-point operations per second of one large matrix product in torch (oneDNN, MKL)."""
    import torch

    torch.set_num_threads(threads)
    first, second = (torch.randn(size, size).to(getattr(torch, precision)) for _ in range(2))
    return 2 * size**3 / fastest(lambda: first @ second)


def library_rate(octaves: int, precision: str, threads: int, points: int = 2**13) -> float:
    """The folded perceptron alone, without noise, as five matrix products of torch (oneDNN), buffers allocated before."""
    import torch

    torch.set_num_threads(threads)
    dtype, bin_size = getattr(torch, precision), octaves // 4
    shapes = [bin_size, *[WIDTH + bin_size] * 3, WIDTH]
    weights = [torch.randn(inputs, WIDTH).to(dtype) / 12 for inputs in shapes]
    inputs = [torch.randn(points, rows).to(dtype) for rows in shapes]
    last, bias = torch.randn(WIDTH, 3).to(dtype), torch.zeros(WIDTH).to(dtype)

    def perceptron() -> object:
        for layer, weight in enumerate(weights):
            y = torch.nn.functional.leaky_relu_(torch.addmm(bias, inputs[layer], weight), 0.2)
            if layer + 1 < len(weights):
                inputs[layer + 1][:, :WIDTH] = y
        return y @ last

    with torch.no_grad():
        return points / fastest(perceptron)


def accuracy(name: str, ways: list[tuple[str, str]], edge: int = 216) -> dict[tuple[str, str], dict[str, float]]:
    """A texture on (path, precision) against its ONNX graph, over ten million voxels: the largest difference, and the PSNR."""
    graph, shape, textures = load(name, provider="cpu"), (edge, edge, edge), {}
    for path, precision in ways:
        with kernel_path(path):
            textures[path, precision] = load(name, provider="kernel", precision=precision)
    largest, squares = dict.fromkeys(ways, 0.0), dict.fromkeys(ways, 0.0)
    slabs = zip(graph.slabs(shape, 1), *(texture.slabs(shape, 1) for texture in textures.values()), strict=True)
    for (_, expected), *found in slabs:
        for way, (_, slab) in zip(textures, found, strict=True):
            difference = np.abs(slab.astype(np.float64) - expected)
            largest[way] = max(largest[way], float(difference.max()))
            squares[way] += float((difference**2).sum())
    return {way: {"largest": largest[way], "psnr": -10 * float(np.log10(squares[way] / (3 * edge**3)))} for way in ways}


def import_seconds() -> float:
    code = "import time; t = time.perf_counter(); import solidgrain.runtime; print(time.perf_counter() - t)"
    return min(float(run([sys.executable, "-c", code])) for _ in range(5))


def first_slab_seconds() -> float:
    """From the start of a process to the first slab of the embedded texture, 16 slices of 128²."""
    code = "from solidgrain.runtime import load; next(load().slabs((128, 128, 128)))"
    return best(lambda: run([sys.executable, "-c", code]), 7)


def bake(source: str | Path, size: str, suffixes: tuple[str, ...], *options: str) -> dict[str, float]:
    """What `solidgrain bake --json` reports."""
    with tempfile.TemporaryDirectory() as folder:
        outputs = [word for suffix in suffixes for word in ("--out", f"{folder}/a{suffix}")]
        command = [*CLI, "bake", str(source), "--size", size, "--json", "--quiet", *options, *outputs]
        report: dict[str, float] = json.loads(run(command))
        report["bytes"] = sum(path.stat().st_size for path in Path(folder).iterdir())
        return report


def evaluation_seconds(source: str | Path, size: int, threads: int = 0, precision: str = "float32") -> float:
    """A cube, evaluated slab by slab and thrown away."""
    texture = load(source, threads=threads, precision=precision)
    texture.grid((1, 8, 8))
    return best(lambda: [None for _ in texture.slabs((size, size, size))], 2 if size < 256 else 1)


def run(command: list[str], environment: dict[str, str] | None = None) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True, env={**os.environ, **(environment or {})}).stdout


def slice_points(count: int) -> np.ndarray:
    """Voxel centres of a plane 256 wide, rows first."""
    y, x = np.divmod(np.arange(count), 256)
    return np.stack([x + 0.5, y + 0.5, np.full(count, 0.5)], axis=1)
