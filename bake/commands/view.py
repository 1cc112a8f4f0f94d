"""`solidgrain view`: a volume on screen, or on a PNG."""

from __future__ import annotations

import argparse
import signal
from pathlib import Path

from solidgrain.bake.interrupts import on_stop

MODES = ("slices", "volume", "threshold", "block")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("file", type=Path, metavar="FILE", help="a .vti or .npy volume")
    add("--mode", choices=MODES, default="slices", help="what to show (slices)")
    add("--screenshot", type=Path, metavar="OUT.png", help="draw off screen instead of opening a window")


def run(arguments: argparse.Namespace) -> int:
    from solidgrain.bake.view import show

    signal.signal(signal.SIGINT, signal.SIG_DFL)  # VTK's event loop never returns to Python's own handlers
    on_stop(signal.SIG_DFL)
    show(arguments.file, arguments.mode, arguments.screenshot)
    return 0
