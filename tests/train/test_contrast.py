"""D sees faint exemplars at full contrast and others as they are, photographs and slices alike."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from solidgrain.train.companion import seen_settings
from solidgrain.train.contrast import stretch_to, together
from solidgrain.train.loop import Trainer
from solidgrain.train.settings import FAST, Settings
from tests.train.conftest import blotches
from tests.train.spaces import new_space, photographs
from tests.train.test_training import CPU, new_run

COLORS = blotches(64, 64)


def faint(factor):
    return (0.4 + factor * (COLORS - 0.4)).astype(np.float32)


def image(pixels):
    return torch.from_numpy(pixels).permute(2, 0, 1)[None]


def deviation(images):
    return (images - images.mean((2, 3), keepdim=True)).square().mean((1, 2, 3)).sqrt()


@pytest.mark.parametrize("factor", [0.02, 0.2, 0.7])
def test_a_faint_exemplar_is_stretched_about_its_mean_colour(factor):
    seen = stretch_to(0.15, faint(factor), CPU)(image(faint(factor)))
    torch.testing.assert_close(seen.mean((2, 3)), image(faint(factor)).mean((2, 3)), atol=1e-5, rtol=0)
    assert deviation(seen).item() == pytest.approx(0.15, rel=1e-3)


@pytest.mark.parametrize("contrast", [0.0, 0.05])
def test_one_that_is_strong_enough_stays_as_it_is(contrast):
    torch.testing.assert_close(stretch_to(contrast, COLORS, CPU)(image(COLORS)), image(COLORS))


def test_an_exemplar_of_one_colour_is_no_division_by_zero():
    flat = np.full((8, 8, 3), 0.3, np.float32)
    torch.testing.assert_close(stretch_to(0.15, flat, CPU)(image(flat)), image(flat))


def test_each_image_of_a_batch_has_its_own():
    pair = together([stretch_to(0.15, faint(factor), CPU) for factor in (0.1, 0.3)])
    images = torch.cat([image(faint(factor)) for factor in (0.1, 0.3)])
    torch.testing.assert_close(deviation(pair(images)), torch.full((2,), 0.15), rtol=1e-3, atol=0)


def test_slices_and_patches_of_a_training_are_stretched_alike(tmp_path, photograph):
    trainer = Trainer(new_run(tmp_path / "run", photograph, critic_contrast=5.0), CPU)
    batch = trainer.task.draw(0, trainer.generator)
    assert batch.stretch.gain.item() > 10
    assert deviation(batch.stretch(batch.real)).min() > 10 * deviation(batch.real).min()


def test_a_space_stretches_each_exemplar_by_itself(tmp_path):
    trainer = Trainer(new_space(tmp_path / "space", photographs(tmp_path / "stones", 3), critic_contrast=0.5), CPU)
    batch = trainer.task.draw(0, trainer.generator)
    assert batch.stretch.gain.shape == (len(batch.real), 1, 1, 1)
    torch.testing.assert_close(deviation(batch.stretch(batch.real)), batch.stretch.gain.flatten() * deviation(batch.real))
    assert (batch.stretch.gain > 1).all()


def test_a_critic_that_does_not_say_saw_the_colours_themselves():
    assert FAST.critic_contrast > 0
    assert seen_settings({"patch": 64}).critic_contrast == Settings().critic_contrast == 0
