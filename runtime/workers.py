"""A fixed pool of threads for one texture: evaluation and writers share it, so that a bake never runs more than it may."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, CancelledError, ThreadPoolExecutor, wait
from functools import partial
from typing import TypeVar

Task = Callable[[], None]
T = TypeVar("T")


def usable_threads() -> int:
    """How many processors this process may use: its affinity mask, not the machine's count."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Workers:
    """Runs short tasks, several at a time. The work is in native code that lets go of the interpreter.

    `asked` threads of 0 are as many as the process may use.
    """

    def __init__(self, asked: int, pool: _Pool | None = None) -> None:
        self.asked = asked
        self._pool = pool or _Pool(asked or usable_threads())
        self._cancelled = False

    @property
    def count(self) -> int:
        return self._pool.count

    def share(self) -> Workers:
        """The same threads, to be cancelled on their own."""
        return Workers(self.asked, self._pool)

    def run(self, tasks: Sequence[Task]) -> None:
        """All tasks, in any order. The first error, or an interrupt, stops those that have not begun and is raised."""
        executor, futures, failed = self._pool.executor(), [], threading.Event()
        try:
            for task in tasks:
                futures.append(executor.submit(self._call, task, failed))
            wait(futures, return_when=FIRST_EXCEPTION)
            for future in futures:
                if future.done():
                    future.result()
        finally:
            wait([future for future in futures if not future.cancel()])

    def map(self, function: Callable[[int], T], count: int) -> list[T]:
        """function(0), ..., function(count - 1), several at a time, in order."""
        found: dict[int, T] = {}

        def call(k: int) -> None:
            found[k] = function(k)

        self.run([partial(call, k) for k in range(count)])
        return [found[k] for k in range(count)]

    def cancel(self) -> None:
        """Skip what has not begun, for good: whoever waits in `run`, or calls it later, gets a CancelledError."""
        self._cancelled = True

    def _call(self, task: Task, failed: threading.Event) -> None:
        """A task, unless one before it has failed: its thread is the first to know, long before whoever waits in `run`."""
        if self._cancelled:
            raise CancelledError
        if not failed.is_set():
            try:
                task()
            except BaseException:
                failed.set()
                raise


class _Pool:
    """An executor that survives a fork: threads do not. It starts its threads when they are needed."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._make()

    def executor(self) -> ThreadPoolExecutor:
        if self._process != os.getpid():
            self._make()
        return self._executor

    def _make(self) -> None:
        self._executor, self._process = ThreadPoolExecutor(self.count, thread_name_prefix="solidgrain"), os.getpid()
