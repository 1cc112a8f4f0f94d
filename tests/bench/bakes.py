"""`make bench-bake`: what each format adds to the evaluation, and what a large bake needs.

A bake's seconds are compared with the evaluation of the same volume right before and after it, the faster of the two: on a
shared machine speeds drift.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from tests.bench import measure
from tests.bench.bench import heading, line

EDGE = 256
LARGE = "1024x1024x512"
BAKES: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("EXR, half, zip", ".####.exr", ()),
    ("EXR, half, none", ".####.exr", ("--exr-compression", "none")),
    ("EXR, float, zip", ".####.exr", ("--exr-type", "float")),
    ("EXR, half, zip, across x", ".####.exr", ("--exr-axis", "x")),
    ("VTI, uint8, none", ".vti", ()),
    ("VTI, uint8, zlib", ".vti", ("--vti-compression", "zlib")),
    ("VDB, half, none", ".vdb", ()),
    ("VDB, half, zlib", ".vdb", ("--vdb-compression", "zlib")),
    ("DDS, rgba8", ".dds", ()),
    ("DDS, rgba8, Kaiser mips", ".dds", ("--mips", "--mip-filter", "kaiser")),
    ("DDS, BC1", ".dds", ("--dds-type", "bc1")),
    ("atlas, PNG", ".atlas.png", ()),
    ("raw, uint8", ".raw", ()),
    ("npy, float32", ".npy", ()),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="write the figures there too")
    parser.add_argument("--large", action="store_true", help=f"also bake {LARGE} to EXR, which takes minutes and gigabytes")
    arguments = parser.parse_args()
    found = {"formats": formats(), **({"large": large()} if arguments.large else {})}
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=2))


def formats() -> list[dict[str, object]]:
    heading(f"Bakes of the embedded granite, {EDGE}³", "output", "seconds", "× evaluation alone", "peak MB", "MB on disk")
    rows = []
    before = measure.evaluation_seconds("granite", EDGE)
    for what, suffix, flags in BAKES:
        baked = measure.bake("granite", str(EDGE), (suffix,), *flags)
        after = measure.evaluation_seconds("granite", EDGE)
        row = {
            "output": what,
            "seconds": round(baked["seconds"], 1),
            "over_evaluation": round(baked["seconds"] / min(before, after), 2),
            "peak_megabytes": round(baked["peak_memory_bytes"] / 2**20),
            "megabytes": round(baked["bytes"] / 2**20),
        }
        rows.append(row)
        line(*row.values())
        before = after
    return rows


def large() -> dict[str, float]:
    heading(f"A bake of {LARGE} to half EXR, zip", "seconds", "Mvoxel/s", "peak MB")
    baked = measure.bake("granite", LARGE, (".####.exr",))
    line(round(baked["seconds"]), round(baked["voxels_per_second"] / 1e6, 2), round(baked["peak_memory_bytes"] / 2**20))
    return {key: baked[key] for key in ("seconds", "voxels_per_second", "peak_memory_bytes")}


if __name__ == "__main__":
    main()
