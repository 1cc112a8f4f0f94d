"""`.exr`: a stack of OpenEXR slices, one per z, by default half-float and linear Rec.709.

Row r of a file is y = r, its top row y = 0; column c is x = c; file number k (from `start`) is z = k - start. (Stacks along
another axis are the same for a turned volume, see orient.py.) Written by the OpenEXR package, scanlines; ZIP by exr_zip.py. No
file has a time stamp, so equal plans give equal bytes. Attributes: `colorInteropID` and `chromaticities` say the encoding;
`solidgrain:*` say which slice of which texture a file is.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from solidgrain.bake.color import LINEAR, SRGB, as_floats, luma, to_linear
from solidgrain.bake.frames import PATTERN, frame_paths
from solidgrain.bake.store import Encoded, Finished, Store
from solidgrain.bake.writers.base import ROUNDING, FloatArray, Option, Output, Volume, Writer
from solidgrain.bake.writers.exr_zip import LINES, deflated, isal_zlib
from solidgrain.runtime.errors import UsageError
from solidgrain.runtime.workers import Workers

REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # xy of red, green, blue, white (ITU-R BT.709)
SOURCES = ("r", "g", "b", "luma", "one")
TYPES = {"half": np.float16, "float": np.float32}
COMPRESSIONS = ("none", "zip", "zips", "piz", "dwaa")
OPTIONS = (
    Option("type", "half", "of the channels", tuple(TYPES)),
    Option("compression", "zip", "dwaa is lossy", COMPRESSIONS),
    Option("channels", "R=r,G=g,B=b", "what each holds: r, g, b, one, luma (of linear light), as in R=r,G=g,B=b,height=luma"),
    Option("axis", "z", "across which the slices lie", ("x", "y", "z")),
    Option("start", 1, "number of the first slice"),
)


class ExrStack(Writer):
    """Each slice is a whole file as soon as it is encoded."""

    def __init__(self, output: Output, volume: Volume, workers: Workers) -> None:
        import OpenEXR

        if output.options["compression"] in LINES:
            isal_zlib()  # if it is missing, this is told before a voxel is evaluated
        super().__init__(output, volume, workers)
        OpenEXR.set_global_thread_count(0)  # one slice per thread of ours beats its own pool
        self.paths = files(output, volume)
        self.channels = parse_channels(output)

    def encode(self, z: int, slab: FloatArray) -> Encoded:
        slices = self.workers.map(lambda k: self._encode_slice(z + k, slab[k]), len(slab))
        return Encoded(files={path.name: content for path, content in zip(self.paths[z:], slices, strict=False)})

    def _encode_slice(self, z: int, rgb: FloatArray) -> bytes:
        import OpenEXR

        file, compression = io.BytesIO(), str(self.output.options["compression"])
        OpenEXR.File(slice_header(self.output, self.volume, z), self._channels(rgb)).write(file)
        return deflated(file.getvalue(), compression) if compression in LINES else file.getvalue()

    def _channels(self, srgb: FloatArray) -> dict[str, npt.NDArray[np.generic]]:
        """What the file's channels hold, [y, x] each; plain RGB in one piece, which is faster."""
        dtype, rgb = TYPES[str(self.output.options["type"])], self.colors(srgb)
        if list(self.channels.items()) == [("R", "r"), ("G", "g"), ("B", "b")]:
            return {"RGB": as_floats(rgb, dtype)}
        values = {"luma": luma(to_linear(srgb)), "one": np.ones(rgb.shape[:2], np.float32)}
        values |= {source: rgb[..., k] for k, source in enumerate("rgb")}
        return {name: as_floats(values[source], dtype) for name, source in self.channels.items()}

    def probe(self, voxels: npt.NDArray[np.int64]) -> tuple[FloatArray, float] | None:
        import OpenEXR

        names = {source: name for name, source in self.channels.items()}
        if not {"r", "g", "b"} <= set(names) or self.output.options["compression"] == "dwaa":
            return None
        values = np.empty((len(voxels), 3), np.float32)
        for z in np.unique(voxels[:, 2]):
            here = voxels[:, 2] == z
            # opened here, for OpenEXR takes no name that is not UTF-8
            with open(self.paths[z], "rb") as stream, OpenEXR.File(stream, separate_channels=True) as file:
                channels = file.channels()
                for k, source in enumerate("rgb"):
                    values[here, k] = channels[names[source]].pixels[voxels[here, 1], voxels[here, 0]]
        return values, ROUNDING[np.dtype(TYPES[str(self.output.options["type"])]).itemsize]

    def assemble(self, store: Store) -> list[Finished]:
        return [Finished(store.folder / path.name, path) for path in self.paths]


def slice_header(output: Output, volume: Volume, z: int) -> dict[str, Any]:
    """The attributes of one slice, as the OpenEXR package is to write it: what exr_zip.py compresses, uncompressed."""
    import OpenEXR

    compression = str(output.options["compression"])
    aspect = volume.spacing[0] / volume.spacing[1]
    written = "NO" if compression == "none" or compression in LINES else compression.upper()
    column, row, along = (volume.axes[k : k + 2].lstrip("+") for k in (0, 2, 4))
    header: dict[str, Any] = {
        "compression": getattr(OpenEXR, f"{written}_COMPRESSION"),
        "type": OpenEXR.scanlineimage,
        **color_attributes(output),
        "pixelAspectRatio": aspect if 1e-6 < aspect < 1e6 else 1.0,  # OpenEXR holds no other
        "solidgrain:texture": volume.texture,
        "solidgrain:model": volume.sampler_sha256,
        "solidgrain:seed": str(volume.seed),  # may exceed an EXR int
        "solidgrain:slice": z,
        "solidgrain:depth": volume.shape[0],
        "solidgrain:origin": np.array(volume.origin, np.float32),
        "solidgrain:spacing": np.array(volume.spacing, np.float32),
        "solidgrain:json": json.dumps({"origin": volume.origin, "spacing": volume.spacing}),  # unrounded
        "solidgrain:axes": f"column {column}, row {row} downwards from the top, slice {along}",
    }
    if volume.level:
        header["solidgrain:level"] = volume.level
    if volume.transform:
        header["solidgrain:transform"] = volume.notes["transform"]
    if volume.tile:
        wraps = ["periodic" if axis in volume.tile else "black" for axis in "xy"]
        header |= {"wrapmodes": ",".join(wraps), "solidgrain:tile": volume.tile}
    return header


def color_attributes(output: Output) -> dict[str, Any]:
    """How a header says the colour space: the standard attributes if it has an interop identifier, else its name.

    `oiio:ColorSpace` is what OpenImageIO goes by where `colorInteropID` is absent.
    """
    colorspace = output.colorspace
    if colorspace in (SRGB, LINEAR):
        return {"colorInteropID": colorspace, "chromaticities": REC709}
    from solidgrain.bake.ocio import chromaticities, interop_id

    if not (identifier := interop_id(colorspace)):
        named = {"oiio:ColorSpace": colorspace, "solidgrain:colorspace": colorspace}
        return {**named, "solidgrain:colorconfig": str(output.options["colorconfig"])}
    primaries = chromaticities(identifier)
    return {"colorInteropID": identifier, **({"chromaticities": primaries} if primaries else {})}


def parse_channels(output: Output) -> dict[str, str]:
    """Channel names and their sources. Raises UsageError."""
    text = str(output.options["channels"])
    pairs = [part.partition("=") for part in text.split(",")]
    channels = {name.strip(): source.strip() for name, _, source in pairs}
    if len(channels) != len(pairs) or not all(channels) or not text.isprintable() or not set(channels.values()) <= set(SOURCES):
        shown = text if text.isprintable() else ascii(text)
        raise UsageError(
            f"--exr-channels {shown}: expected NAME=SOURCE,... with each name once and sources from {', '.join(SOURCES)}"
        )
    return channels


def check(output: Output, volume: Volume) -> None:
    parse_channels(output)
    if output.options["start"] != 1 and not PATTERN.search(output.path.name):
        raise UsageError(f"--exr-start {output.options['start']}: {output.path.name} has no frame number; leave it out")


def files(output: Output, volume: Volume) -> list[Path]:
    return frame_paths(output.path, volume.shape[0], int(output.options["start"]))


def size(output: Output, volume: Volume) -> int:
    sample = np.dtype(TYPES[str(output.options["type"])]).itemsize
    return volume.voxels * sample * len(parse_channels(output)) + volume.shape[0] * 4096
