"""From the run directory of a texture space to its bundle: encoder, mapping and sampler, and a proof that all three agree."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from solidgrain.export.bundle import Details, FloatArray, SpaceWeights, run_encoder, run_graph, run_mapping, write_bundle
from solidgrain.export.card import write_card
from solidgrain.export.companion import write_companion
from solidgrain.export.from_run import SEED, TOLERANCE, random_points, sampler_layers, trained_state
from solidgrain.export.sampler_graph import build_sampler_graph
from solidgrain.export.space_graphs import (
    EncoderWeights,
    Layer,
    MappingWeights,
    build_encoder_graph,
    build_mapping_graph,
)
from solidgrain.runtime.bundle import CRITIC, SAMPLER, file_sha256
from solidgrain.runtime.errors import TrainingError
from solidgrain.runtime.probe import probe_patch
from solidgrain.train.layers import Conv, Linear
from solidgrain.train.noise import runtime_noise
from solidgrain.train.run import pixels_sha256
from solidgrain.train.sampler import Condition, Sampler
from solidgrain.train.settings import to_json
from solidgrain.train.slices import UNIT
from solidgrain.train.space import Space
from solidgrain.train.space_run import SpaceRun, open_space_run


def export_space_run(run_folder: Path, out: Path, name: str = "", overwrite: bool = False, companion: bool = False) -> Path:
    """Export a space run's averaged weights as a bundle called `name`, by default the folder's own name.

    With `companion` the folder also gets the critic, which adapting textures needs. Raises TrainingError if the run has no
    checkpoint yet, or if torch and one of the graphs in ONNX Runtime disagree by more than `TOLERANCE`; BundleError if the
    bundle cannot be written.
    """
    run = open_space_run(run_folder)
    if companion and not run.settings.trains_critic:
        raise TrainingError(f"{run_folder}: --companion: a run with --variant {run.settings.variant} trains no critic")
    state = trained_state(run)
    average = Space(run.settings, torch.Generator())
    try:
        average.load_state_dict(state["average"])
    except (RuntimeError, TypeError) as error:
        raise TrainingError(f"{run_folder}: the checkpoint does not fit the run's settings; start the run again") from error
    round_encoder(average)
    weights = space_weights(average, run.settings.encoded_patch)
    check_space_agreement(average, weights)
    name, training = name or out.name, provenance(run, state)
    details = Details(name=name, patch=run.settings.patch, training=training, card=write_card(name, training))

    def add(folder: Path) -> None:
        if companion:
            write_companion(folder / CRITIC, state["critic"], run.settings, file_sha256(folder / SAMPLER))

    return write_bundle(out, weights, details, overwrite, add)


@torch.no_grad()
def round_encoder(space: Space) -> None:
    """The encoder as the bundle stores it, in half precision: what comes before it is judged by is what users get."""
    for layer in (*space.encoder.convolutions, space.encoder.dense, space.encoder.code):
        assert isinstance(layer, Conv | Linear)
        layer.weight.copy_((layer.weight * layer.gain).half().float() / layer.gain)
        layer.bias.copy_(layer.bias.half().float())


@torch.no_grad()
def space_weights(space: Space, patch: int) -> SpaceWeights:
    """A torch space as plain arrays, learning-rate gains applied; transforms in noise texels per exemplar pixel."""
    encoder, mapping, sampler = space.encoder, space.mapping, space.sampler
    assert isinstance(sampler, Sampler)
    hidden, (weight, bias) = (_dense(layer) for layer in mapping.octaves)
    scale = (sampler.octave_scale.expand(sampler.directions.shape) / UNIT).flatten().numpy()  # [9n]
    octaves = [hidden, (weight * scale, (bias + sampler.directions.flatten().numpy()) * scale)]
    one = np.repeat(np.array([1, 0], np.float32), len(sampler.constant))  # of gamma, nothing of delta
    affine = [(weight, bias + one) for weight, bias in (_dense(layer) for layer in mapping.affine)]
    weights, biases = sampler_layers(sampler)
    output = (weights[-1], biases[-1]) if encoder.color_moments else None
    return SpaceWeights(
        weights=weights,
        biases=biases,
        encoder=EncoderWeights(
            [_kernel(layer) for layer in encoder.convolutions],
            [_dense(encoder.dense), _dense(encoder.code)],
            patch,
            encoder.color_moments,
        ),
        mapping=MappingWeights(
            octaves, [_dense(layer) for layer in mapping.style], affine, sampler.noise_weights.numpy(), output
        ),
    )


def _kernel(layer: nn.Module) -> Layer:
    assert isinstance(layer, Conv)
    return (layer.weight * layer.gain).numpy(), layer.bias.numpy()


def _dense(layer: nn.Module) -> Layer:
    assert isinstance(layer, Linear)
    return layer.effective_weight().T.numpy(), layer.bias.numpy()


@torch.no_grad()
def check_space_agreement(space: Space, weights: SpaceWeights) -> dict[str, float]:
    """The largest difference between torch in float64 and ONNX Runtime, graph by graph, each given the same input.

    Raises TrainingError if one exceeds `TOLERANCE`: of latent codes and colours as they are, of transforms and styles over
    their largest value.
    """
    exact = copy.deepcopy(space).double()
    patch = probe_patch(weights.encoder.patch)
    patches = np.stack([patch, patch[::-1], 1 - patch, np.full_like(patch, 0.3)])
    z = run_encoder(build_encoder_graph(weights.encoder), patches)
    differences = {"encoder.onnx": _largest(z, exact.encoder(_double(patches).permute(0, 3, 1, 2)))}
    textures = run_mapping(build_mapping_graph(weights.mapping), z, "", "")
    condition = exact.condition(_double(z))
    expected = (condition.transforms / UNIT, condition.gamma, condition.delta)
    found = [np.stack([texture.arrays()[key] for texture in textures]) for key in ("transforms", "gamma", "delta")]
    differences["mapping.onnx"] = max(
        _largest(mine, theirs) / max(float(theirs.abs().max()), 1.0) for mine, theirs in zip(found, expected, strict=True)
    )
    octaves = len(textures[0].transforms)
    sampler, points = build_sampler_graph(weights.weights, weights.biases, octaves), random_points(SEED)
    one, where = textures[0], _double(points)[None] / UNIT
    condition = Condition(_double(one.transforms)[None] * UNIT, _double(one.gamma)[None], _double(one.delta)[None])
    rgb = exact.sampler(runtime_noise(SEED, octaves, where), where, condition)[0]
    differences["sampler.onnx"] = _largest(run_graph(sampler, one, points, SEED), rgb)
    for graph, difference in differences.items():
        if not difference <= TOLERANCE:
            raise TrainingError(f"{graph}: torch and ONNX Runtime differ by {difference:.2g}, expected at most {TOLERANCE:g}")
    return differences


def _largest(found: FloatArray, expected: Tensor) -> float:
    return float(np.abs(found - expected.numpy()).max())


def _double(array: Any) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float64))


def provenance(run: SpaceRun, state: dict[str, Any]) -> dict[str, Any]:
    """What the manifest says about the training: every exemplar that it saw, and the names of those that it did not."""
    return {
        "exemplars": [
            {**vars(source), "sha256": pixels_sha256(member.pixels)}
            for source, member in zip(run.sources, run.trained_on, strict=True)
        ],
        "held_out": sorted(run.held_out),
        "iterations": state["iteration"],
        "minutes": round(state["seconds"] / 60, 1),
        "revision": run.revision,
        "settings": to_json(run.settings),
        "losses": next(reversed(run.stats_until(state["iteration"])), {}),
    }
