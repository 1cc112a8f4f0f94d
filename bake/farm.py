"""What farms and clusters need of a plan: names that hold in any working folder, and how many shares to make of it."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from solidgrain.bake.plan import Plan

MOST_SHARDS = 64  # by default


def anywhere(plan: Plan) -> Plan:
    """The plan with absolute paths: the same work, from any working folder."""
    outputs = tuple(replace(output, path=output.path.absolute()) for output in plan.outputs)
    source = os.fspath(Path(plan.source).absolute()) if Path(plan.source).exists() else plan.source  # an embedded name
    bundle = None if plan.bundle is None else os.fspath(Path(plan.bundle).absolute())
    return replace(plan, outputs=outputs, source=source, bundle=bundle)


def shard_count(plan: Plan, asked: int | None) -> int:
    """How many shards: what was asked for, or one per slab up to `MOST_SHARDS`; never more than there are slabs."""
    slabs = -(-plan.size[2] // plan.slab)
    return min(asked or MOST_SHARDS, slabs)
