"""Running a plan: slabs are evaluated in order and handed to every writer, at most two slabs ahead of them.

What writers make of the slabs gathers in a staging folder beside each output. When all slabs are there the writers assemble
their files, and only when all files of all outputs are whole are they put in place. A bake that was killed takes up what the
stagings hold; a shard stops after its slabs, and `merge` does the rest.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from solidgrain.bake.evaluate import evaluate
from solidgrain.bake.interrupts import uninterrupted
from solidgrain.bake.manifest import forget_manifest, place_manifest, remove_stale, stage_manifest
from solidgrain.bake.plan import Plan
from solidgrain.bake.staging import Staging, open_staging
from solidgrain.bake.writers import FloatArray, Output, Writer, open_writer
from solidgrain.runtime import Texture
from solidgrain.runtime.errors import BakeError
from solidgrain.runtime.workers import Workers

AHEAD = 2  # slabs that wait for the disk, at most, while the next is evaluated

OnSlice = Callable[[int, int], None]  # slices done, slices in all; the first call says what was there
Notes = list[dict[str, Any]]  # of complete files: see `Staging.finish`
Shard = tuple[int, int]  # slices first .. stop - 1


@dataclass(frozen=True)
class Baked:
    """What a bake left behind."""

    files: list[Path]
    seconds: float
    evaluation_seconds: float = 0.0  # of them, in the sampler
    reused_slices: int = 0  # that an earlier bake had evaluated


@dataclass(frozen=True)
class Target:
    """One output while it is baked."""

    output: Output
    writer: Writer
    staging: Staging

    @property
    def done(self) -> dict[int, int]:
        """The slabs that are written: first slice and number of slices."""
        return {record.z: record.slices for record in self.staging.records}


def bake(
    plan: Plan,
    texture: Texture,
    on_slice: OnSlice = lambda done, total: None,
    *,
    resume: bool = False,
    shard: Shard | None = None,
) -> Baked:
    """Evaluate a plan and write its outputs, all of them or none.

    With `resume`, what an earlier bake of the same plan has left is taken up, and what this one leaves when it fails stays;
    otherwise nothing is left behind. A `shard` bakes slices first .. stop - 1 and leaves the rest to others and to `merge`.
    Raises BakeError if a file cannot be written or another process is baking it, EvaluationError if the texture returns NaN.
    """
    started, workers, evaluation = time.monotonic(), texture.workers.share(), 0.0
    first, stop = shard or (0, plan.size[2])
    if first == stop:
        return Baked([], 0.0)  # there are more shards than slabs
    with _targets(plan, workers, shard, keep=resume or shard is not None) as targets:
        finished = _finished(targets)
        reused = stop - first
        if finished is None:
            for target in targets:
                target.staging.restore()
            reused = min(sum(slices for z, slices in target.done.items() if first <= z < stop) for target in targets)
            evaluation = _feed(plan, texture, targets, workers, (first, stop), on_slice)
        files = [] if shard else _put_in_place(plan, targets, finished or _finish(targets))
    return Baked(files, time.monotonic() - started, evaluation, reused)


def merge(plan: Plan, workers: Workers) -> Baked:
    """Complete a plan whose shards have all been baked. Raises BakeError that names the slices that are missing."""
    started = time.monotonic()
    with _targets(plan, workers, None, keep=True) as targets:
        finished = _finished(targets)
        if finished is None:
            for target in targets:
                target.staging.restore()
                if gaps := target.staging.missing():
                    runs = ", ".join(f"{first} to {stop - 1}" for first, stop in gaps)
                    raise BakeError(f"{target.output.path}: slices {runs} are missing or damaged; bake their shards first")
        files = _put_in_place(plan, targets, finished or _finish(targets))
    return Baked(files, time.monotonic() - started, reused_slices=plan.size[2])


@contextmanager
def _targets(plan: Plan, workers: Workers, shard: Shard | None, keep: bool) -> Iterator[list[Target]]:
    """The outputs of a plan, each with its locked staging; what is there and what an error leaves is kept, or forgotten.

    An OSError becomes a BakeError that names the file.
    """
    targets: list[Target] = []
    try:
        for output in plan.outputs:
            writer = open_writer(output, plan.volume, workers)
            staging = open_staging(output.path, plan.work(output), plan.size[2], writer.reserved, shard, fresh=not keep)
            targets.append(Target(output, writer, staging))
            staging.keep_plan(plan)
        yield targets
    except BaseException as error:
        for target in targets:
            if not keep and not target.staging.in_place:
                target.staging.clear()
        if isinstance(error, OSError):
            culprit = _culprit(error, plan)
            raise BakeError(f"cannot write {culprit}: {error.strerror}; free space or bake elsewhere") from error
        raise
    finally:
        for target in targets:
            target.staging.close()


def _culprit(error: OSError, plan: Plan) -> str:
    """The file that an error is about, or the outputs where the system does not say."""
    return str(error.filename2 or error.filename or ", ".join(str(output.path) for output in plan.outputs))


def _finished(targets: Sequence[Target]) -> list[Notes] | None:
    """The complete files of all outputs, if an earlier bake came so far."""
    notes = [target.staging.finished() for target in targets]
    found = [lines for lines in notes if lines is not None]
    return found if targets and len(found) == len(notes) else None


def _finish(targets: Sequence[Target]) -> list[Notes]:
    """Assemble the files of all outputs. From here on, a killed bake has only to put them in place."""
    return [target.staging.finish(target.writer.assemble(target.staging)) for target in targets]


def _put_in_place(plan: Plan, targets: Sequence[Target], finished: Sequence[Notes]) -> list[Path]:
    """Give all files their names. An interrupt waits; an error or a kill leaves the stagings for `resume`."""
    files: list[Path] = []
    with uninterrupted():
        for target, lines in zip(targets, finished, strict=True):  # all that needs space comes before the first name
            stage_manifest(plan, target.output, lines, target.staging.folder)
        for target in targets:
            target.staging.in_place = True
        for target, lines in zip(targets, finished, strict=True):
            replaced = forget_manifest(target.output)
            files += target.staging.commit(lines)
            place_manifest(target.output, target.staging.folder)
            remove_stale(replaced, target.output, lines)
            target.staging.clear()
    return files


def _feed(plan: Plan, texture: Texture, targets: Sequence[Target], workers: Workers, shard: Shard, on_slice: OnSlice) -> float:
    """The slabs that any output lacks, to those that lack them: they are written while the next is evaluated.

    Returns the seconds spent in the sampler. `workers` are the writers': they are cancelled if anything goes wrong.
    """
    evaluation = 0.0
    writing: deque[Future[None]] = deque()
    done = [target.done for target in targets]
    wanted = [z for z in range(*shard, plan.slab) if any(z not in slabs for slabs in done)]
    total, left = shard[1] - shard[0], sum(min(plan.slab, shard[1] - z) for z in wanted)

    def write(z: int, slab: FloatArray) -> None:
        nonlocal left
        for target, slabs in zip(targets, done, strict=True):
            if z not in slabs:
                target.staging.append(z, len(slab), target.writer.encode(z, slab))
        left -= len(slab)
        on_slice(total - left, total)

    on_slice(total - left, total)
    with ThreadPoolExecutor(1, thread_name_prefix="solidgrain-writers") as hand:
        try:
            for first, stop in _runs(wanted, plan.slab, shard[1]):
                waiting_since = time.monotonic()
                for z, slab in evaluate(plan, texture, first, stop):
                    evaluation += time.monotonic() - waiting_since
                    if len(writing) == AHEAD:
                        writing.popleft().result()
                    writing.append(hand.submit(write, z, slab))
                    del slab  # or it would live while the next but one is made
                    waiting_since = time.monotonic()
            for one in writing:
                one.result()
        except BaseException:
            workers.cancel()  # or leaving would wait for all that they have begun
            raise
    return evaluation


def _runs(slabs: Sequence[int], thickness: int, stop: int) -> Iterator[Shard]:
    """Slabs that follow each other, joined: slices (first, stop)."""
    first = last = None
    for z in slabs:
        if first is None or last is None:
            first = z
        elif z != last + thickness:
            yield first, last + thickness
            first = z
        last = z
    if first is not None and last is not None:
        yield first, min(last + thickness, stop)
