"""Interrupts that wait: what must not stop halfway ends first."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

# Farms stop jobs with SIGTERM, and a terminal or a connection that closes sends SIGHUP (Windows has none).
STOPS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


def on_stop(handler: Callable[[int, FrameType | None], None] | signal.Handlers) -> None:
    """Have these signals call a handler, but for those that this process ignores: nohup asks for that.

    Raises ValueError in another thread than the one that signals interrupt.
    """
    for number in STOPS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, handler)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C, SIGTERM and SIGHUP wait until this is left, if this is the thread that they interrupt."""
    waiting: list[int] = []
    former: dict[int, Any] = {}
    with suppress(ValueError):  # not the thread that they interrupt, whatever `threading` takes for the main one
        for number in (signal.SIGINT, *STOPS):
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
