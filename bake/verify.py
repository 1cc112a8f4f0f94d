"""Is a finished output what its plan says? Its files' checksums, and voxels drawn from it evaluated again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from solidgrain.bake.color import from_srgb, to_linear, to_srgb
from solidgrain.bake.frames import in_hashes
from solidgrain.bake.manifest import SUFFIX, damaged_files, manifest_path, read_manifest
from solidgrain.bake.plan import Plan, hash_of
from solidgrain.bake.schema import plan_of, seen_in
from solidgrain.bake.writers import FloatArray, Output, bounds, open_writer
from solidgrain.runtime import Texture, load_texture
from solidgrain.runtime.errors import BakeError, BundleError

# By how much two machines' paths of the sampler may differ, in any colour space; colours above 1 that many times as much.
MACHINES = {"float32": 1e-3, "bfloat16": 2e-2}


@dataclass(frozen=True)
class Verified:
    """What was found about one output. It is sound if nothing is wrong."""

    output: Path
    files: int
    wrong: list[str]
    voxels: int  # that were compared; 0 if the format is lossy beyond a bound
    largest: float  # difference beyond what the format rounds


def verify(
    target: Path, voxels: int, source: str | None = None, bundle: str | None = None, provider: str = "auto", threads: int = 0
) -> Verified:
    """Check one output, named by its path or its manifest; `source` and `bundle` say where its texture is now, if it moved.

    Raises BakeError or UsageError if there is nothing that could be checked.
    """
    path = target if target.name.endswith(SUFFIX) else manifest_path(target)
    manifest = read_manifest(path)
    wrong = damaged_files(manifest, path.parent)
    output_path = path.parent / manifest["output"]
    compared, largest = 0, 0.0
    if voxels and not wrong:
        plan, output = _planned(manifest, path)
        texture = _texture(plan, path, source, bundle, provider, threads)
        check_texture(replace(plan, source=source or plan.source), texture, f"{path}")
        compared, largest = compare(plan, output, texture, voxels)
        if not largest <= MACHINES[texture.precision]:
            wrong.append(f"{output_path}: voxels differ from the texture by up to {largest:.4f} beyond rounding")
    return Verified(output_path, len(manifest["files"]), wrong, compared, largest)


def _texture(plan: Plan, path: Path, source: str | None, bundle: str | None, provider: str, threads: int) -> Texture:
    """The texture of a manifest's plan. Raises BakeError where the plan says it is, there is none."""
    source_of, bundle_of = source or plan.source, bundle or plan.bundle
    try:
        return load_texture(source_of, bundle=bundle_of, provider=provider, precision=plan.precision, threads=threads)
    except BundleError as error:
        if source or bundle:
            raise
        where = "say where it is with --source, or check the files alone with --voxels 0"
        raise BakeError(f"{path}: its files are whole, but not its texture: {error}; {where}") from error


def _planned(manifest: dict[str, Any], path: Path) -> tuple[Plan, Output]:
    """The plan of a manifest, and its output where the manifest lies now."""
    plan = seen_in(path.parent, plan_of(manifest["plan"], str(path), "plan"))
    for output in plan.outputs:
        if in_hashes(output.path).name == manifest["output"] and hash_of(plan.work(output)) == manifest["work"]:
            return plan, replace(output, path=path.parent / output.path.name)
    raise BakeError(
        f"{path}: its plan is not the one of its files: it was edited, or another version of solidgrain made it; "
        "check the files alone with --voxels 0, or bake again with --overwrite"
    )


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
    draw = np.random.default_rng()
    depth, height, width = plan.volume.shape
    places = draw.choice(plan.volume.voxels, min(count, plan.volume.voxels), replace=False, shuffle=False)
    voxels = np.stack(np.unravel_index(places, (depth, height, width))[::-1], 1)  # (x, y, z)
    found = open_writer(output, plan.volume, texture.workers).probe(voxels)
    if found is None:
        return 0, 0.0
    colors, rounding = found
    expected = from_srgb(np.stack([evaluate_voxel(plan, texture, voxel) for voxel in voxels]), output.colorspace)
    expected = expected.clip(*bounds(output))
    differences = np.abs(colors - expected) / np.maximum(1, np.abs(expected))
    return len(voxels), float(np.maximum(differences.max() - rounding, 0.0))


def evaluate_voxel(plan: Plan, texture: Texture, voxel: npt.NDArray[np.int64]) -> FloatArray:
    """The colour [3] of voxel (x, y, z) of a plan, sRGB-encoded, by itself."""
    fine = plan.fine
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
