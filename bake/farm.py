"""What farms and clusters need of a plan: names that hold in any working folder, and how many shares to make of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from solidgrain.bake.plan import Plan, located

MOST_SHARDS = 64  # by default


def anywhere(plan: Plan) -> Plan:
    """The plan with absolute paths: the same work, from any working folder."""
    outputs = tuple(replace(output, path=output.path.absolute()) for output in plan.outputs)
    return replace(plan, outputs=outputs, source=located(plan.source), bundle=plan.bundle and located(plan.bundle))


def seen_from(folder: Path, plan: Plan) -> Plan:
    """`anywhere`, but what lies in `folder` goes by its name alone: it may be moved, or be seen elsewhere.

    A texture or bundle there is `./name`, for `name` may be an embedded one's. That is for a plan in a file of this folder;
    `load_plan` undoes it.
    """
    plan, folder = anywhere(plan), folder.resolve()

    def near(source: str) -> str:
        path = Path(source)
        return f"./{path.name}" if path.is_absolute() and path.parent.resolve() == folder else source

    outputs = (replace(one, path=Path(one.path.name)) if one.path.parent.resolve() == folder else one for one in plan.outputs)
    return replace(plan, outputs=tuple(outputs), source=near(plan.source), bundle=plan.bundle and near(plan.bundle))


def shard_count(plan: Plan, asked: int | None) -> int:
    """How many shards: what was asked for, or one per slab up to `MOST_SHARDS`; never more than there are slabs."""
    slabs = -(-plan.size[2] // plan.slab)
    return min(asked or MOST_SHARDS, slabs)
