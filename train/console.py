"""What `train` and `adapt` have in common at a terminal: a progress line, and stopping when asked to."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from types import FrameType
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from solidgrain.bake.interrupts import on_stop
from solidgrain.bake.messages import tell, warn

if TYPE_CHECKING:
    from solidgrain.train.settings import Budget

BETWEEN = 30  # seconds, of the lines in a log


class Dated(Protocol):
    """A report of where it is."""

    @property
    def iteration(self) -> int: ...

    @property
    def seconds(self) -> float: ...


Report = TypeVar("Report", bound=Dated)


class StopRequest:
    """Ctrl-C, SIGTERM or SIGHUP asks the loop to finish its iteration and save; a second one stops at once."""

    def __init__(self, quiet: bool) -> None:
        self._requested, self._quiet = False, quiet
        signal.signal(signal.SIGINT, self._request)
        on_stop(self._request)

    def requested(self) -> bool:
        return self._requested

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self._requested:
            raise KeyboardInterrupt
        self._requested = True
        if not self._quiet:
            tell("\nfinishing this iteration; once more to stop at once")


class Progress(Generic[Report]):
    """One line that rewrites itself on a terminal, a line every so often in a log.

    `describe` makes it of a report, the share of the budget that is spent, and the seconds that are left of it at this pace.
    """

    def __init__(self, budget: Budget, quiet: bool, describe: Callable[[Report, float, float], str]) -> None:
        self.budget, self.quiet, self.describe = budget, quiet, describe
        self.terminal, self.printed, self.open = sys.stderr.isatty(), -2.0 * BETWEEN, False

    def show(self, report: Report) -> None:
        if self.quiet or (not self.terminal and report.seconds - self.printed < BETWEEN):
            return
        self.printed = report.seconds
        done = self.budget.progress(report.iteration, report.seconds)
        line = self.describe(report, done, report.seconds * max(1 - done, 0) / done)
        print(f"\r{line}  " if self.terminal else line, end="" if self.terminal else "\n", file=sys.stderr, flush=True)
        self.open = self.terminal

    def warn(self, warning: str) -> None:
        """A line that stays, whether quiet or not."""
        self.end()
        warn(warning)

    def end(self) -> None:
        """What is printed next begins a line of its own."""
        if self.open:
            print(file=sys.stderr)
        self.open = False
