"""A training stops when a critic that stands still sees its slices come no nearer to the exemplar."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from solidgrain.train import loop, plateau, task
from solidgrain.train.loop import Trainer, train
from solidgrain.train.plateau import EVERY, LEAST, Onlooker, Plateau
from solidgrain.train.run import open_run
from solidgrain.train.settings import Budget
from tests.train.conftest import blotches
from tests.train.test_training import CPU, assert_same_checkpoint, new_run


def seen(distances):
    """A plateau that has seen these, one after the other."""
    found = Plateau()
    for k, distance in enumerate(distances):
        found.see(distance, (k + 1) * EVERY)
    return found


def test_it_waits_half_as_long_as_it_took_to_get_there():
    falling = seen([*np.linspace(1, 0.1, 40), *[0.5] * 20])  # the lowest after 1000 iterations
    assert falling.at == 40 * EVERY == 1000
    assert not falling.reached(1499)
    assert falling.reached(1500)


def test_it_waits_long_enough_at_the_start():
    waiting = seen([0.5, *[0.6] * (LEAST // EVERY)])
    assert not waiting.reached(EVERY + LEAST - 1)
    assert waiting.reached(EVERY + LEAST)


def test_a_hair_lower_is_no_progress():
    assert seen([0.5, 0.499, 0.495]).at == EVERY
    assert seen([0.5, 0.499, 0.465]).at == 3 * EVERY


def test_one_low_look_is_luck():
    lucky = seen([0.5] * 20 + [0.3] + [0.45] * 10)
    assert lucky.lowest > 0.43
    assert lucky.at > 21 * EVERY


class Copies(torch.nn.Module):
    """A model whose slices are the exemplar's own patches, or noise, or anything between."""

    def __init__(self, pixels, noise):
        super().__init__()
        self.pixels, self.noise, self.generator = torch.from_numpy(pixels), noise, torch.Generator().manual_seed(3)

    def forward(self, noise, points):
        size = round(points.shape[1] ** 0.5)
        top, left = torch.randint(0, 160 - size, (2,), generator=self.generator).tolist()
        patch = self.pixels[top : top + size, left : left + size].reshape(1, -1, 3).repeat(len(points), 1, 1)
        return patch + self.noise * torch.randn(patch.shape, generator=self.generator)


def test_the_onlooker_tells_better_slices_from_worse(tmp_path, photograph):
    settings, pixels = new_run(tmp_path / "run", photograph).settings, blotches(160, 160)
    onlooker = Onlooker(settings, pixels, CPU)
    distances = [onlooker.distance(Copies(pixels, noise)) for noise in (0.0, 0.1, 0.3)]
    assert 0 <= distances[0] < distances[1] < distances[2]


@pytest.fixture
def told(monkeypatch):
    """An onlooker that is told what to see: nothing gets better after the second look, which is at iteration 4."""
    looks = []

    class Told:
        def __init__(self, *_):
            pass

        def distance(self, average):
            looks.append(average)
            return {1: 0.5, 2: 0.4}.get(len(looks), 0.45)

    monkeypatch.setattr(task, "Onlooker", Told)
    monkeypatch.setattr(loop, "EVERY", 2)
    monkeypatch.setattr(plateau, "LEAST", 6)
    monkeypatch.setattr(loop, "_write_sample", lambda trainer: None)
    return looks


def test_a_training_stops_on_a_plateau_and_resumes_to_the_same(tmp_path, photograph, told):
    asked = Budget(iterations=50, until_plateau=True)
    whole = new_run(tmp_path / "whole", photograph)
    train(whole, asked, CPU)
    assert Trainer(whole, CPU).iteration == 0
    assert whole.load_checkpoint()["iteration"] == 10  # 4 for the second look, 6 without another low
    assert len(told) == 5

    told.clear()
    parts = new_run(tmp_path / "parts", photograph)
    train(parts, Budget(iterations=7, until_plateau=True), CPU)
    train(open_run(parts.folder), asked, CPU)
    assert_same_checkpoint(parts.folder, whole.folder)


def test_nothing_is_a_plateau_that_was_not_looked_at(tmp_path, photograph, told):
    assert not Plateau().reached(10_000)
    stale = seen([0.1])
    assert not stale.reached(10_000)
    stale.see(0.2, 10_000)
    assert (stale.lowest, stale.at) == (0.2, 10_000)

    run = new_run(tmp_path / "run", photograph)
    train(run, Budget(iterations=12), CPU)
    assert not told
    ending = train(open_run(run.folder), Budget(iterations=50, until_plateau=True), CPU)
    assert len(told) > 1
    assert ending.iteration > 12


def test_without_being_asked_it_goes_on_and_nobody_looks(tmp_path, photograph, told):
    run = new_run(tmp_path / "run", photograph)
    train(run, Budget(iterations=12), CPU)
    assert run.load_checkpoint()["iteration"] == 12
    assert not told


def test_the_flag_is_part_of_the_run(tmp_path, photograph, solidgrain, told):
    outcome = solidgrain(
        "train", photograph, "--out", tmp_path / "run", "--patch", 32, "--batch", 1, "--iterations", 40, "--until-plateau"
    )
    assert outcome.code == 0
    assert "done after 10 iterations" in outcome.err
    budget = json.loads((tmp_path / "run" / "options.json").read_text("utf-8"))["budget"]
    assert budget == {"iterations": 40, "minutes": None, "until_plateau": True}


def test_a_space_has_no_plateau(tmp_path, photograph, solidgrain):
    outcome = solidgrain("train", "--space", photograph.parent, "--out", tmp_path / "run", "--until-plateau")
    assert outcome.code == 2
    assert "--until-plateau" in outcome.err
    assert not (tmp_path / "run").exists()
