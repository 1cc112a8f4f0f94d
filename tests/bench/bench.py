"""The figures of the README: start-up, memory and speed, each measured in a process of its own where that matters.

make bench        prints a Markdown table; `--size 128` for a shorter run
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

import numpy as np

from solidgrain.runtime import load
from solidgrain.runtime.noise import noise_tables
from solidgrain.runtime.provider import usable_threads

CLI = [sys.executable, "-m", "solidgrain.bake.cli"]
MEGABYTE = 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=256, help="voxels along each axis of the bake")
    size = parser.parse_args().size
    print(f"{usable_threads()} threads\n\n| what | figure | goal |\n|---|---|---|", flush=True)
    row("import solidgrain.runtime", f"{import_seconds():.2f} s", "0.35 s")
    row("solidgrain --help", f"{best(lambda: run([*CLI, '--help'])):.2f} s", "0.2 s")
    baked = bake(f"{size}", size)
    row(f"bake {size}³ to EXR + VTI: peak memory", f"{baked['peak_memory_bytes'] / MEGABYTE:.0f} MB", "700 MB")
    shallow, deep = (bake(f"256x256x{depth}", size)["peak_memory_bytes"] for depth in (64, 1024 if size >= 256 else 128))
    row("peak memory, 256x256x1024 over 256x256x64", f"{deep / shallow:.2f}", "1.10")
    row("sampler only, in the bake", f"{size**3 / baked['evaluation_seconds'] / 1e6:.2f} Mvoxel/s", "")
    row("bake end to end", f"{baked['voxels_per_second'] / 1e6:.2f} Mvoxel/s", "")
    row("the same graph, one ONNX Runtime session with all threads", f"{graph_rate():.2f} Mvoxel/s", "")
    row("torch, eager, float32", f"{torch_rate():.2f} Mvoxel/s", "")


def row(what: str, figure: str, goal: str) -> None:
    print(f"| {what} | {figure} | {goal} |", flush=True)


def run(command: list[str]) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def best(action: Callable[[], object], times: int = 5) -> float:
    """Seconds of the fastest of several calls."""
    found = []
    for _ in range(times):
        started = time.perf_counter()
        action()
        found.append(time.perf_counter() - started)
    return min(found)


def import_seconds() -> float:
    code = "import time; t = time.perf_counter(); import solidgrain.runtime; print(time.perf_counter() - t)"
    return min(float(run([sys.executable, "-c", code])) for _ in range(5))


def bake(size: str, cube: int) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        outputs = ["--out", f"{folder}/a.####.exr", "--out", f"{folder}/a.vti"]
        report: dict[str, float] = json.loads(run([*CLI, "bake", "granite", "--size", size, "--json", "--quiet", *outputs]))
        return report


def graph_rate(points: int = 2**17) -> float:
    """The exported graph as any other program would run it: one session, one call, ONNX Runtime's own threads."""
    import onnxruntime

    texture = load("granite")
    session = onnxruntime.InferenceSession(str(texture.bundle.folder / "sampler.onnx"), providers=["CPUExecutionProvider"])
    octaves = len(texture.transforms)
    feed = {
        **texture.data.arrays(),
        "points": slice_points(points),
        "offsets": np.zeros((octaves, 3)),
        "lattice": np.tile(64 * np.eye(3), (octaves, 1, 1)),
        "noise": noise_tables(0, octaves),
    }
    return points / best(lambda: session.run(["rgb"], feed), 3) / 1e6


def torch_rate(points: int = 2**17) -> float:
    """The sampler as it was trained, with weights of no importance."""
    import torch

    from solidgrain.train.sampler import Sampler
    from solidgrain.train.settings import FAST

    torch.set_num_threads(usable_threads())
    sampler = Sampler(FAST, torch.Generator().manual_seed(0))
    tables = torch.from_numpy(noise_tables(0, 16))
    where = torch.from_numpy(slice_points(points) / 64).float()[None]
    with torch.no_grad():
        return points / best(lambda: sampler(tables, where), 3) / 1e6


def slice_points(count: int) -> np.ndarray:
    """Voxel centres of a plane 256 wide, rows first."""
    y, x = np.divmod(np.arange(count), 256)
    return np.stack([x + 0.5, y + 0.5, np.full(count, 0.5)], axis=1)


if __name__ == "__main__":
    main()
