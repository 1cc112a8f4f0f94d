"""Looking at volumes with pyvista: orthogonal slices, the volume itself, a threshold, or its outer faces."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from solidgrain.bake.color import LINEAR, LUMA, SRGB, quantize, to_srgb
from solidgrain.bake.messages import first_line, warn
from solidgrain.bake.opengl import has_display, off_screen_environment, require_opengl
from solidgrain.runtime.errors import ViewError
from solidgrain.runtime.files import DAMAGED_ARRAY, map_array, temporary_name

if TYPE_CHECKING:
    import pyvista

NO_DISPLAY = "no display to open a window on; use --screenshot FILE.png"
WITHOUT_A_WINDOW = ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow")  # what VTK falls back to


def read_volume(path: Path) -> pyvista.ImageData:
    """A volume with point data `rgb` (uint8, sRGB-encoded), from `.vti` (or what else pyvista reads) or `.npy` [z, y, x, 3].

    Floats are colours from 0 to 1, unsigned whole numbers from 0 to the largest of their type; sRGB-encoded, unless the field
    data `color_encoding` says otherwise.
    Raises ViewError if the file is missing, unreadable or holds no colours.
    """
    import pyvista

    if path.suffix.lower() == ".npy":
        return _from_array(path)
    pyvista.vtk_verbosity("off")  # VTK prints pages about a damaged file; the error below says it in a line
    try:
        image = pyvista.read(os.fspath(path))
    except Exception as error:  # VTK's readers raise several unrelated types
        raise ViewError(f"{path}: not readable as a volume ({first_line(error)})") from error
    if not isinstance(image, pyvista.ImageData) or "rgb" not in image.point_data:
        raise ViewError(f"{path}: expected image data with a point array 'rgb', found {_contents(image)}")
    colors = np.asarray(image.point_data["rgb"])
    if colors.ndim != 2 or colors.shape[1] not in (3, 4) or colors.dtype.kind not in "fu":
        raise ViewError(
            f"{path}: 'rgb' is {colors.dtype} of shape {colors.shape}, expected 3 or 4 floats or unsigned whole numbers a point"
        )
    encoding = str(image.field_data["color_encoding"][0]) if "color_encoding" in image.field_data else SRGB
    image.point_data["rgb"] = _bytes(path, colors[:, :3], encoding)
    return image


def _contents(image: Any) -> str:
    names = list(getattr(image, "point_data", {}).keys())
    return f"{type(image).__name__} with {', '.join(names) or 'no point arrays'}"


def _from_array(path: Path) -> pyvista.ImageData:
    import pyvista

    try:
        array = map_array(path)
    except DAMAGED_ARRAY as error:
        raise ViewError(f"{path}: not readable as a NumPy array") from error
    if array.ndim != 4 or array.shape[-1] != 3 or array.size == 0 or array.dtype.kind not in "fu":
        raise ViewError(
            f"{path}: {array.dtype} of shape {array.shape}, expected floats or unsigned whole numbers, [z, y, x, 3]"
        )
    image = pyvista.ImageData(dimensions=array.shape[2::-1], origin=(0.5, 0.5, 0.5))
    image.point_data["rgb"] = _bytes(path, array.reshape(-1, 3), SRGB)
    return image


def _bytes(path: Path, colors: npt.NDArray[Any], encoding: str) -> npt.NDArray[np.uint8]:
    """Colours [P, 3] as a screen takes them. Raises ViewError for what is no number."""
    if not np.isfinite(colors).all():
        raise ViewError(f"{path}: holds NaN or infinity, expected colours from 0 to 1")
    if encoding not in (SRGB, LINEAR):
        warn(f"{path}: its colours are {encoding}, and are shown as if they were {SRGB}")
    if colors.dtype == np.uint8 and encoding != LINEAR:
        return colors
    largest = np.iinfo(colors.dtype).max if colors.dtype.kind == "u" else 1
    shares = np.clip(colors, 0, largest) * np.float32(1 / largest)
    encoded = to_srgb(shares.astype(np.float32)) if encoding == LINEAR else shares
    return quantize(encoded, np.uint8).astype(np.uint8, copy=False)


def show(path: Path, mode: str = "slices", screenshot: Path | None = None, size: tuple[int, int] = (1024, 768)) -> None:
    """Show a volume in a window, or draw it off screen into a PNG.

    Raises ViewError where there is no OpenGL library, and for a window where no display answers.
    """
    if not path.is_file():
        raise ViewError(f"{path}: no such file; expected a volume made by solidgrain bake (.vti or .npy)")
    if screenshot is None and not has_display():
        raise ViewError(NO_DISPLAY)
    if screenshot is not None and (screenshot.suffix.lower() != ".png" or not screenshot.parent.is_dir()):
        raise ViewError(f"--screenshot {screenshot}: expected a name that ends in .png in a folder that exists")
    image = read_volume(path)
    require_opengl()
    off_screen_environment()
    import pyvista

    plotter: Any = pyvista.Plotter(off_screen=screenshot is not None, window_size=list(size))
    if screenshot is None and plotter.render_window.GetClassName() in WITHOUT_A_WINDOW:
        plotter.close()
        raise ViewError(f"{NO_DISPLAY} (DISPLAY is {os.environ.get('DISPLAY')}, which does not answer)")
    plotter.set_background("#1f1f1f")
    _add(plotter, _on_stage(image), mode, interactive=screenshot is None)
    plotter.add_axes()
    plotter.camera_position = "iso"
    if screenshot is None:
        plotter.show(title=f"solidgrain: {path.name}")
        return
    temporary = temporary_name(screenshot)
    try:
        plotter.screenshot(os.fspath(temporary))
        os.replace(temporary, screenshot)
    except OSError as error:
        raise ViewError(f"--screenshot {screenshot}: cannot write ({error.strerror})") from error
    finally:
        temporary.unlink(missing_ok=True)
        plotter.close()


def _on_stage(image: pyvista.ImageData) -> pyvista.ImageData:
    """The volume at the origin, with voxels of about 1: VTK draws in float32, and steps through a volume by so much."""
    staged: pyvista.ImageData = image.copy(deep=False)
    staged.origin = (0.0, 0.0, 0.0)
    staged.spacing = tuple(step / max(image.spacing) for step in image.spacing)
    return staged


def _add(plotter: Any, image: pyvista.ImageData, mode: str, interactive: bool) -> None:
    """Put the volume on the stage. In a window, slices and threshold have widgets to move them."""
    if mode == "slices":
        if interactive:
            plotter.add_mesh_slice_orthogonal(image, scalars="rgb", rgb=True)
        else:
            plotter.add_mesh(image.slice_orthogonal(), scalars="rgb", rgb=True, lighting=False)
    elif mode == "volume":
        rgba = np.column_stack([image.point_data["rgb"], luma(image)])  # VTK takes the opacity from the fourth component
        image.point_data["rgba"] = rgba
        plotter.add_volume(image, scalars="rgba", opacity_unit_distance=4)
    elif mode == "threshold":
        image.point_data["luma"] = luma(image)
        middle = float(np.median(image.point_data["luma"]))

        def keep_brighter(level: float) -> None:
            kept = image.threshold(level, scalars="luma", all_scalars=True)
            if kept.n_cells:
                plotter.add_mesh(kept, scalars="rgb", rgb=True, name="kept", reset_camera=False)
            else:
                plotter.remove_actor("kept")

        keep_brighter(middle)
        if interactive:
            plotter.add_slider_widget(keep_brighter, rng=(0, 255), value=middle, title="luma", color="white")
    else:
        surface = image.extract_surface(algorithm="dataset_surface")
        if not surface.n_points:
            raise ViewError(f"--mode block: a row of {image.n_points} voxels has no surface; try --mode slices")
        plotter.add_mesh(surface, scalars="rgb", rgb=True)


def luma(image: pyvista.ImageData) -> npt.NDArray[np.uint8]:
    """Rec.709 luma of the colours."""
    values: npt.NDArray[np.uint8] = (np.asarray(image.point_data["rgb"]) @ LUMA).astype(np.uint8)
    return values
