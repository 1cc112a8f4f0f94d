"""Is a finished output what its plan says? Its files' checksums, and random voxels of it evaluated again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from solidgrain.bake.color import from_srgb, to_linear, to_srgb
from solidgrain.bake.manifest import SUFFIX, damaged_files, manifest_path, read_manifest
from solidgrain.bake.plan import Plan, plan_from_json
from solidgrain.bake.writers import FloatArray, Output, open_writer
from solidgrain.runtime import Texture, load
from solidgrain.runtime.errors import BakeError

MACHINES = 1e-3  # by how much two machines' paths of the sampler may differ, in any colour space


@dataclass(frozen=True)
class Verified:
    """What was found about one output. It is sound if nothing is wrong."""

    output: Path
    files: int
    wrong: list[str]
    voxels: int  # that were compared; 0 if the format is lossy beyond a bound
    largest: float  # difference beyond what the format rounds


def verify(target: Path, voxels: int, provider: str = "auto", threads: int = 0) -> Verified:
    """Check one output, named by its path or its manifest. Raises BakeError if there is nothing that could be checked."""
    path = target if target.name.endswith(SUFFIX) else manifest_path(target)
    manifest = read_manifest(path)
    wrong = damaged_files(manifest, path.parent)
    output_path = path.parent / manifest["output"]
    compared, largest = 0, 0.0
    if voxels and not wrong:
        plan, output = _planned(manifest, path)
        texture = load(plan.source, bundle=plan.bundle, provider=provider, precision=plan.precision, threads=threads)
        check_texture(plan, texture, f"{path}")
        compared, largest = compare(plan, output, texture, voxels)
        if largest > MACHINES:
            wrong.append(f"{output_path}: voxels differ from the texture by up to {largest:.4f} beyond rounding")
    return Verified(output_path, len(manifest["files"]), wrong, compared, largest)


def _planned(manifest: dict[str, Any], path: Path) -> tuple[Plan, Output]:
    """The plan of a manifest, and its output where the manifest lies now."""
    try:
        plan = plan_from_json(manifest["plan"])
        output = next(output for output in plan.outputs if output.path.name == manifest["output"])
    except (KeyError, TypeError, ValueError, StopIteration) as error:
        raise BakeError(f"{path}: its plan is incomplete ({error}); bake again with --overwrite") from error
    return plan, replace(output, path=path.parent / output.path.name)


def check_texture(plan: Plan, texture: Texture, where: str) -> None:
    """Raises BakeError if a plan was made with another texture than the one that is loaded."""
    for found, expected, what in (
        (texture.data.sampler_sha256, plan.sampler_sha256, "sampler"),
        (texture.data.sha256, plan.texture_sha256, "texture"),
    ):
        if found != expected:
            raise BakeError(
                f"{where}: made with the {what} {expected[:12]}…, {plan.source} now has {found[:12]}…; "
                "use the bundle that it was made with, or make the plan anew"
            )


def compare(plan: Plan, output: Output, texture: Texture, count: int) -> tuple[int, float]:
    """How many voxels were compared, and the largest difference beyond what the format rounds."""
    draw = np.random.default_rng(plan.seed)
    voxels = draw.integers(0, plan.size, (min(count, plan.volume.voxels), 3))
    found = open_writer(output, plan.volume, texture.workers).probe(voxels)
    if found is None:
        return 0, 0.0
    colors, rounding = found
    expected = from_srgb(np.stack([evaluate_voxel(plan, texture, voxel) for voxel in voxels]), output.colorspace)
    return len(voxels), max(0.0, float(np.abs(colors - expected).max()) - rounding)


def evaluate_voxel(plan: Plan, texture: Texture, voxel: npt.NDArray[np.int64]) -> FloatArray:
    """The colour [3] of voxel (x, y, z) of a plan, sRGB-encoded, by itself."""
    fine = round(plan.samples ** (1 / 3))
    origin = [start + int(k) * step for start, k, step in zip(plan.origin, voxel, plan.spacing, strict=True)]
    samples = texture.grid(
        (fine, fine, fine),
        plan.seed,
        origin=origin,
        spacing=[step / fine for step in plan.spacing],
        tile=plan.tile,
        period=[fine * extent for extent in plan.volume.shape],
        transform=plan.transform,
    ).reshape(-1, 3)
    return samples[0] if fine == 1 else to_srgb(to_linear(samples).mean(0))
