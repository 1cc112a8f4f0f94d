"""`.atlas.png`, `.atlas.exr`: all slices as tiles of one image, and `NAME.atlas.json`, which says how they lie.

Tiles are row-major, slice 0 at the top left; within a tile the top row is y = 0 and the left column x = 0 (a flipbook, as the
volume importers of Unreal, Unity and Godot read it). PNG has 8 bits, EXR half floats in zip-compressed scanlines. Slices are
spooled; the image is written and read back a few rows of pixels at a time.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from solidgrain.bake.color import LINEAR, SRGB
from solidgrain.bake.store import Bytes, Encoded, Finished, Store
from solidgrain.bake.writers.base import FloatArray, Option, Output, Volume, Writer
from solidgrain.bake.writers.exr import color_attributes
from solidgrain.bake.writers.raw import provenance, write_sidecar
from solidgrain.runtime.errors import BakeError, UsageError
from solidgrain.runtime.files import sync

OPTIONS = (Option("columns", 0, "tiles in a row; 0 chooses the squarest grid without empty tiles"),)
SLICES = "slices"  # stream: the voxels of each slice as the image holds them
SIDE = 1_000_000  # pixels: libpng's limit, and just below that of OpenImageIO's readers
VERSION = 1  # of the JSON file
BAND_BYTES = 16 * 2**20  # of the image that are in memory at a time


class Layout(NamedTuple):
    """Where the slices are: tiles along the image's sides, pixels of a tile."""

    columns: int
    rows: int
    tile_width: int
    tile_height: int

    @property
    def width(self) -> int:
        return self.columns * self.tile_width

    @property
    def height(self) -> int:
        return self.rows * self.tile_height


def layout(output: Output, volume: Volume) -> Layout:
    """The grid of tiles: as wide as asked for, else the squarest (never higher than wide) that the slices fill exactly. A prime
    number above 3 gets a square too, whose last tiles stay empty."""
    depth, height, width = volume.shape
    columns = int(output.options["columns"])
    if volume.level:
        columns = min(columns, depth)  # asked for the first level, which has more slices
    if not columns:
        rows = next(rows for rows in range(math.isqrt(depth), 0, -1) if depth % rows == 0)
        columns = math.isqrt(depth - 1) + 1 if rows == 1 and depth > 3 else depth // rows
    return Layout(columns, -(-depth // columns), width, height)


class AtlasFile(Writer):
    """Spools the slices as the image holds them, and lays them out when all are there."""

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(np.uint8 if self.output.kind.endswith("png") else np.float16)

    def encode(self, z: int, slab: FloatArray) -> Encoded:
        def convert(k: int) -> Bytes:
            return self.stored(slab[k : k + 1], z + k, self.dtype).data

        return Encoded({SLICES: self.workers.map(convert, len(slab))})

    def assemble(self, store: Store) -> list[Finished]:
        staged = store.folder / f"atlas{self.output.path.suffix.lower()}"
        tiles = layout(self.output, self.volume)
        if self._write(staged, tiles, store) != self._read(staged, tiles):
            raise self._failed("write", "its pixels are not what was written")
        sync(staged)
        return [Finished(staged, self.output.path), write_sidecar(store, self._values(tiles), sidecar_path(self.output))]

    def _thickness(self, tiles: Layout) -> int:
        """Rows of pixels that are in memory at a time: at most those of a tile."""
        return max(1, min(tiles.tile_height, BAND_BYTES // (tiles.width * 3 * self.dtype.itemsize)))

    def _bands(self, tiles: Layout, store: Store) -> Iterator[tuple[int, npt.NDArray[np.generic]]]:
        """The image from top to bottom, a few rows of pixels at a time: first row, [rows, width, 3]. A tile without a slice
        is black."""
        row_bytes = tiles.tile_width * 3 * self.dtype.itemsize
        thickness = self._thickness(tiles)
        for tile_row in range(tiles.rows):
            for first in range(0, tiles.tile_height, thickness):
                count = min(thickness, tiles.tile_height - first)
                band = np.zeros((count, tiles.columns, tiles.tile_width, 3), self.dtype)
                for k in range(min(tiles.columns, self.volume.shape[0] - tile_row * tiles.columns)):
                    z, part = tile_row * tiles.columns + k, (first * row_bytes, count * row_bytes)
                    rows = store.read_part(SLICES, z, tiles.tile_height * row_bytes, *part)
                    band[:, k] = np.frombuffer(rows, self.dtype).reshape(count, tiles.tile_width, 3)
                yield tile_row * tiles.tile_height + first, band.reshape(count, tiles.width, 3)

    def _write(self, path: Path, tiles: Layout, store: Store) -> str:
        """Write the image. Returns the checksum of its pixels."""
        import OpenImageIO as oiio

        oiio.attribute("exr_threads", -1)  # its own threads would come on top of ours
        image, digest = oiio.ImageOutput.create(os.fspath(path)), hashlib.sha256()
        if image is None or not image.open(os.fspath(path), self._spec(tiles)):
            raise self._failed("write", image.geterror() if image else oiio.geterror())
        for first, band in self._bands(tiles, store):
            if not image.write_scanlines(first, first + len(band), 0, band):
                raise self._failed("write", image.geterror())
            digest.update(band.data)
        if not image.close():
            raise self._failed("write", image.geterror())
        return digest.hexdigest()

    def _spec(self, tiles: Layout) -> Any:
        """What the image's header says."""
        import OpenImageIO as oiio

        half = self.dtype == np.float16
        spec = oiio.ImageSpec(tiles.width, tiles.height, 3, "half" if half else "uint8")
        if half or self.output.colorspace in (SRGB, LINEAR):  # of others OpenImageIO would write a PNG's gamma alone
            spec.attribute("oiio:ColorSpace", self.output.colorspace)
        spec.attribute("Software", "solidgrain")
        spec.attribute("DateTime", "")  # no time stamp: equal volumes are equal bytes
        spec.attribute("png:compressionLevel", 4)  # 6 takes up to three times as long for 4 % less
        if half:
            spec.attribute("compression", "zip")
            attributes = color_attributes(self.output)
            if primaries := attributes.pop("chromaticities", None):
                spec.attribute("chromaticities", "float[8]", primaries)
            for name, value in attributes.items():
                spec.attribute(name, value)
        return spec

    def _read(self, path: Path, tiles: Layout) -> str:
        """The checksum of the pixels that a file holds: OpenImageIO may report success on a full disk."""
        digest = hashlib.sha256()
        thickness = self._thickness(tiles)
        runs = [(first, min(first + thickness, tiles.height)) for first in range(0, tiles.height, thickness)]
        for band in self._scanlines(path, runs):
            digest.update(band.data)
        return digest.hexdigest()

    def _scanlines(self, path: Path, runs: Sequence[tuple[int, int]]) -> Iterator[npt.NDArray[np.generic]]:
        """Runs of scanlines (first, stop) of an image, [stop - first, width, 3] each, as it holds them."""
        import OpenImageIO as oiio

        image = oiio.ImageInput.open(os.fspath(path))
        if image is None:
            raise self._failed("read", oiio.geterror())
        for first, stop in runs:
            pixels = image.read_scanlines(first, stop, 0, 0, 3, oiio.HALF if self.dtype == np.float16 else oiio.UINT8)
            if pixels is None:
                raise self._failed("read", image.geterror())
            yield np.ascontiguousarray(pixels, self.dtype)

    def _failed(self, verb: str, reason: str) -> BakeError:
        reason = " ".join(reason.split())
        return BakeError(f"{self.output.path}: cannot {verb} the atlas ({reason}); free space and bake again")

    def _values(self, tiles: Layout) -> dict[str, Any]:
        volume, engine = self.volume, str(self.output.options.get("engine", ""))
        return {
            "format": "solidgrain atlas",
            "version": VERSION,
            "image": self.output.path.name,
            "size": volume.shape[::-1],
            "tiles": (tiles.columns, tiles.rows),
            "tile_size": (tiles.tile_width, tiles.tile_height),
            "order": "row-major, slice 0 at the top left; the top row of a tile is y = 0, its left column x = 0",
            "wrap": ["repeat" if axis in volume.tile else "clamp" for axis in "xyz"],
            **provenance(self.output, volume),
            "engine": engine,
            "import": import_settings(engine, tiles, self.output.colorspace),
        }

    def probe(self, voxels: npt.NDArray[np.int64]) -> tuple[FloatArray, float]:
        tiles, values = layout(self.output, self.volume), np.empty((len(voxels), 3), self.dtype)
        x, y, z = voxels.T
        row = z // tiles.columns * tiles.tile_height + y
        column = z % tiles.columns * tiles.tile_width + x
        lines = np.unique(row)  # downwards: what is compressed is read once
        for line, pixels in zip(lines, self._scanlines(self.output.path, [(int(y), int(y) + 1) for y in lines]), strict=True):
            values[row == line] = pixels[0, column[row == line]]
        return self.read_back(values)


def import_settings(engine: str, tiles: Layout, colorspace: str) -> dict[str, Any]:
    """What to enter in the import settings of an engine, by the names that they have there."""
    if engine == "unity":
        largest = max(32, 2 ** math.ceil(math.log2(max(tiles.width, tiles.height))))
        settings = {"Texture Shape": "3D", "Columns": tiles.columns, "Rows": tiles.rows, "Max Size": largest}
        return {**settings, "sRGB (Color Texture)": colorspace == SRGB}
    if engine == "godot":
        return {"Import As": "Texture3D", "slices/horizontal": tiles.columns, "slices/vertical": tiles.rows}
    if engine == "unreal":
        return {"Source2DTileSizeX": tiles.tile_width, "Source2DTileSizeY": tiles.tile_height, "SRGB": colorspace == SRGB}
    return {}


def check(output: Output, volume: Volume) -> None:
    """Refuse images that no reader opens."""
    tiles = layout(output, volume)
    if tiles.columns > volume.shape[0]:
        raise UsageError(f"--atlas-columns {tiles.columns}: {output.path} has {volume.shape[0]} slices; use that at most")
    if max(tiles.width, tiles.height) > SIDE:
        raise UsageError(
            f"{output.path}: {tiles.columns}x{tiles.rows} tiles make an image of {tiles.width}x{tiles.height} pixels, at most "
            f"{SIDE} a side can be written; choose another --atlas-columns or .dds"
        )


def sidecar_path(output: Output) -> Path:
    """`a.atlas.png`, `a.atlas.exr` -> `a.atlas.json`."""
    return output.path.with_suffix(".json")


def files(output: Output, volume: Volume) -> list[Path]:
    return [output.path, sidecar_path(output)]


def scratch(output: Output) -> int:
    return 3 if output.kind.endswith("png") else 6


def size(output: Output, volume: Volume) -> int:
    """Incompressible pixels, the filter byte of each PNG scanline, and what zlib and the chunks add."""
    tiles = layout(output, volume)
    pixels = tiles.height * (tiles.width * scratch(output) + 32)
    return pixels + pixels // 512 + 65536
