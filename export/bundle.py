"""Writing a bundle: the folder that the runtime loads (its layout is in `solidgrain.runtime.bundle`)."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime

from solidgrain.export.sampler_graph import OPSET, build_sampler_graph
from solidgrain.runtime.bundle import CARD, FORMAT, FORMAT_VERSION, MANIFEST, SAMPLER, TEXTURE, file_sha256
from solidgrain.runtime.errors import BundleError
from solidgrain.runtime.files import sync
from solidgrain.runtime.lattice import untiled
from solidgrain.runtime.noise import noise_offsets, noise_tables
from solidgrain.runtime.texture_file import TextureData, write_texture

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]

PROBE_SEED = 7


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
class Details:
    """What the manifest and the model card say besides the numbers."""

    name: str
    patch: int  # pixels along each side of a training patch
    color_encoding: str = "srgb_rec709_scene"
    training: dict[str, Any] = field(default_factory=dict)
    card: str = ""


def write_bundle(folder: Path, sampler: SamplerWeights, details: Details, overwrite: bool = False) -> Path:
    """Write a bundle folder, whole or not at all.

    Raises BundleError if the folder exists (and `overwrite` is not set, or it is not a bundle) or cannot be written.
    """
    if folder.exists() and not (overwrite and (folder / MANIFEST).is_file()):
        raise BundleError(f"{folder}: already exists; choose another --out, or --overwrite to replace a bundle")
    if folder.exists() and (strange := {path.name for path in folder.iterdir()} - {MANIFEST, SAMPLER, TEXTURE, CARD}):
        raise BundleError(f"{folder}: holds {', '.join(sorted(strange))}, which is no part of a bundle; move it away first")
    folder = folder.resolve()
    building = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    former = folder.with_name(f".{folder.name}.{os.getpid()}.old")
    try:
        building.mkdir(parents=True)
        _fill(building, sampler, details)
        for path in building.iterdir():
            sync(path)
        if folder.exists():
            folder.rename(former)
        building.rename(folder)
    except OSError as error:
        raise BundleError(f"{folder}: cannot write the bundle ({error.strerror})") from error
    finally:
        shutil.rmtree(building, ignore_errors=True)
        shutil.rmtree(former, ignore_errors=True)
    return folder


def _fill(folder: Path, sampler: SamplerWeights, details: Details) -> None:
    octaves, layers, width = len(sampler.transforms), *sampler.gamma.shape
    model = build_sampler_graph(sampler.weights, sampler.biases, octaves)
    onnx.save(model, folder / SAMPLER)
    texture = TextureData(
        name=details.name,
        sampler_sha256=file_sha256(folder / SAMPLER),
        transforms=sampler.transforms,
        gamma=sampler.gamma,
        delta=sampler.delta,
        noise_weights=sampler.noise_weights,
    )
    write_texture(folder / TEXTURE, texture)
    manifest = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "name": details.name,
        "producer": f"solidgrain {version('solidgrain')}, onnx {onnx.__version__}",
        "opset": OPSET,
        "octaves": octaves,
        "width": width,
        "hidden_layers": layers,
        "patch": details.patch,
        "color_encoding": details.color_encoding,
        "files": {name: file_sha256(folder / name) for name in (SAMPLER, TEXTURE)},
        "probe": _probe(model, texture),
        "training": details.training,
    }
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n", "utf-8")
    if details.card:
        (folder / CARD).write_text(details.card, "utf-8")


def _probe(model: onnx.ModelProto, texture: TextureData) -> dict[str, Any]:
    """A few points and their colours: what an installation elsewhere must reproduce (`solidgrain info` compares)."""
    points = np.array([[0.5, 0.5, 0.5], [-12.25, 100.0, 3.75], [1e6 + 0.5, -1e6, 64.0], [1e9 + 0.5, 0.5, -1e9 + 0.5]])
    rgb = run_graph(model, texture, points, PROBE_SEED)
    return {"seed": PROBE_SEED, "points": points.tolist(), "rgb": rgb.astype(float).tolist()}


def run_graph(model: onnx.ModelProto, texture: TextureData, points: DoubleArray, seed: int) -> FloatArray:
    """What a sampler graph says at points [P, 3] in exemplar pixels -> [P, 3], not clipped."""
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    octaves = len(texture.transforms)
    feed = {
        **texture.arrays(),
        "points": points,
        "offsets": noise_offsets(seed, octaves),
        "lattice": untiled(texture.transforms).lattice,
        "noise": noise_tables(seed, octaves),
    }
    rgb: FloatArray = session.run(["rgb"], feed)[0]
    return rgb
