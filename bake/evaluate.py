"""The colours of a plan: its texture on its grid, with as many samples per voxel as it asks for."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from solidgrain.bake.color import to_linear, to_srgb
from solidgrain.bake.plan import Plan
from solidgrain.bake.writers import FloatArray
from solidgrain.runtime import Texture


def check_place(plan: Plan, texture: Texture) -> None:
    """Raises EvaluationError if the sampler cannot reach the grid, or cannot tile it."""
    texture.grid_start(**_grid(plan))


def _grid(plan: Plan) -> dict[str, Any]:
    """The grid of samples as the runtime's arguments."""
    width, height, depth = (plan.fine * extent for extent in plan.size)
    spacing = [step / plan.fine for step in plan.spacing]
    place = {"origin": plan.origin, "spacing": spacing, "tile": plan.tile, "transform": plan.transform}
    return {"shape": (depth, height, width), **place}


def evaluate(plan: Plan, texture: Texture, first: int, stop: int) -> Iterator[tuple[int, FloatArray]]:
    """Slices first .. stop - 1 as slabs, sRGB-encoded: pairs of first slice and [<= plan.slab, y, x, 3]."""
    fine, grid = plan.fine, _grid(plan)
    shape = grid.pop("shape")
    slabs = texture.slabs(shape, plan.seed, slab=fine * plan.slab, slices=(fine * first, fine * stop), **grid)
    return slabs if fine == 1 else ((z // fine, _averaged(slab, fine, texture)) for z, slab in slabs)


def _averaged(slab: FloatArray, fine: int, texture: Texture) -> FloatArray:
    """The mean of each voxel's fine³ samples, in linear light, as a sensor would take it."""
    depth, height, width = (extent // fine for extent in slab.shape[:3])
    mean = np.empty((depth, height, width, 3), np.float32)

    def average(z: int) -> None:
        samples = to_linear(slab[fine * z : fine * (z + 1)]).reshape(fine, height, fine, width, fine, 3)
        mean[z] = to_srgb(samples.mean((0, 2, 4), dtype=np.float32))

    texture.workers.run([partial(average, z) for z in range(depth)])
    return mean
