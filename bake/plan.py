"""A bake as pure data: everything that its bytes depend on, and where they go."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from solidgrain.bake.frames import in_hashes
from solidgrain.bake.writers import Output, Volume, slab_slices, turned_bytes
from solidgrain.runtime.bundle import MANIFEST

IN_FLIGHT = 3  # slabs: one is evaluated while two wait for the disk (baker.AHEAD)
ENCODING = 4  # slabs' worth that a writer holds at most, with a thread for each slice: half-float EXR needs 3.6
DITHERING = 9  # the same where noise is made, from hashes of 64 bits: 8
AVERAGING = 3.25  # the same, times the samples per voxel: themselves, their linear light, a term of it, and where that holds
BASE_MEMORY = 220 * 2**20  # interpreter, libraries, noise tables, the chunks in flight
FORMAT_VERSION = 1  # of plans and manifests
BYTES_VERSION = 5  # of what writers make of a plan: one more with every change of it

Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Plan:
    """Everything that the bytes of a bake depend on, and where they go. Vectors are (x, y, z)."""

    source: str
    texture: str  # name of the texture
    texture_sha256: str  # of its values
    sampler_sha256: str  # of its bundle's sampler.onnx
    precision: str
    seed: int
    size: tuple[int, int, int]  # voxels
    origin: tuple[float, float, float]  # exemplar pixels
    spacing: tuple[float, float, float]  # exemplar pixels per voxel
    tile: str  # the axes that repeat, a subset of "xyz"
    outputs: tuple[Output, ...]
    transform: Matrix | None = None  # 4x4, from the grid's exemplar pixels to the texture's
    samples: int = 1  # per voxel
    bundle: str | None = None  # of a texture file that does not lie in it

    @property
    def volume(self) -> Volume:
        """The grid as writers see it."""
        width, height, depth = self.size
        return Volume(
            shape=(depth, height, width),
            origin=self.origin,
            spacing=self.spacing,
            texture=self.texture,
            sampler_sha256=self.sampler_sha256,
            seed=self.seed,
            tile=self.tile,
            transform=self.transform,
        )

    @property
    def fine(self) -> int:
        """Samples along each axis of a voxel."""
        return round(math.cbrt(self.samples))

    @property
    def slab(self) -> int:
        """Slices per slab."""
        width, height, depth = self.size
        return slab_slices(depth, width * height * 12 * self.samples)

    @property
    def memory(self) -> int:
        """An upper estimate of resident bytes: slabs, what is made of them, coordinates and file names, and the rest."""
        width, height, depth = self.size
        dithered = any(output.options.get("dither") for output in self.outputs)
        held = IN_FLIGHT + (DITHERING if dithered else ENCODING) + (AVERAGING * self.samples if self.samples > 1 else 0)
        turned = ENCODING * max((turned_bytes(output, self.volume) for output in self.outputs), default=0)  # once all is there
        return BASE_MEMORY + max(int(held * self.slab * width * height * 12), turned) + 64 * (width + height) + 1024 * depth

    def shard(self, number: int, count: int) -> tuple[int, int]:
        """The slices (first, stop) of shard `number` of `count`, counted from 1: whole slabs, none twice."""
        depth, slab = self.size[2], self.slab
        slabs = -(-depth // slab)
        first, stop = (k * slabs // count * slab for k in (number - 1, number))
        return first, min(stop, depth)

    def work(self, output: Output) -> dict[str, Any]:
        """What the bytes of one output depend on: neither its folder nor the other outputs."""
        values = self.to_json()
        for key in ("hash", "outputs", "source", "bundle"):
            del values[key]
        named = {**asdict(output), "path": in_hashes(output.path).name}
        return {**values, "slab": self.slab, "bytes": BYTES_VERSION, "output": named}

    def to_json(self) -> dict[str, Any]:
        """The plan as plain data, with the hash that names the work."""
        values: dict[str, Any] = {"format_version": FORMAT_VERSION, **json.loads(json.dumps(asdict(self), default=str))}
        return {"hash": hash_of(values), **values}  # first: without its line, the file is still JSON


def plan_from_json(values: dict[str, Any]) -> Plan:
    """The inverse of `Plan.to_json`, for values that the schema allows (schema.py)."""
    outputs = [Output(Path(output["path"]), output["kind"], dict(output["options"])) for output in values["outputs"]]
    rest = {key: value for key, value in values.items() if key not in ("format_version", "hash", "outputs")}
    for key in ("size", "origin", "spacing"):
        rest[key] = tuple(rest[key])
    if rest.get("transform"):
        rest["transform"] = tuple(tuple(row) for row in rest["transform"])
    return Plan(outputs=tuple(outputs), **rest)


def located(source: str) -> str:
    """Where a texture or bundle is, from any working folder; an embedded name as it is."""
    return str(Path(source).absolute()) if is_there(Path(source)) else source


def is_there(source: Path) -> bool:
    """Whether there is a texture file or a bundle, not yet whether it can be read."""
    return source.is_file() or (source / MANIFEST).is_file()


def hash_of(values: dict[str, Any]) -> str:
    """SHA-256 of plain data, whatever the order of its keys; a `hash` among them does not count."""
    counted = {key: value for key, value in values.items() if key != "hash"}
    return hashlib.sha256(json.dumps(counted, sort_keys=True).encode()).hexdigest()


def format_bytes(count: float) -> str:
    """A byte count for people, such as "1.5 GB"."""
    for unit in ("B", "KB", "MB", "GB", "TB"):
        if count < 1024:
            return f"{count:.0f} {unit}" if unit in ("B", "KB") else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.0f} PB"


def format_size(size: tuple[int, int, int]) -> str:
    return "x".join(str(extent) for extent in size)
