"""A space's run and the bundle that is exported from it say the same."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from solidgrain.export.from_space_run import export_space_run
from solidgrain.runtime import TrainingError, load_space
from solidgrain.train.loop import Trainer
from solidgrain.train.noise import runtime_noise
from solidgrain.train.slices import UNIT
from tests.train.spaces import new_space, photographs
from tests.train.test_training import CPU


@pytest.mark.parametrize("changes", [{}, {"principal_colors": False, "color_moments": False}])
def test_a_bundle_shows_what_the_run_shows(tmp_path, changes):
    """Through the task's own model: what of it is no part of a checkpoint, the exemplars' colours, counts as well."""
    torch.set_num_threads(1)
    run = new_space(tmp_path / "run", photographs(tmp_path / "stones", 3), octaves=16, resolution=64, **changes)
    trainer = Trainer(run, CPU)
    with torch.no_grad():
        trainer.average.sampler.noise_weights *= 0.5  # at the start colours are far out of [0, 1], and so is what halves miss
    trainer.save()
    patch = run.trained_on[0].exemplar[:128, :128]
    texture = load_space(export_space_run(run.folder, tmp_path / "bundle")).encode(patch)
    points = np.random.default_rng(2).uniform(0, 200, (500, 3))
    average, octaves = trainer.average, run.settings.octaves
    where, seen = torch.from_numpy(points / UNIT).float()[None], torch.from_numpy(patch.copy()).permute(2, 0, 1)[None]
    expected = average(runtime_noise(5, octaves, where), where, seen)[0].clamp(0, 1).numpy()
    assert expected.std() > 0.02
    assert np.abs(texture.sample(points, 5) - expected).max() < 0.02  # the encoder's weights are halves in the bundle


def test_a_run_without_a_checkpoint_is_no_bundle_yet(tmp_path):
    with pytest.raises(TrainingError, match="no checkpoint yet"):
        export_space_run(new_space(tmp_path / "run", members=3).folder, tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()
