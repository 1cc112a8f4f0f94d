"""Can VTK draw here? Without an OpenGL library VTK does not raise, it takes the whole process down: ask in another one."""

from __future__ import annotations

import os
import subprocess
import sys

from solidgrain.runtime.errors import ViewError

PROBE = (
    "import pyvista; p = pyvista.Plotter(off_screen=True, window_size=(16, 16)); p.add_mesh(pyvista.Cube()); p.screenshot(None)"
)
REMEDY = "apt install libegl1 libegl-mesa0 libgl1-mesa-dri (or libosmesa6)"


def off_screen_environment() -> None:
    """Without a display, send VTK straight to EGL instead of letting it complain about the X server first."""
    if not has_display():
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")


def has_display() -> bool:
    """Whether there may be one. VTK opens windows by X11, and not on Wayland alone."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY"))


def opengl_error() -> str | None:
    """Why off-screen rendering does not work in a process like this one, or None if it does."""
    off_screen_environment()
    try:
        probe = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, timeout=120, check=False)
    except subprocess.TimeoutExpired:
        return "VTK did not finish a test picture within two minutes"
    if probe.returncode < 0 or probe.returncode >= 128:
        return "VTK crashed on a test picture: no OpenGL library"
    if probe.returncode:
        return probe.stderr.strip().splitlines()[-1] if probe.stderr.strip() else f"exit code {probe.returncode}"
    return None


def require_opengl() -> None:
    """Raises ViewError, with the remedy, where VTK would crash."""
    if reason := opengl_error():
        raise ViewError(f"cannot draw: {reason}; {REMEDY}")
