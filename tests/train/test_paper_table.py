"""The paper's table at a toy's size: every cell is trained, measured, kept, and never made twice."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

pytest.importorskip("stlpips_pytorch", reason="the measures need VGG-16: pip install 'solidgrain[evaluate]'")

from solidgrain.runtime import UsageError
from solidgrain.train import preview
from solidgrain.train.settings import FAST, PAPER, preset
from solidgrain.train.variants import vary
from tests.bench import cells, paper_table
from tests.train.conftest import blotches
from tests.train.test_training import TINY

NAMES = ("a0b1", "noise-at-input", "paper")
ONCE = ["--iterations", "1", "--threads", "1", "--slices", "1"]


@pytest.fixture
def small(monkeypatch):
    """Three of the methods, at the size of a toy."""
    torch.set_num_threads(1)
    monkeypatch.setattr(preview, "SIZE", 32)
    tiny = preset("fast", **TINY)
    columns = {name: vary(tiny, name) for name in NAMES}
    monkeypatch.setattr(paper_table, "COLUMNS", columns)


@pytest.fixture
def flags(tmp_path):
    """Two exemplars as files, and where the results go."""
    grained = np.repeat(blotches(128, 32), 4, axis=1)
    for name, pixels in (("wood", grained), ("granite", blotches(128, 128))):
        oiio.ImageBuf(np.ascontiguousarray(pixels)).write(os.fspath(tmp_path / f"{name}.png"), oiio.UINT8)
    photographs = ["--wood", f"{tmp_path}/wood.png", "--granite", f"{tmp_path}/granite.png"]
    return [*ONCE, "--out", f"{tmp_path}/out", *photographs]


def test_a_table_is_made_once_and_goes_on_where_it_was_stopped(small, flags, tmp_path, capsys, monkeypatch):
    made = []
    keep = cells.keep

    def stop_after_three(path, result):
        keep(path, result)
        if path.stem in NAMES:
            made.append(f"{path.parent.name}/{path.stem}")
            if len(made) == 3:
                raise KeyboardInterrupt

    monkeypatch.setattr(cells, "keep", stop_after_three)
    assert cells.reported(lambda: paper_table.main(flags)) == 130
    assert cells.reported(lambda: paper_table.main(flags)) == 2  # not without --resume
    paper_table.main([*flags, "--resume"])
    assert made == [f"{kind}/{name}" for kind in ("wood", "granite") for name in NAMES]

    out = capsys.readouterr().out
    assert "| SIFID × 10⁵ (the paper, Table 1) | 0.67 ± 0.42 | 0.19 ± 0.04 |" in out
    assert "- the paper's SIFID: α:0 β:1 < α:0.1 β:1 < GAN+VGG < NI < α:1 β:0 < Henzler et al." in out
    assert out == (tmp_path / "out" / "table.md").read_text() + "\n"
    found = json.loads((tmp_path / "out" / "table.json").read_text())
    assert found["wood"]["cells"]["paper"]["settings"]["grain"] == "x"
    assert found["granite"]["cells"]["paper"]["settings"]["grain"] == "none"
    assert -1 <= found["granite"]["rank_correlation"]["gram"] <= 1
    assert found["granite"]["cells"]["noise-at-input"]["quality"]["oblique"]["gram"][0] > 0
    strip = oiio.ImageBuf(f"{tmp_path}/out/wood.png").spec()
    assert (strip.height, strip.width) == (256, 4 * 264)

    with pytest.raises(UsageError, match="other slices"):
        paper_table.main([*flags, "--resume", "--slices", "2"])


def test_a_run_that_diverges_is_a_result_and_not_the_end(small, flags, tmp_path, monkeypatch):
    monkeypatch.setattr(paper_table, "COLUMNS", {"paper": paper_table.COLUMNS["paper"]})
    step = cells.train

    def diverge(run, budget, device, **more):
        if run.folder.parent.name == "wood":
            raise cells.TrainingError(f"{run.folder}: the training diverged at iteration 1")
        return step(run, budget, device, **more)

    monkeypatch.setattr(cells, "train", diverge)
    paper_table.main(flags)
    found = json.loads((tmp_path / "out" / "table.json").read_text())
    assert "diverged" in found["wood"]["cells"]["paper"]["diverged"]
    assert "quality" not in found["wood"]["cells"]["paper"]
    assert found["granite"]["cells"]["paper"]["diverged"] == ""


def test_a_missing_exemplar_is_refused_before_anything_is_made(small, tmp_path, capsys):
    flags = [*ONCE, "--out", str(tmp_path / "out"), "--wood", str(tmp_path / "none.png")]
    assert cells.reported(lambda: paper_table.main(flags)) == 2
    assert "give a photograph of wood" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_columns_are_the_paper_s_methods_and_its_own_settings():
    assert list(paper_table.COLUMNS) == [*paper_table.SIFID["wood"], "paper-preset"]
    losses = {"alpha": 0.1, "alpha_half_life": 0.0, "gram_energy": False, "color_weight": 0.0}
    shared = {"critic_start": "", "sampler_start": "", "sampler_rate": 2e-3, "octaves": 16, "later_patch": 0}
    assert paper_table.COLUMNS["paper"] == replace(FAST, **losses, **shared)
    assert paper_table.COLUMNS["paper-preset"] == PAPER


def test_rank_correlation_is_one_for_the_paper_s_own_figures_and_minus_one_for_their_opposite():
    theirs = paper_table.sifid_means("granite")
    assert paper_table.correlation("granite", theirs) == 1
    assert paper_table.correlation("granite", {name: -value for name, value in theirs.items()}) == -1
    assert paper_table.correlation("granite", {"paper": 1.0, "a0b1": 2.0}) is None


def test_sifid_stands_below_the_paper_s_as_the_paper_prints_it():
    quality = {"floor": {"sifid": 2e-6}, "oblique": {"sifid": [1.5, 0.25]}}
    cell = {"quality": quality, "iterations": 1, "minutes": 1.0, "diverged": ""}
    lines = paper_table.table("wood", {"paper": cell}, {"sifid": None}).splitlines()
    assert lines[3] == "| SIFID × 10⁵ | – | – | – | – | – | 0.30 ± 0.05 | – |"
    assert lines[4] == "| sifid / floor | – | – | – | – | – | 1.50 ± 0.25 | – |"


def test_sittings_end_with_a_checkpoint_every_few_minutes():
    minutes = [sitting.minutes for sitting in cells._sittings(cells.Budget(None, 12), 4.5)]
    assert minutes == [9.5, 12]


def test_large_photographs_are_reduced_by_a_whole_factor(tmp_path):
    oiio.ImageBuf(blotches(1100, 1300)).write(os.fspath(tmp_path / "large.png"), oiio.UINT8)
    assert paper_table.photograph("wood", tmp_path / "large.png").shape == (550, 650, 3)
