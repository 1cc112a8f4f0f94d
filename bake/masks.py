"""Masks of blends in space from files: `.npy`, and image data that VTK reads."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from solidgrain.bake.messages import first_line
from solidgrain.runtime.arguments import Vector
from solidgrain.runtime.errors import BakeError, UsageError
from solidgrain.runtime.files import DAMAGED_ARRAY, map_array


class MaskFile(NamedTuple):
    """A volume [z, y, x], and where the file says that it is (x, y, z), if it does."""

    values: npt.NDArray[Any]
    origin: Vector | None = None
    spacing: Vector | None = None


def read_mask(path: Path) -> MaskFile:
    """A volume of weights from `.npy`, mapped into memory, or from `.vti`. Raises UsageError or BakeError.

    A `.vti` holds one number per point, which is the middle of a voxel, or per cell, which is the voxel.
    """
    if path.suffix.lower() not in (".npy", ".vti"):
        raise UsageError(f"--mask {path}: expected a name that ends in .npy or .vti")
    if not path.is_file():
        raise BakeError(f"--mask {path}: no such file")
    if path.suffix.lower() == ".vti":
        return _image_data(path)
    try:
        return MaskFile(map_array(path))
    except DAMAGED_ARRAY as error:
        raise BakeError(f"--mask {path}: not readable as a NumPy array") from error


def _image_data(path: Path) -> MaskFile:
    import pyvista

    pyvista.vtk_verbosity("off")  # VTK prints pages about a damaged file; the error below says it in a line
    try:
        image: Any = pyvista.read(os.fspath(path))
    except Exception as error:  # VTK's readers raise several unrelated types
        raise BakeError(f"--mask {path}: not readable as image data ({first_line(error)})") from error
    arrays = [*image.point_data.items(), *image.cell_data.items()]
    if not isinstance(image, pyvista.ImageData) or len(arrays) != 1 or np.ndim(arrays[0][1]) != 1:
        names = ", ".join(f"{name} {np.shape(array)}" for name, array in arrays) or "no arrays"
        raise BakeError(f"--mask {path}: expected image data with one array of one number per voxel, found {names}")
    if not np.array_equal(image.direction_matrix, np.eye(3)):
        raise BakeError(f"--mask {path}: its axes are turned, expected x, y and z; resample it")
    at_points = len(image.point_data) == 1
    columns, rows, planes = (extent if at_points else max(1, extent - 1) for extent in image.dimensions)
    x, y, z = (  # the origin is where index 0 would be, and a part of a larger volume begins elsewhere
        float(start) + (first - 0.5 * at_points) * step
        for start, first, step in zip(image.origin, image.extent[::2], image.spacing, strict=True)
    )
    spacing = tuple(float(step) for step in image.spacing)
    return MaskFile(np.array(arrays[0][1]).reshape(planes, rows, columns), (x, y, z), (spacing[0], spacing[1], spacing[2]))
