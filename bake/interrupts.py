"""Interrupts that wait: what must not stop halfway ends first."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C and SIGTERM wait until this is left, if this is the thread that they interrupt."""
    waiting: list[int] = []
    former: dict[int, Any] = {}
    with suppress(ValueError):  # not the thread that they interrupt, whatever `threading` takes for the main one
        for number in (signal.SIGINT, signal.SIGTERM):
            # None: an application around Python handles it, in a way that Python could not put back
            if signal.getsignal(number) is not None:
                former[number] = signal.signal(number, lambda received, frame: waiting.append(received))
    try:
        yield
    finally:
        for handled, handler in former.items():
            signal.signal(handled, handler)
        if waiting:
            signal.raise_signal(waiting[0])
