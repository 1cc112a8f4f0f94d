"""The page of the embedded textures: measured against the right photographs, and nothing that was found is lost."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="measuring needs torch: pip install 'solidgrain[evaluate]'")
pytest.importorskip("stlpips_pytorch", reason="the measures need VGG-16: pip install 'solidgrain[evaluate]'")

import OpenImageIO as oiio

from docs import textures
from docs.embedded import find_photograph
from solidgrain.export.bundle import Details, write_bundle
from solidgrain.export.evaluation import Measured
from solidgrain.runtime import ExemplarError, UsageError, bundle
from solidgrain.runtime.bundle import open_bundle
from solidgrain.train import copying
from solidgrain.train.copying import Copying
from solidgrain.train.photograph import read_exemplar
from solidgrain.train.quality import Evaluation
from solidgrain.train.run import pixels_sha256
from tests.toy import toy_weights
from tests.train.conftest import blotches

NAMES = ("pebbles", "planks")
Made = Any


def photograph(path: Path, brightness: float) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    oiio.ImageBuf(np.ascontiguousarray(brightness * blotches(64, 64))).write(os.fspath(path), oiio.UINT8)
    return path


def embed(root: Path, name: str, exemplar: Path, seed: int) -> None:
    source = {"exemplar": exemplar.name, "license": "CC0-1.0", "credit": f"who took {name}"}
    training = {
        "exemplars": [{**source, "sha256": pixels_sha256(read_exemplar(exemplar, 64))}],
        "iterations": 12345,
        "minutes": 6.7,
        "settings": {"grain": "x" if name == "planks" else "none"},
    }
    write_bundle(root / name, toy_weights(seed=seed), Details(name=name, patch=64, training=training), overwrite=True)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two embedded textures, their photographs, and what `make textures` makes of them where measuring is quick."""
    root = tmp_path_factory.mktemp("textures")
    (root / "docs").mkdir()
    for seed, name in enumerate(NAMES):
        exemplar = photograph(root / "photographs" / f"folder {seed}" / f"{name}.png", 1 - 0.2 * seed)
        embed(root / "embedded", name, exemplar, seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(textures, "measure", measured)
        run(root, patch)
    return root


def measured(texture, exemplar, slices):
    """Stands in for `measure`: a texture is as far from its photograph as that is bright."""
    bright = float(exemplar.mean())
    found = {"gram": (bright, 0.25), "vgg_frechet": (1 + bright, 0.5)}
    floor, turned = {"gram": 0.125, "vgg_frechet": 2.5}, {"gram": 1.0, "vgg_frechet": 1.0}
    return Measured(Evaluation(64, slices, floor, found, found, turned), Copying(256, 0.1, 1.25, 0.004), [])


@pytest.fixture
def made(finished: Path, tmp_path: Path) -> Path:
    """A copy to change."""
    shutil.copytree(finished, tmp_path / "made")
    return tmp_path / "made"


def run(root: Path, patch: pytest.MonkeyPatch, *flags: str) -> None:
    patch.setattr(bundle, "_embedded_root", lambda: root / "embedded")
    where = ["--exemplars", f"{root}/photographs", "--out", f"{root}/docs"]
    textures.main([*where, "--slices", "1", "--threads", "1", *flags])


def found(root: Path) -> Made:
    return json.loads((root / "docs" / "textures.json").read_text("utf-8"))


def section(root: Path, name: str) -> str:
    page = (root / "docs" / "textures.md").read_text("utf-8")
    return page.split(f"\n## {name}\n")[1].split("\n## ")[0]


def check_figures(root: Path, name: str) -> None:
    """That the page and the card hold what the data holds."""
    card = (root / "embedded" / name / "card.md").read_text("utf-8")
    figures = found(root)[name]
    for measure, floor in figures["floor"].items():
        axis, oblique = (
            f"{mean:.2f} ± {spread:.2f}" for mean, spread in (figures["axis"][measure], figures["oblique"][measure])
        )
        turned = f"{figures['turned'][measure]:.2f} | " if figures["turned"] else ""
        row = f"| {measure} | {floor:.4g} | {turned}{axis} | {oblique} |"
        assert row in section(root, name)
        assert row in card
    assert f"{figures['copying']['ratio']:.2f} times as far" in section(root, name)


@pytest.mark.parametrize(("name", "bright"), [("pebbles", 0.5), ("planks", 0.4)])
def test_page_and_card_hold_what_was_found_against_the_texture_s_own_photograph(finished, name, bright):
    check_figures(finished, name)
    assert found(finished)[name]["axis"]["gram"][0] == pytest.approx(bright, abs=0.02)


def test_textures_are_measured_as_solidgrain_evaluate_does(made, monkeypatch, solidgrain):
    monkeypatch.setattr(copying, "MOST", 32)
    run(made, monkeypatch, "--only", "planks")
    check_figures(made, "planks")
    exemplar = made / "photographs" / "folder 1" / "planks.png"
    outcome = solidgrain(
        "evaluate", made / "embedded" / "planks", "--exemplar", exemplar, "--slices", 1, "--threads", 1, "--json"
    )
    figures = found(made)["planks"]
    assert figures.pop("files").keys() == {"sampler.onnx", "texture.sgt.npz"}
    evaluated = json.loads(outcome.out)
    assert figures == {name: evaluated[name] for name in figures}


def test_the_page_says_whose_photographs_they_are_and_how_long_was_trained(finished):
    page = (finished / "docs" / "textures.md").read_text("utf-8")
    assert "| [planks](#planks) | `planks.png` | CC0-1.0 | who took planks |" in page
    assert "12,345 iterations, 6.7 minutes; slices turned about the x axis only" in section(finished, "planks")
    assert "slices turned freely" in section(finished, "pebbles")


def test_measuring_one_keeps_the_others_figures(made, monkeypatch):
    before = found(made)
    monkeypatch.setattr(textures, "measure", only_once(measured))
    run(made, monkeypatch, "--only", "planks", "--slices", "2")
    assert found(made)["pebbles"] == before["pebbles"]
    assert (found(made)["planks"]["slices"], before["planks"]["slices"]) == (2, 1)
    assert "over 1 slices" in section(made, "pebbles")
    assert "over 2 slices" in section(made, "planks")


def only_once(function):
    calls = []

    def call(*arguments):
        assert not calls, "measured twice"
        calls.append(arguments)
        return function(*arguments)

    return call


def test_a_photograph_with_other_pixels_is_refused_before_anything_is_measured(made, monkeypatch):
    photograph(made / "photographs" / "folder 1" / "planks.png", 0.5)
    monkeypatch.setattr(textures, "measure", None)
    with pytest.raises(ExemplarError, match=r"^.*planks\.png: not the photograph that planks was learned from.*$"):
        run(made, monkeypatch)


def test_a_photograph_that_was_reduced_is_known_by_its_own_pixels(tmp_path):
    path = photograph(tmp_path / "large.png", 0.9)
    source = {"exemplar": path.name, "scale": 1.5, "sha256": "of another processor"}
    training = {"exemplars": [{**source, "photograph_sha256": pixels_sha256(read_exemplar(path, 64))}], "settings": {}}
    write_bundle(tmp_path / "toy", toy_weights(), Details(name="toy", patch=64, training=training))
    assert find_photograph(open_bundle(tmp_path / "toy"), tmp_path).shape == (43, 43, 3)


def test_of_photographs_of_one_name_the_right_one_is_found(made):
    photograph(made / "photographs" / "another" / "planks.png", 0.5)
    planks = bundle.open_bundle(made / "embedded" / "planks")
    pixels = find_photograph(planks, made / "photographs")
    assert pixels is not None
    assert pixels.mean() == pytest.approx(0.4, abs=0.02)


def test_a_missing_photograph_is_a_line_and_its_texture_keeps_its_figures(made, monkeypatch, capsys):
    before = {path.name: path.read_bytes() for path in (made / "docs").iterdir()}
    shutil.rmtree(made / "photographs")
    run(made, monkeypatch)
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition(" in ")[0] for line in lines] == ["pebbles: no pebbles.png", "planks: no planks.png"]
    assert {path.name: path.read_bytes() for path in (made / "docs").iterdir()} == before


def test_figures_of_a_texture_that_was_trained_anew_are_forgotten(made, monkeypatch):
    embed(made / "embedded", "planks", made / "photographs" / "folder 1" / "planks.png", seed=9)
    shutil.rmtree(made / "photographs")
    run(made, monkeypatch)
    assert found(made).keys() == {"pebbles"}
    assert "Not measured yet." in section(made, "planks")


def test_resuming_measures_only_what_is_left(made, monkeypatch):
    before = found(made)
    (made / "docs" / "textures.json").write_text(json.dumps({"planks": before["planks"]}), "utf-8")
    monkeypatch.setattr(textures, "measure", only_once(measured))
    run(made, monkeypatch, "--resume")
    assert found(made) == before


def test_a_name_that_is_not_embedded_is_refused(made, monkeypatch):
    with pytest.raises(UsageError, match=r"--only plank: .*expected one of pebbles, planks"):
        run(made, monkeypatch, "--only", "plank")
