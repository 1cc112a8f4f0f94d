"""A fixed pool of threads for one texture: evaluation and writers share it, so that a bake never runs more than it may."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, CancelledError, ThreadPoolExecutor, wait

Task = Callable[[], None]


class Workers:
    """Runs short tasks, several at a time. The work is in native code that lets go of the interpreter."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0
        self._cancelled = 0  # how often

    def run(self, tasks: Sequence[Task]) -> None:
        """All tasks, in any order. The first error, or an interrupt, stops those that have not begun and is raised."""
        if len(tasks) == 1:
            tasks[0]()
            return
        futures = [self._executor().submit(self._call, task, self._cancelled) for task in tasks]
        try:
            wait(futures, return_when=FIRST_EXCEPTION)
            for future in futures:
                if future.done():
                    future.result()
        finally:
            for future in futures:
                future.cancel()
            wait(futures)

    def cancel(self) -> None:
        """Skip what has not begun: whoever waits in `run`, in whichever thread, gets a CancelledError."""
        self._cancelled += 1

    def _call(self, task: Task, cancelled: int) -> None:
        if cancelled != self._cancelled:
            raise CancelledError
        task()

    def _executor(self) -> ThreadPoolExecutor:
        if self._pool is None or self._process != os.getpid():  # threads do not survive a fork
            self._pool, self._process = ThreadPoolExecutor(self.count, thread_name_prefix="solidgrain"), os.getpid()
        return self._pool
