"""The figures of README and docs/speed.md: `make bench` prints them as Markdown and writes them to build/bench.json.

Rates are those of the fastest runs: in each of several rounds every way gets the same few seconds, because a shared machine is
slow at times, and unlike ways then by unlike factors. What is compared is measured in the same rounds. Nothing else should be
running. `--quick` leaves out the largest sizes.
"""

from __future__ import annotations

import argparse
import json
import math
from operator import itemgetter
from pathlib import Path
from typing import Any

from solidgrain.bake.arguments import parse_positive
from solidgrain.runtime import embedded_names
from solidgrain.runtime.kernel import BFLOAT16_PATHS, kernel_paths
from solidgrain.runtime.workers import usable_threads
from tests.bench import measure

MEGA = 1e6
ROUNDS, BAKE_ROUNDS = 6, 3
OUTPUTS = (".####.exr", ".vti")
GEMM = "one 2048² product, torch {}, per perceptron"
REPORT = Path("build/bench.json")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="leave out the largest sizes")
    parser.add_argument("--rounds", type=parse_positive, default=ROUNDS, help=f"of the evaluators, a minute each ({ROUNDS})")
    arguments = parser.parse_args()
    quick = arguments.quick
    threads = sorted({1, usable_threads()})
    report: dict[str, Any] = {"threads": threads[-1], "kernel_paths": kernel_paths()}
    report["rates"] = [row for octaves in (32, 16) for row in rates(octaves, threads, arguments.rounds)]
    report["start"] = start()
    report["bakes"] = bakes(128 if quick else 256, threads, report["rates"])
    report["memory"] = depth(128 if quick else 256)
    report["scaling"] = scaling((64, 128, 256) if quick else (64, 128, 256, 512))
    report["accuracy"] = accuracy()
    REPORT.parent.mkdir(exist_ok=True)
    REPORT.write_text(json.dumps(report, indent=2) + "\n", "utf-8")
    print(f"\n{REPORT} holds all of it.")


def rates(octaves: int, threads: list[int], repeats: int) -> list[dict[str, Any]]:
    """The table of evaluators, one row per way and thread count."""
    columns = ("way", "threads", "grid", "tiled", "points", "over_torch", "over_graph", "of_gemm", "over_one_thread")
    heading(f"n = {octaves}, Mvoxel/s", *columns[:5], "× torch", "× ONNX graph", "of GEMM", "× one thread")
    rows: list[dict[str, Any]] = []
    alone: dict[str, float] = {}  # by way, with one thread
    for count in threads:
        rounds = [one_round(octaves, count) for _ in range(repeats)]
        best = {way: {key: max(found[way][key] for found in rounds) for key in rate} for way, rate in rounds[0].items()}
        for way, rate in best.items():
            fast = rate.get("grid", rate["points"])
            gemm = best[GEMM.format("bfloat16" if "bfloat16" in way else "float32")]["points"]
            row = {
                "octaves": octaves,
                "way": way,
                "threads": count,
                **{key: round(value / MEGA, 3) for key, value in rate.items()},
                "over_torch": round(fast / best["torch, eager"]["points"], 1),
                "over_graph": round(fast / best["ONNX graph, one session"]["points"], 1),
                "of_gemm": round(fast / gemm, 2),
                "over_one_thread": round(fast / alone.setdefault(way, fast), 2),
            }
            rows.append(row)
            line(*(row.get(key, "") for key in columns))
    return rows


def one_round(octaves: int, threads: int) -> dict[str, dict[str, float]]:
    """Every way, for a second or two. Rounds are a minute apart: whatever else the machine does meets all ways alike."""
    with measure.bundle(octaves) as folder:
        found = {
            "torch, eager": {"points": measure.torch_rate(octaves, threads)},
            "torch, eager, AVX2 only": {"points": measure.torch_rate_without_avx512(octaves, threads)},
            "ONNX graph, one session": {"points": measure.graph_rate(folder, threads)},
            "runtime: ONNX Runtime": measure.texture_rates(folder, threads, "cpu"),
        }
        for path in kernel_paths():
            found[f"runtime: kernel {path}"] = measure.texture_rates(folder, threads, path)
            if path in BFLOAT16_PATHS:
                found[f"runtime: kernel {path}, bfloat16"] = measure.texture_rates(folder, threads, path, "bfloat16")
    for precision in ("float32", "bfloat16"):
        found[f"perceptron alone, torch {precision}"] = {"points": measure.library_rate(octaves, precision, threads)}
        found[GEMM.format(precision)] = {"points": measure.gemm_rate(precision, threads) / measure.flops(octaves)}
    return found


def start() -> dict[str, float]:
    heading("Start-up", "what", "seconds")
    found = {
        "import solidgrain.runtime": measure.import_seconds(),
        "solidgrain --help": measure.best(lambda: measure.run([*measure.CLI, "--help"]), 5),
        "process start to the first slab, 16 × 128²": measure.first_slab_seconds(),
    }
    for what, seconds in found.items():
        line(what, f"{seconds:.2f}")
    return found


def bakes(size: int, threads: list[int], rates: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """End to end: whole bakes against the evaluation alone, half EXR and uint8 VTI, and against the bare evaluators."""
    columns = ("n", "cube", "threads", "precision", "output", "seconds", "× evaluation alone", "peak MB")
    heading("Bakes, end to end", *columns, "Mvoxel/s", "× torch", "× ONNX graph")
    precisions = ["float32", "bfloat16"] if kernel_paths()[0] in BFLOAT16_PATHS else ["float32"]
    rows = []
    for octaves in (32, 16):
        with measure.bundle(octaves) as folder:
            for count in threads:
                edge = size if count == threads[-1] else size // 2
                for precision in precisions:
                    alone, bakes_of = fastest_bakes(folder, edge, count, precision)
                    for output, baked in bakes_of.items():
                        row = {
                            "octaves": octaves,
                            "cube": f"{edge}³",
                            "threads": count,
                            "precision": precision,
                            "output": output,
                            "seconds": round(baked["seconds"], 2),
                            "over_evaluation": round(baked["seconds"] / alone, 2),
                            "peak_megabytes": round(baked["peak_memory_bytes"] / 2**20),
                            "rate": round(edge**3 / baked["seconds"] / MEGA, 3),
                        }
                        for name, way in (("over_torch", "torch, eager"), ("over_graph", "ONNX graph, one session")):
                            row[name] = round(row["rate"] / rate_of(rates, way, octaves, count), 1)
                        rows.append(row)
                        line(*row.values())
    return rows


def rate_of(rates: list[dict[str, Any]], way: str, octaves: int, threads: int) -> float:
    """Mvoxel/s of an evaluator."""
    return next(row["points"] for row in rates if (row["way"], row["octaves"], row["threads"]) == (way, octaves, threads))


def fastest_bakes(folder: Path, edge: int, threads: int, precision: str) -> tuple[float, dict[str, dict[str, float]]]:
    """Seconds of the evaluation alone, and what bakes report, by output: of each the fastest, in turns."""
    alone, found = math.inf, {}
    for _ in range(BAKE_ROUNDS):
        alone = min(alone, measure.evaluation_seconds(folder, edge, threads, precision))
        for output in OUTPUTS:
            baked = measure.bake(folder, str(edge), (output,), "--threads", str(threads), "--precision", precision)
            found[output] = min(found.get(output, baked), baked, key=itemgetter("seconds"))
    return alone, found


def depth(size: int) -> dict[str, float]:
    """That memory does not grow with depth."""
    shallow, deep = (
        measure.bake("granite", f"{size}x{size}x{slices}", OUTPUTS)["peak_memory_bytes"] for slices in (size // 4, 4 * size)
    )
    heading("Memory", "bake to EXR and VTI", "peak MB")
    line(f"{size}×{size}×{size // 4}", round(shallow / 2**20))
    line(f"{size}×{size}×{4 * size}", round(deep / 2**20))
    return {"shallow": shallow, "deep": deep}


def scaling(sizes: tuple[int, ...]) -> dict[int, float]:
    heading("Time per voxel against size, evaluation alone", "cube", "ns per voxel")
    found = {size: measure.evaluation_seconds("granite", size) / size**3 * 1e9 for size in sizes}
    for size, nanoseconds in found.items():
        line(f"{size}³", f"{nanoseconds:.0f}")
    return found


def accuracy() -> list[dict[str, Any]]:
    """Every embedded texture, on every path, against its graph in ONNX Runtime."""
    heading("Difference from the ONNX graph, 216³ voxels", "texture", "way", "largest", "PSNR, dB")
    rows = []
    ways = [(path, "float32") for path in kernel_paths()] + [
        (path, "bfloat16") for path in kernel_paths() if path in BFLOAT16_PATHS
    ]
    for name in embedded_names():
        for (path, precision), found in measure.accuracy(name, ways).items():
            rows.append({"texture": name, "way": f"{path}, {precision}", **found})
            line(name, f"{path}, {precision}", f"{found['largest']:.1e}", f"{found['psnr']:.1f}")
    return rows


def heading(title: str, *columns: str) -> None:
    print(f"\n{title}\n")
    line(*columns)
    line(*["---"] * len(columns))


def line(*cells: object) -> None:
    print(f"| {' | '.join(str(cell) for cell in cells)} |", flush=True)


if __name__ == "__main__":
    main()
