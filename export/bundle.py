"""Writing a bundle: the folder that the runtime loads (its layout is in `solidgrain.runtime.bundle`)."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime

from solidgrain.export.blend_graph import build_blend_graph
from solidgrain.export.sampler_graph import build_sampler_graph
from solidgrain.export.space_graphs import EncoderWeights, MappingWeights, build_encoder_graph, build_mapping_graph
from solidgrain.runtime.bundle import (
    BLEND,
    CARD,
    COLOR_ENCODING,
    CRITIC,
    ENCODER,
    FORMAT,
    FORMAT_VERSION,
    MANIFEST,
    MAPPING,
    SAMPLER,
    TEXTURE,
    file_sha256,
)
from solidgrain.runtime.errors import BundleError
from solidgrain.runtime.files import exchanged, sync, temporary_name
from solidgrain.runtime.lattice import untiled
from solidgrain.runtime.noise import noise_offsets, noise_tables
from solidgrain.runtime.probe import probe_patch
from solidgrain.runtime.texture_file import TextureData, write_texture

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]

PROBE_SEED = 7
PLACES = ((0.5, 0.5, 0.5), (-12.25, 100.0, 3.75), (1e6 + 0.5, -1e6, 64.0), (1e9 + 0.5, 0.5, -1e9 + 0.5))


@dataclass(frozen=True)
class SamplerWeights:
    """A sampler and its one texture as plain arrays, learning-rate gains applied.

    Shapes of `weights` and `biases` are those of `build_sampler_graph`; `transforms` are in noise texels per exemplar pixel.
    """

    weights: Sequence[FloatArray]
    biases: Sequence[FloatArray]
    transforms: DoubleArray  # [n, 3, 3]
    noise_weights: FloatArray  # [4, n/4, m]
    gamma: FloatArray  # [hidden layers, m]
    delta: FloatArray  # [hidden layers, m]


@dataclass(frozen=True)
class SpaceWeights:
    """A texture space as plain arrays: what `SamplerWeights` is to one texture."""

    weights: Sequence[FloatArray]
    biases: Sequence[FloatArray]
    encoder: EncoderWeights
    mapping: MappingWeights


@dataclass(frozen=True)
class Details:
    """What the manifest and the model card say besides the numbers."""

    name: str
    patch: int  # pixels along each side of a training patch
    training: dict[str, Any] = field(default_factory=dict)
    card: str = ""


def write_bundle(
    folder: Path,
    content: SamplerWeights | SpaceWeights,
    details: Details,
    overwrite: bool = False,
    add: Callable[[Path], None] = lambda folder: None,
) -> Path:
    """Write a bundle folder, whole or not at all: what it would replace stays, or comes back.

    `add` writes what the manifest does not list into the folder, once everything else is in it.
    Raises BundleError if the folder exists (and `overwrite` is not set, or it is not a bundle) or cannot be written.
    """
    if folder.exists() and not (overwrite and (folder / MANIFEST).is_file()):
        raise BundleError(f"{folder}: already exists; choose another --out, or --overwrite to replace a bundle")
    parts = {MANIFEST, SAMPLER, TEXTURE, CARD, ENCODER, MAPPING, BLEND, CRITIC}
    if folder.exists() and (strange := {path.name for path in folder.iterdir()} - parts):
        raise BundleError(f"{folder}: holds {', '.join(sorted(strange))}, which is no part of a bundle; move it away first")
    if not details.name.isprintable():
        raise BundleError(
            f"{folder}: {details.name!r} is no name for a texture; give it one of printable characters with --name"
        )
    folder = folder.resolve()
    building = temporary_name(folder)
    former = building.with_suffix(".old")
    try:
        building.mkdir(parents=True)
        _fill(building, content, details)
        add(building)
        for path in building.iterdir():
            sync(path)
        if not (folder.exists() and exchanged(building, folder)):
            if folder.exists():
                folder.rename(former)
            building.rename(folder)
    except OSError as error:
        raise BundleError(f"{folder}: cannot write the bundle ({error.strerror})") from error
    finally:
        if former.exists() and not folder.exists():
            former.rename(folder)
        shutil.rmtree(building, ignore_errors=True)
        shutil.rmtree(former, ignore_errors=True)
    return folder


def _fill(folder: Path, content: SamplerWeights | SpaceWeights, details: Details) -> None:
    """Graphs and texture, then the manifest that vouches for them."""
    octaves, layers, width = _sizes(content)
    model = build_sampler_graph(content.weights, content.biases, octaves)
    onnx.save(model, folder / SAMPLER)
    if isinstance(content, SamplerWeights):
        facts = _texture(folder, model, content, details)
    else:
        facts = _space(folder, model, content, details)
    manifest = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "name": details.name,
        "producer": f"solidgrain {version('solidgrain')}, onnx {onnx.__version__}",
        "opset": model.opset_import[0].version,
        "octaves": octaves,
        "width": width,
        "hidden_layers": layers,
        "patch": details.patch,
        "color_encoding": COLOR_ENCODING,
        "files": {path.name: file_sha256(path) for path in sorted(folder.iterdir())},
        **facts,
        "training": details.training,
    }
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n", "utf-8")
    if details.card:
        (folder / CARD).write_text(details.card, "utf-8")


def _sizes(content: SamplerWeights | SpaceWeights) -> tuple[int, int, int]:
    """Octaves, hidden layers, width."""
    noise_weights = content.noise_weights if isinstance(content, SamplerWeights) else content.mapping.noise_weights
    return 4 * noise_weights.shape[1], len(content.biases) - 1, noise_weights.shape[2]


def _texture(folder: Path, model: onnx.ModelProto, content: SamplerWeights, details: Details) -> dict[str, Any]:
    """The texture of a single exemplar, and a probe of it: what an installation elsewhere must reproduce."""
    texture = TextureData(
        name=details.name,
        sampler_sha256=file_sha256(folder / SAMPLER),
        transforms=content.transforms,
        gamma=content.gamma,
        delta=content.delta,
        noise_weights=content.noise_weights,
    )
    write_texture(folder / TEXTURE, texture)
    return {"probe": _probe(model, texture, PLACES)}


def _space(folder: Path, model: onnx.ModelProto, content: SpaceWeights, details: Details) -> dict[str, Any]:
    """Encoder and mapping, and a probe of all three graphs: the code of a fixed patch, and colours of its texture."""
    encoder, mapping = build_encoder_graph(content.encoder), build_mapping_graph(content.mapping)
    onnx.save(encoder, folder / ENCODER)
    onnx.save(mapping, folder / MAPPING)
    onnx.save(build_blend_graph(content.weights, content.biases, _sizes(content)[0]), folder / BLEND)
    z = run_encoder(encoder, probe_patch(content.encoder.patch)[None])
    texture = run_mapping(mapping, z, details.name, file_sha256(folder / SAMPLER))[0]
    probe = {"z": z[0].astype(float).tolist(), **_probe(model, texture, PLACES[:2])}
    return {"latent": z.shape[1], "encoded_patch": content.encoder.patch, "probe": probe}


def _probe(model: onnx.ModelProto, texture: TextureData, places: Sequence[Sequence[float]]) -> dict[str, Any]:
    """A few points and their colours (`solidgrain info` compares).

    A mapping's transforms may differ by a last bit between processors, which shows far from the origin: a space's are near it.
    """
    rgb = run_graph(model, texture, np.array(places), PROBE_SEED)
    return {"seed": PROBE_SEED, "points": [list(place) for place in places], "rgb": rgb.astype(float).tolist()}


def run_encoder(model: onnx.ModelProto, patches: FloatArray) -> FloatArray:
    """z [B, latent] of patches [B, patch, patch, 3]."""
    feed = {"exemplar": np.ascontiguousarray(patches.transpose(0, 3, 1, 2))}
    z: FloatArray = _session(model).run(["z"], feed)[0]
    return z


def run_mapping(model: onnx.ModelProto, z: FloatArray, name: str, sampler_sha256: str) -> list[TextureData]:
    """The textures of latent codes [B, latent]."""
    parts = _session(model).run(["transforms", "gamma", "delta", "noise_weights"], {"z": z})
    return [
        TextureData(name, sampler_sha256, transforms.astype(np.float64), gamma, delta, noise_weights, code)
        for transforms, gamma, delta, noise_weights, code in zip(*parts, z, strict=True)
    ]


def run_graph(model: onnx.ModelProto, texture: TextureData, points: DoubleArray, seed: int) -> FloatArray:
    """What a sampler graph says at points [P, 3] in exemplar pixels -> [P, 3], not clipped."""
    octaves = len(texture.transforms)
    feed = {
        **texture.arrays(),
        "points": points,
        "offsets": noise_offsets(seed, octaves),
        "lattice": untiled(texture.transforms).lattice,
        "noise": noise_tables(seed, octaves),
    }
    rgb: FloatArray = _session(model).run(["rgb"], feed)[0]
    return rgb


def _session(model: onnx.ModelProto) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
