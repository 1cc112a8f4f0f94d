"""From a run directory to a bundle: the averaged weights, their provenance, and a proof that ONNX Runtime agrees."""

from __future__ import annotations

import copy
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import torch

from solidgrain.export.bundle import Details, DoubleArray, FloatArray, SamplerWeights, run_graph, write_bundle
from solidgrain.export.card import write_card
from solidgrain.export.sampler_graph import build_sampler_graph
from solidgrain.runtime.errors import TrainingError
from solidgrain.runtime.texture_file import TextureData
from solidgrain.train.colors import settle_mean
from solidgrain.train.noise import runtime_noise
from solidgrain.train.run import Run, RunFolder, open_run
from solidgrain.train.sampler import Sampler
from solidgrain.train.settings import to_json
from solidgrain.train.slices import UNIT
from solidgrain.train.task import make_task

SEED = 1  # of the noise in which they are compared
TOLERANCE = 1e-4  # largest difference in colour between torch and ONNX Runtime


def export_run(run_folder: Path, out: Path, name: str = "", overwrite: bool = False) -> Path:
    """Export a run's averaged weights as a single-exemplar bundle called `name`, by default the folder's own name.

    Raises TrainingError if the run has no checkpoint yet, or if torch and ONNX Runtime disagree by more than `TOLERANCE`
    near the origin or far from it; BundleError if the bundle cannot be written.
    """
    run = open_run(run_folder)
    state = trained_state(run)
    average = make_task(run, torch.device("cpu")).make_model(torch.Generator())
    assert isinstance(average, Sampler)
    try:
        average.load_state_dict(state["average"])
    except (RuntimeError, TypeError) as error:
        raise TrainingError(f"{run_folder}: the checkpoint does not fit the run's settings; start the run again") from error
    settle_mean(average, run.exemplar)
    weights = sampler_weights(average)
    check_agreement(average, weights)
    training = provenance(run, state)
    name = name or out.name
    card = write_card(name, training)
    details = Details(name=name, patch=run.settings.patch, training=training, card=card)
    return write_bundle(out, weights, details, overwrite)


def trained_state(run: RunFolder) -> dict[str, Any]:
    """A run's last checkpoint. Raises TrainingError if there is none, or if no bundle can hold it."""
    if run.settings.noise_at_input:
        raise TrainingError(
            f"{run.folder}: a run with --variant {run.settings.variant} feeds noise at the input, which a bundle cannot hold; "
            "look at its samples, or train with --variant paper"
        )
    state = run.load_checkpoint()
    if state is None:
        resume = f"solidgrain train --resume {shlex.quote(str(run.folder))}"
        raise TrainingError(f"{run.folder}: no checkpoint yet; let {resume} go on for a while")
    return state


@torch.no_grad()
def sampler_weights(sampler: Sampler) -> SamplerWeights:
    """A torch sampler as plain arrays. A single exemplar has no style: gamma is one and delta zero (Eq. 5)."""
    weights, biases = sampler_layers(sampler)
    shape = (len(sampler.hidden), len(sampler.constant))
    return SamplerWeights(
        weights=weights,
        biases=biases,
        transforms=copy.deepcopy(sampler).double().transforms().numpy() / UNIT,
        noise_weights=sampler.noise_weights.numpy(),
        gamma=np.ones(shape, np.float32),
        delta=np.zeros(shape, np.float32),
    )


@torch.no_grad()
def sampler_layers(sampler: Sampler) -> tuple[list[FloatArray], list[FloatArray]]:
    """Weights (x W) of all layers but the first, and biases of all: the first sees a constant, its product is a bias."""
    layers = [*sampler.hidden, sampler.output]
    weights = [layer.effective_weight().T.numpy() for layer in layers]
    biases = [layer.bias.numpy() for layer in layers]
    weights[-1] = weights[-1] @ sampler.color_axes.numpy()
    biases[-1] = sampler.color_mean.numpy() + biases[-1] @ sampler.color_axes.numpy()
    biases[0] = sampler.constant.numpy() @ weights[0] + biases[0]
    return weights[1:], biases


@torch.no_grad()
def check_agreement(sampler: Sampler, weights: SamplerWeights) -> float:
    """The largest difference in colour between torch, in float64, and ONNX Runtime over random points near and far.

    Raises TrainingError if it exceeds `TOLERANCE`.
    """
    octaves = len(weights.transforms)
    texture = TextureData("", "", weights.transforms, weights.gamma, weights.delta, weights.noise_weights)
    model = build_sampler_graph(weights.weights, weights.biases, octaves)
    exact, points = copy.deepcopy(sampler).double(), random_points(SEED)
    where = torch.from_numpy(points / UNIT)[None]
    expected = exact(runtime_noise(SEED, octaves, where), where)[0].numpy()
    worst = float(np.abs(run_graph(model, texture, points, SEED) - expected).max())
    if not worst <= TOLERANCE:
        raise TrainingError(f"torch and ONNX Runtime differ by {worst:.2g} in colour, expected at most {TOLERANCE:g}")
    return worst


def random_points(seed: int) -> DoubleArray:
    """Points within 64, 10^4 and 10^9 pixels of the origin, 2048 of each."""
    draw = np.random.default_rng(seed).uniform(-1, 1, (3, 2048, 3))
    points: DoubleArray = (draw * np.array([64.0, 1e4, 1e9])[:, None, None]).reshape(-1, 3)
    return points


def provenance(run: Run, state: dict[str, Any]) -> dict[str, Any]:
    """What the manifest says about the training."""
    return {
        "exemplars": [{**vars(run.source), "sha256": run.sha256}],
        "iterations": state["iteration"],
        "minutes": round(state["seconds"] / 60, 1),
        "revision": run.revision,
        "settings": to_json(run.settings),
        "last_patch": run.settings_at(state["iteration"] - 1).patch,
        "losses": next(reversed(run.stats_until(state["iteration"])), {}),
    }
