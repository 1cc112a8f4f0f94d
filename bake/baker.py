"""Running a plan: slabs are evaluated in order and handed to every writer, one slab ahead of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from solidgrain.bake.plan import Plan
from solidgrain.bake.writers import FloatArray, Writer, open_writer
from solidgrain.runtime import Texture
from solidgrain.runtime.errors import BakeError
from solidgrain.runtime.workers import Workers

OnSlice = Callable[[int, int], None]  # slices done, slices in all


@dataclass(frozen=True)
class Baked:
    """What a bake left behind."""

    files: list[Path]
    seconds: float
    evaluation_seconds: float  # of them, in the sampler


def bake(plan: Plan, texture: Texture, on_slice: OnSlice = lambda done, total: None) -> Baked:
    """Evaluate a plan and write its outputs, all of them or none.

    Raises BakeError if a file cannot be written, EvaluationError if the texture returns NaN; then, as after an interrupt,
    nothing is left behind.
    """
    writers: list[Writer] = []
    workers = texture.workers.share()
    started = time.monotonic()
    try:
        for output in plan.outputs:
            writers.append(open_writer(output, plan.volume, workers))
        evaluation = _feed(plan, texture, writers, workers, on_slice)
        for writer in writers:
            writer.finish()
        files = [path for writer in writers for path in writer.commit()]
    except OSError as error:
        raise BakeError(f"cannot write {_culprit(error, plan)}: {error.strerror}; free space or bake elsewhere") from error
    finally:
        for writer in writers:
            writer.abort()  # nothing to do for those that have committed
    return Baked(files, time.monotonic() - started, evaluation)


def _culprit(error: OSError, plan: Plan) -> str:
    """The file that an error is about, or the outputs where the system does not say."""
    return str(error.filename2 or error.filename or ", ".join(str(output.path) for output in plan.outputs))


def _feed(plan: Plan, texture: Texture, writers: Sequence[Writer], workers: Workers, on_slice: OnSlice) -> float:
    """All slabs to all writers: one slab is written while the next is evaluated. Returns the seconds spent in the sampler.

    `workers` are the writers': they are cancelled if anything goes wrong.
    """
    depth, evaluation = plan.volume.shape[0], 0.0
    writing: Future[None] | None = None

    def write(z: int, slab: FloatArray) -> None:
        for writer in writers:
            writer.write(z, slab)
        on_slice(z + len(slab), depth)

    with ThreadPoolExecutor(1, thread_name_prefix="solidgrain-writers") as hand:
        try:
            waiting_since = time.monotonic()
            slabs = texture.slabs(
                plan.volume.shape, plan.seed, origin=plan.origin, spacing=plan.spacing, tile=plan.tile, slab=plan.slab
            )
            for z, slab in slabs:
                evaluation += time.monotonic() - waiting_since
                if writing is not None:
                    writing.result()
                writing = hand.submit(write, z, slab)
                del slab  # or it would live while the next but one is made
                waiting_since = time.monotonic()
            if writing is not None:
                writing.result()
        except BaseException:
            workers.cancel()  # or leaving would wait for all that they have begun
            raise
    return evaluation
