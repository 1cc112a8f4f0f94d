"""The known solids are solid and endless; comparing the truth with itself gives one, and with another solid more."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

pytest.importorskip("stlpips_pytorch", reason="the measures need VGG-16: pip install 'solidgrain[evaluate]'")

from solidgrain.train import preview
from solidgrain.train.exemplar import NONSTATIONARY, measure_grain, nonstationarity
from solidgrain.train.settings import preset
from solidgrain.train.slices import about_axis
from tests.bench import ground_truth, solids
from tests.bench.solids import SOLIDS, colors
from tests.train.test_training import TINY


@pytest.fixture
def small(monkeypatch):
    torch.set_num_threads(1)
    monkeypatch.setattr(preview, "SIZE", 32)
    for name, value in {"EXEMPLAR": 96, "CROP": 64, "TRUE_SLICES": 3, "SETTINGS": preset("fast", **TINY)}.items():
        monkeypatch.setattr(ground_truth, name, value)


def random_points(count=400):
    return np.random.default_rng(0).uniform(-1e4, 1e4, (count, 3))


@pytest.mark.parametrize("name", SOLIDS)
def test_a_solid_is_a_function_of_the_point_alone(name, monkeypatch):
    points = random_points()
    whole = colors(SOLIDS[name], points, 3)
    monkeypatch.setattr(solids, "CHUNK", 37)
    np.testing.assert_array_equal(colors(SOLIDS[name], points[::-1], 3)[::-1], whole)
    assert whole.dtype == np.float32
    assert whole.min() >= 0
    assert whole.max() <= 1
    assert np.abs(colors(SOLIDS[name], points, 4) - whole).mean() > 0.02


@pytest.mark.parametrize("name", SOLIDS)
def test_a_solid_hangs_together_in_all_three_directions(name):
    """Neighbours a tenth of a pixel apart have nearly the same colour, whichever way: no axis is a stack of pictures."""
    points = random_points()
    if name == "wood":
        points = points * (1, 0.02, 0.02)
    here = colors(SOLIDS[name], points, 0)
    for step in 0.1 * np.eye(3):
        assert np.abs(colors(SOLIDS[name], points + step, 0) - here).mean() < 0.02


@pytest.mark.parametrize("name", SOLIDS)
def test_the_exemplars_can_be_learned_from(name, monkeypatch):
    monkeypatch.setattr(ground_truth, "EXEMPLAR", 256)
    exemplar = ground_truth.exemplar_of(name)
    grain = measure_grain(exemplar)
    if name == "wood":
        assert grain.axis == "x"
        assert grain.ratio < 0.2
    else:
        assert grain.ratio > 0.5
        assert nonstationarity(exemplar) < 1.5 * NONSTATIONARY  # a quarter of the exemplar's area varies more than all of it


def test_isotropic_solids_look_the_same_in_every_direction():
    for name in ("granite", "marble"):
        points, lengths = random_points(3000), []
        for step in 6 * np.eye(3):
            lengths.append(np.abs(colors(SOLIDS[name], points + step, 0) - colors(SOLIDS[name], points, 0)).mean())
        assert max(lengths) / min(lengths) < 1.15


def test_gradient_noise_is_smooth_centred_and_zero_on_its_lattice():
    points = random_points(4000)
    values = solids.noise(points, 1)
    assert abs(values.mean()) < 0.03
    assert 0.3 < values.std() < 0.5
    assert np.abs(solids.noise(np.floor(points), 1)).max() < 1e-9
    assert np.abs(solids.noise(points + 1e-5, 1) - values).max() < 1e-3


def test_hashes_are_even_and_differ_by_seed():
    lattice = np.stack(np.meshgrid(*3 * [np.arange(-10, 10)]), -1).reshape(-1, 3)
    first, second = solids.unit(solids.hashed(lattice, 0)), solids.unit(solids.hashed(lattice, 1))
    assert abs(first.mean() - 0.5) < 0.02
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.05
    assert len(np.unique(solids.hashed(lattice, 0))) == len(lattice)


def test_fair_planes_of_wood_hold_the_grain_and_stay_near_the_exemplar_s():
    for seed in range(20):
        rotation = ground_truth.unseen("wood", torch.Generator().manual_seed(seed))
        torch.testing.assert_close(rotation[:, 0], torch.tensor([1.0, 0, 0]))
        assert rotation[1, 1] > np.cos(np.radians(30.1))
        torch.testing.assert_close(rotation, about_axis(0, torch.atan2(rotation[2, 1], rotation[1, 1])[None])[0])


def test_the_truth_itself_scores_one_and_another_solid_far_more(small, monkeypatch):
    monkeypatch.setattr(ground_truth, "TRUE_SLICES", 8)  # the Gram distances of three may be all alike by chance
    look = ground_truth.true("marble")
    itself = ground_truth.compare("marble", lambda seed, rotation: look(seed + 900, rotation), slices=4)
    other = ground_truth.compare("marble", ground_truth.true("granite"), slices=2)
    for measure in ("gram", "patches", "color"):
        assert 0.5 < itself["unseen"][measure][0] < 1.3
        assert other["unseen"][measure][0] > 2.5 * itself["unseen"][measure][0]
    assert itself["orientation"]["gram"][0] < 2
    assert 0.5 < itself["seen_floor"]["gram"] < 2


def test_a_comparison_is_made_once_and_goes_on_where_it_was_stopped(small, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(ground_truth, "SOLIDS", {name: SOLIDS[name] for name in ("granite", "wood")})
    flags = ["--iterations", "1", "--threads", "1", "--slices", "1", "--out", str(tmp_path)]
    ground_truth.main(flags)
    before = (tmp_path / "granite.json").stat().st_mtime_ns
    (tmp_path / "wood.json").unlink()
    ground_truth.main([*flags, "--resume"])
    assert (tmp_path / "granite.json").stat().st_mtime_ns == before
    found = json.loads((tmp_path / "table.json").read_text())
    assert found["wood"]["settings"]["grain"] == "x"
    assert set(found["granite"]["quality"]) >= {"floor", "seen", "unseen", "orientation", "seen_floor"}
    assert "| measure | floor of the truth | unseen planes |" in capsys.readouterr().out
    assert (tmp_path / "wood.png").exists()
