"""Textures: what pipeline scripts hold in their hands. Load one, then `sample`, `grid` or `slabs`."""

from __future__ import annotations

import operator
import os
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, SupportsIndex

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.arguments import (
    FARTHEST,
    Numbers,
    Vector,
    Whole,
    parse_affine,
    parse_extents,
    parse_spacing,
    parse_vector,
    parse_whole,
)
from solidgrain.runtime.blend_engine import open_blend_engine
from solidgrain.runtime.blend_file import FORMAT as BLEND_FORMAT
from solidgrain.runtime.blend_file import BlendData, read_blend, write_blend
from solidgrain.runtime.bundle import TEXTURE, Bundle, bundle_folder, find_bundle, is_texture_file, open_again, open_bundle
from solidgrain.runtime.engine import Engine, Instance, open_engine
from solidgrain.runtime.errors import BundleError, EvaluationError, ProviderError
from solidgrain.runtime.lattice import Tiling, tiled, untiled
from solidgrain.runtime.texture_file import TextureData, format_of, read_texture, write_texture
from solidgrain.runtime.workers import Workers

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]

DEFAULT_TEXTURE = "granite"
SLAB = 16  # slices per slab


def load_texture(
    source: str | os.PathLike[str] = DEFAULT_TEXTURE,
    *,
    bundle: str | os.PathLike[str] | None = None,
    provider: str = "auto",
    precision: str = "float32",
    threads: int = 0,
) -> Texture:
    """Load a texture by embedded name, from a bundle folder, or from a saved texture file.

    `bundle` names the bundle of a texture file that neither lies in it nor belongs to an embedded one, by its folder or its
    embedded name. `provider` "auto" is the fused kernel, or ONNX Runtime on the CPU where there is no kernel for this
    machine or bundle (`Texture.provider` and `provider_note` say which and why); "kernel" insists; "cpu", "cuda",
    "directml", "coreml", "openvino" are ONNX Runtime's execution providers. One that cannot be had is an error. `precision`
    "bfloat16" is faster where the processor has AMX or AVX-512 BF16, and an error elsewhere. `threads` of 0 uses every
    processor that this process may use. Raises BundleError, ProviderError, or EvaluationError for a number of threads that is
    none; for a space, which is no texture, BundleError.
    """
    data, owner = _resolve(os.fspath(source), None if bundle is None else os.fspath(bundle))
    return open_texture(data, owner, provider, precision, make_workers(threads))


def open_texture(data: TextureData | BlendData, owner: Bundle, provider: str, precision: str, workers: Workers) -> Texture:
    """A texture on what evaluates it. Raises BundleError or ProviderError."""
    check_fits(data, owner)
    if not isinstance(provider, str):
        raise ProviderError(f"provider {provider!r}: expected a name, such as auto")
    if isinstance(data, BlendData):
        engine, note = open_blend_engine(owner, data, provider.lower(), precision)
    else:
        engine, note = open_engine(owner, data, provider.lower(), precision)
    return Texture(data, owner, engine, workers, provider, note)


def _opened_again(data: TextureData | BlendData, folder: Path, provider: str, precision: str, threads: int) -> Texture:
    """What a copy of a texture begins as, in this process or in another one."""
    return open_texture(data, open_again(data.sampler_sha256, folder), provider, precision, make_workers(threads))


def make_workers(threads: int) -> Workers:
    (count,) = parse_whole("threads", (threads,), count=1, least=0)
    return Workers(count)


def check_alone(source: str, bundle: str | os.PathLike[str] | None) -> None:
    """A bundle needs no other one. Raises BundleError."""
    if bundle is not None:
        raise BundleError(f"{source}: is a bundle itself, and --bundle is about texture files; leave {bundle} out")


def _resolve(source: str, bundle: str | None) -> tuple[TextureData | BlendData, Bundle]:
    path = Path(source)
    if is_texture_file(source):
        data = read_blend(path) if format_of(path) == BLEND_FORMAT else read_texture(path)
        folder = find_bundle(data.sampler_sha256, path.parent) if bundle is None else bundle_folder(bundle)
        if folder is None:
            wanted = f"{data.sampler_sha256[:12]}… (texture {data.name!r})"
            raise BundleError(
                f"{path}: needs the bundle whose sampler.onnx has sha256 {wanted}; name it with bundle= or --bundle"
            )
        return data, open_bundle(folder)
    owner = open_bundle(bundle_folder(source))
    check_alone(source, bundle)
    if owner.is_space:
        raise BundleError(
            f"{source}: is a space, which holds no texture of its own; "
            f"solidgrain encode PHOTO --bundle {source} --out PHOTO.sgt.npz makes one"
        )
    if TEXTURE not in owner.manifest["files"]:
        raise BundleError(f"{owner.folder / TEXTURE}: not in the manifest; this bundle holds no texture of its own")
    return read_texture(owner.folder / TEXTURE), owner


def check_fits(data: TextureData | BlendData, owner: Bundle) -> None:
    """Raises BundleError if a texture and a bundle do not belong together, or for a name that no file could hold."""
    if not data.name.isprintable():
        raise BundleError(f"texture {data.name!r}: expected a name of printable characters; give it another one")
    if data.sampler_sha256 != owner.sampler_sha256:
        fitting = find_bundle(data.sampler_sha256, owner.folder)
        advice = f"that is {fitting.name}, embedded" if fitting else "use the bundle that the texture was made with"
        raise BundleError(
            f"{owner.folder}: its sampler.onnx has sha256 {owner.sampler_sha256[:12]}…, "
            f"texture {data.name!r} needs {data.sampler_sha256[:12]}…; {advice}"
        )
    octaves, width, layers = (owner.manifest[key] for key in ("octaves", "width", "hidden_layers"))
    expected = {"transforms": (octaves, 3, 3), "gamma": (layers, width), "delta": (layers, width)}
    expected["noise_weights"] = (4, octaves // 4, width)
    for texture in data.ends if isinstance(data, BlendData) else (data,):
        for name, shape in expected.items():
            if texture.arrays()[name].shape != shape:
                raise BundleError(
                    f"{owner.folder}: {name} of texture {data.name!r} has shape {texture.arrays()[name].shape}, "
                    f"expected {shape}; the texture is damaged, save it again"
                )


class Texture:
    """A solid texture: colour at every point of space, in endless instances, one per seed."""

    def __init__(
        self, data: TextureData | BlendData, bundle: Bundle, engine: Engine, workers: Workers, provider: str, note: str
    ) -> None:
        self.data, self.bundle, self.workers, self.provider_note = data, bundle, workers, note
        self._engine, self._asked = engine, provider
        self._last: tuple[object, Instance] | None = None
        self._last_tiling: tuple[object, Tiling] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled, it is its data, and its bundle by the folder: whoever unpickles it opens an engine for it anew."""
        return _opened_again, (self.data, self.bundle.folder, self._asked, self.precision, self.workers.asked)

    @property
    def name(self) -> str:
        return self.data.name

    @property
    def provider(self) -> str:
        """What evaluates it: a path of the fused kernel ("kernel:avx512") or an ONNX Runtime execution provider; both, joined
        by a +, for a blend in space whose textures run on the kernel."""
        return self._engine.name

    @property
    def precision(self) -> str:
        return self._engine.precision

    @property
    def threads(self) -> int:
        return self.workers.count

    @property
    def transforms(self) -> npt.NDArray[np.float64]:
        """T_i [n, 3, 3], noise texels per exemplar pixel; of a blend in space, both textures' [2n, 3, 3]."""
        return self.data.transforms

    def sample(self, points: npt.ArrayLike, seed: SupportsIndex = 0) -> FloatArray:
        """Colour at points [P, 3] (x, y, z) in exemplar pixels -> [P, 3] float32 in [0, 1], sRGB-encoded.

        A point that is NaN, infinite or beyond 2^36 pixels has the colour NaN, and a RuntimeWarning counts them. Raises
        EvaluationError for points of another shape.
        """
        try:
            coordinates = np.ascontiguousarray(points, np.float64)
        except (TypeError, ValueError) as error:
            raise EvaluationError(f"points are not numbers ({error}), expected [P, 3] (x, y, z)") from error
        if np.shape(points) != coordinates.shape or coordinates.ndim != 2 or coordinates.shape[1] != 3:
            raise EvaluationError(f"points have shape {np.shape(points)}, expected [P, 3] (x, y, z)")
        nowhere = np.flatnonzero(~(np.abs(coordinates) <= FARTHEST).all(axis=1))
        if nowhere.size:
            coordinates = coordinates.copy()
            coordinates[nowhere] = 0.0
        rgb = np.empty((len(coordinates), 3), np.float32)
        self.workers.run(self._instance(untiled(self.transforms), seed).point_tasks(coordinates, rgb))
        if nowhere.size:
            rgb[nowhere] = np.nan
            warnings.warn(
                f"{nowhere.size} of {len(rgb)} points are NaN, infinite or beyond {FARTHEST:g} pixels; their colour is NaN",
                RuntimeWarning,
                stacklevel=2,
            )
        return rgb

    def grid(
        self,
        shape: Whole,
        seed: SupportsIndex = 0,
        *,
        origin: Numbers = (0.0, 0.0, 0.0),
        spacing: float | Numbers = 1.0,
        tile: str = "",
        period: Whole | None = None,
        transform: npt.ArrayLike | None = None,
    ) -> FloatArray:
        """Colour on a voxel grid of shape (z, y, x) -> [z, y, x, 3] float32 in [0, 1], sRGB-encoded.

        `origin` (x, y, z) and `spacing` (one number or x, y, z) are in exemplar pixels; voxel k of an axis is at
        origin + (k + 0.5) spacing. `tile` names the axes that repeat seamlessly, any subset of "xyz", with `period`
        (z, y, x) in voxels, by default the grid's own shape. `transform` [4, 4] places the grid in the texture: the voxel
        at p has the colour of M p, column vectors (x, y, z, 1). Raises EvaluationError for a shape, spacing, period,
        origin or transform that makes no sense.
        """
        slabs = self.slabs(shape, seed, origin=origin, spacing=spacing, tile=tile, period=period, transform=transform)
        try:
            volume = np.empty((*parse_extents("shape", shape), 3), np.float32)
        except (ValueError, MemoryError) as error:
            raise EvaluationError(f"shape {shape}: more than an array can hold here; take slabs() instead") from error
        for z, slab in slabs:
            volume[z : z + len(slab)] = slab
        return volume

    def slabs(
        self,
        shape: Whole,
        seed: SupportsIndex = 0,
        *,
        origin: Numbers = (0.0, 0.0, 0.0),
        spacing: float | Numbers = 1.0,
        tile: str = "",
        period: Whole | None = None,
        transform: npt.ArrayLike | None = None,
        slab: int = SLAB,
        slices: tuple[int, int] | None = None,
    ) -> Iterator[tuple[int, FloatArray]]:
        """The same grid as runs of whole slices, in order: pairs of first slice and [<= slab, y, x, 3].

        `slices` (first, stop) are all of it, or the part that is wanted. Memory is bounded by the slab, whatever the
        depth. Other arguments and errors as in `grid`.
        """
        depth, rows, columns = parse_extents("shape", shape)
        (thickness,) = parse_whole("slab", (slab,), count=1, least=1)
        low, high = (0, depth) if slices is None else parse_whole("slices", slices, count=2, least=0)
        if not low <= high <= depth:
            raise EvaluationError(f"slices {slices}: expected first and stop, from 0 to {depth}")
        start = self.grid_start(shape, origin=origin, spacing=spacing, tile=tile, period=period, transform=transform)
        tiling = self.tiling(shape, spacing=spacing, tile=tile, period=period, transform=transform)
        step = parse_spacing(spacing)
        instance = self._instance(tiling, seed)

        def places(axis: int, first: int, stop: int) -> DoubleArray:
            return tiling.wrap(start[axis] + (np.arange(first, stop, dtype=np.float64) + 0.5) * step[axis], axis)

        try:
            x, y = places(0, 0, columns), places(1, 0, rows)
        except (ValueError, MemoryError) as error:
            raise EvaluationError(f"shape {shape}: more than an array can hold here; take a part of it") from error
        return (
            (first, self._slab(instance, x, y, places(2, first, min(first + thickness, high))))
            for first in range(low, high, thickness)
        )

    def grid_start(
        self,
        shape: Whole,
        *,
        origin: Numbers = (0.0, 0.0, 0.0),
        spacing: float | Numbers = 1.0,
        tile: str = "",
        period: Whole | None = None,
        transform: npt.ArrayLike | None = None,
    ) -> Vector:
        """The corner of a grid (x, y, z), the shift of its transform included: M p + t = M (p + start - origin).

        Evaluates nothing: it raises the EvaluationError that `grid` would, at no cost.
        """
        depth, rows, columns = parse_extents("shape", shape)
        matrix, corner, step = parse_affine(transform), parse_vector("origin", origin), parse_spacing(spacing)
        shift = np.linalg.solve(matrix[:3, :3], matrix[:3, 3]).tolist()
        start = (corner[0] + shift[0], corner[1] + shift[1], corner[2] + shift[2])
        ends = [start[axis] + step[axis] * count for axis, count in enumerate((columns, rows, depth))]
        farthest = [max(abs(first), abs(last)) for first, last in zip(start, ends, strict=True)]
        reach = max(*farthest, *(np.abs(matrix[:3, :3]) @ farthest))
        if reach > FARTHEST:
            raise EvaluationError(f"grid reaches {reach:g} pixels from the origin, expected at most {FARTHEST:g}")
        tiling = self.tiling(shape, spacing=spacing, tile=tile, period=period, transform=transform)
        tiling.check_exact((farthest[0], farthest[1], farthest[2]))
        self._engine.check(tiling)
        return start

    def _slab(self, instance: Instance, x: DoubleArray, y: DoubleArray, z: DoubleArray) -> FloatArray:
        rgb = np.empty((len(z), len(y), len(x), 3), np.float32)
        self.workers.run(instance.grid_tasks(x, y, z, rgb))
        return rgb

    def tiling(
        self,
        shape: Whole,
        *,
        spacing: float | Numbers = 1.0,
        tile: str = "",
        period: Whole | None = None,
        transform: npt.ArrayLike | None = None,
    ) -> Tiling:
        """How tiling moves this texture's transforms for such a grid, and by how much (`distortion`)."""
        voxels = parse_extents("period", shape if period is None else period)
        if not isinstance(tile, str):
            raise EvaluationError(f"tile {tile!r}: expected axes to repeat along, a text of x, y and z")
        step = parse_spacing(spacing)
        matrix = parse_affine(transform)[:3, :3]
        transforms = self.transforms if transform is None else self.transforms @ matrix
        span = (voxels[2] * step[0], voxels[1] * step[1], voxels[0] * step[2])
        key = (transforms.tobytes(), matrix.tobytes(), span, tile)
        last = self._last_tiling  # finding lattices takes longer than a few voxels do
        if last is None or last[0] != key:
            last = self._last_tiling = (key, replace(tiled(transforms, span, tile), matrix=matrix))
        return last[1]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Save the texture alone (~25 KB; a blend's mask comes on top); it loads wherever its bundle can be found."""
        if isinstance(self.data, BlendData):
            write_blend(Path(path), self.data)
        else:
            write_texture(Path(path), self.data)

    def _instance(self, tiling: Tiling, seed: SupportsIndex) -> Instance:
        """The instance of a seed; the last one is kept, so that point after point is cheap."""
        try:
            number = operator.index(seed)
        except TypeError as error:
            raise EvaluationError(f"seed {seed!r}: expected a whole number from 0 to 2^64 - 1") from error
        key = (number, tiling.transforms.tobytes(), tiling.lattice.tobytes(), tiling.matrix.tobytes(), tiling.period)
        last = self._last  # another thread may replace it at any time
        if last is None or last[0] != key:
            last = self._last = (key, self._engine.instance(tiling, number))
        return last[1]
