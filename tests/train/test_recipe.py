"""The recipe's table: rows differ in what they say, every mark is measured once, and what is finished is kept."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

pytest.importorskip("stlpips_pytorch", reason="the measures need VGG-16: pip install 'solidgrain[evaluate]'")

from solidgrain.train import preview
from solidgrain.train.quality import Evaluation
from solidgrain.train.settings import FAST, PAPER, preset
from tests.bench import cells, recipe
from tests.train.conftest import blotches
from tests.train.test_training import TINY


@pytest.fixture
def small(monkeypatch, tmp_path):
    """Two rows and one exemplar, at the size of toys; the flags of the command."""
    torch.set_num_threads(1)
    monkeypatch.setattr(preview, "SIZE", 32)
    tiny = preset("fast", **TINY)
    quality = dict.fromkeys(("vgg_frechet", "gram"), (1.0, 0.0))
    floor, turned = {"vgg_frechet": 0.1, "gram": 0.1}, {"vgg_frechet": 1.5, "gram": 1.2}
    monkeypatch.setattr(recipe, "evaluate", lambda *_: Evaluation(64, 1, floor, quality, quality, turned))
    monkeypatch.setattr(recipe, "ROWS", {"fast": ("the preset", tiny), "colors": ("plain", tiny)})
    cells.write_png(tmp_path / "blotches.png", np.kron(blotches(128, 150), np.ones((1, 2, 1), np.float32)))
    where = ["--out", str(tmp_path / "out"), "--exemplar", str(tmp_path / "blotches.png")]
    return [*where, "--marks", "0.01,0.02", "--slices", "1", "--seeds", "1", "--threads", "1"]


def differences(one, other):
    return {name for name, value in asdict(one).items() if value != asdict(other)[name]}


def test_every_departure_of_the_preset_from_the_paper_has_its_row_and_no_row_departs_further():
    changed = {row: differences(settings, FAST) for row, (_, settings) in recipe.ROWS.items()}
    assert [row for row in changed if not changed[row]] == ["fast"]
    assert set.union(*changed.values()) == differences(FAST, PAPER) - {"preset"}
    for row, names in changed.items():
        assert differences(recipe.ROWS[row][1], PAPER) == differences(FAST, PAPER) - names


def test_the_table_has_every_row_at_every_mark_and_a_second_start_changes_nothing(small, tmp_path, capsys):
    recipe.main(small)
    printed = capsys.readouterr().out
    lines = [line.split("|") for line in printed.splitlines() if line.startswith("|") and not line.startswith("|---")]
    assert [line[1].strip() for line in lines if line[1].strip()] == [
        *("the preset", "plain"),
        *("the preset, 0.01 minutes: axis-aligned / oblique", "blotches-0"),
        *("the preset, 0.02 minutes: axis-aligned / oblique", "blotches-0"),
    ]
    assert lines[1][2:6] == 4 * [" 1.00 "]
    for line in lines[4], lines[6]:
        assert line[3:6] == [" 1.00 / 1.00 ", " 1.00 / 1.00 ", " 1.50 "]
    found = json.loads((tmp_path / "out" / "table.json").read_text())
    assert {row: len(marks) for row, marks in found.items()} == {"fast": 2, "colors": 2}
    curves = oiio.ImageBuf(f"{tmp_path}/out/curves.png").spec()
    assert (curves.width, curves.height) == (1200, 600)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*-0-*.json")}
    recipe.main([*small, "--resume"])
    assert before == {path: path.stat().st_mtime_ns for path in before}


def test_the_preset_s_table_ends_with_median_and_worst():
    def cell(name, value):
        quality = {"axis": {"gram": (value, 0)}, "oblique": {"gram": (2 * value, 0)}}
        quality |= {"floor": {"gram": 1.0}, "turned": {"vgg_frechet": 1.0}}
        return {"exemplar": name, "mark": 5.0, "iterations": int(100 * value), "quality": quality}

    measured = {f"{value}": cell(f"stone{value}", value) for value in (1.0, 4.0, 2.0)} | {
        "early": cell("a", 9.0) | {"mark": 2.0}
    }
    median, worst = recipe.exemplars_table(measured, 5.0, "minutes").splitlines()[-2:]
    assert median == "| median | 200 | 2.00 / 4.00 |  |"
    assert worst == "| worst |  | 4.00 / 8.00 |  |"


def test_what_another_seed_changes_is_said_of_those_that_have_all_photographs():
    def cell(seed, mark, figure):
        figures = dict.fromkeys(recipe.SHOWN, (figure, 0.0))
        return {"mark": mark, "quality": {"oblique": figures}, "settings": {"seed": seed}}

    first, second = ({f"{name}-{seed}": cell(seed, 1, figure) for name in "ab"} for seed, figure in ((0, 1.0), (1, 1.1)))
    third = {"a-2": cell(2, 1, 5.0)}
    assert recipe.chance({"fast": first | second | third}, [1, 2]).endswith("changes by 10% (median; 10% at most).")
    assert not recipe.chance({"fast": first}, [1])


def test_curves_are_of_rows_or_of_the_exemplars_of_one_row():
    def cell(exemplar, seed, mark, figure):
        figures = dict.fromkeys(recipe.SHOWN, (figure, 0.0))
        return {"exemplar": f"{exemplar}-{seed}", "mark": mark, "quality": {"oblique": figures}, "settings": {"seed": seed}}

    made = [("a", 0, 1, 2.0), ("b", 0, 1, 8.0), ("a", 1, 1, 3.0), ("b", 1, 1, 3.0), ("a", 0, 2, 1.0), ("b", 0, 2, 1.0)]
    preset_alone = {"fast": {f"{exemplar}-{seed}-{mark}": cell(exemplar, seed, mark, f) for exemplar, seed, mark, f in made}}
    of_exemplars = recipe.over_time(preset_alone, "gram", [1, 2, 4])
    assert of_exemplars == {"a": {1: pytest.approx([2, 3]), 2: [1]}, "b": {1: pytest.approx([8, 3]), 2: [1]}}
    of_rows = recipe.over_time(preset_alone | {"critic": {"a-0-1": cell("a", 0, 1, 5.0)}}, "gram", [1, 2, 4])
    assert of_rows == {
        "the preset": {1: pytest.approx([4, 3]), 2: [1]},
        "D starts from N(0,1)": {1: pytest.approx([5])},
    }


def test_marks_may_be_iterations(small, tmp_path, capsys):
    flags = ["2,3" if flag == "0.01,0.02" else flag for flag in small]
    recipe.main([*flags, "--by", "iterations", "--only", "fast"])
    found = json.loads((tmp_path / "out" / "table.json").read_text())["fast"]
    assert [cell["iterations"] for cell in found.values()] == [2, 3]
    assert "the preset, 3 iterations: axis-aligned / oblique" in capsys.readouterr().out


def test_what_another_version_s_settings_made_is_not_mixed_with_today_s(small, tmp_path, capsys, monkeypatch):
    recipe.main(small)
    changed = {row: (title, replace(settings, alpha=0.5)) for row, (title, settings) in recipe.ROWS.items()}
    monkeypatch.setattr(recipe, "ROWS", changed)
    assert cells.reported(lambda: recipe.main([*small, "--resume"])) == 2
    assert "blotches-0-0.01.json is of other settings" in capsys.readouterr().err


def test_two_photographs_of_one_name_are_refused(small, tmp_path, capsys):
    assert cells.reported(lambda: recipe.main([*small, "--anisotropic", str(tmp_path / "blotches.png")])) == 2
    assert "two photographs of the same name (blotches, blotches)" in capsys.readouterr().err


def test_half_an_iteration_is_refused_in_one_line(small, tmp_path, capsys):
    assert cells.reported(lambda: recipe.main([*small, "--by", "iterations"])) == 2
    assert "--marks 0.01,0.02: expected whole numbers of iterations" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_run_is_refused_in_one_line(small, tmp_path, capsys):
    assert cells.reported(lambda: recipe.main([*small, "--exemplar", str(tmp_path / "none.png")])) == 2
    assert "no such file" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_photographs_with_a_grain_take_the_place_of_the_three_too(small, tmp_path):
    flags = ["--anisotropic" if flag == "--exemplar" else flag for flag in small]
    recipe.main([*flags, "--only", "fast"])
    found = json.loads((tmp_path / "out" / "table.json").read_text())["fast"]
    assert [cell["exemplar"] for cell in found.values()] == ["blotches-0", "blotches-0"]
    assert all(cell["settings"]["grain"] != "none" for cell in found.values())


def test_a_setting_may_be_another_one_in_all_rows(small, tmp_path, capsys):
    flags = [*("2" if flag == "0.01,0.02" else flag for flag in small), "--by", "iterations"]
    recipe.main([*flags, "--set", "sampler_rate=8e-3", "--set", "gram_energy=false"])
    for cell in json.loads((tmp_path / "out" / "table.json").read_text()).values():
        (settings,) = (one["settings"] for one in cell.values())
        assert (settings["sampler_rate"], settings["gram_energy"]) == (8e-3, False)
    assert cells.reported(lambda: recipe.main([*flags, "--resume"])) == 2
    assert "was started with other set" in capsys.readouterr().err
    for wrong in ("sampler_rat=1", "seed=1", "sampler_rate=fast", "gram_energy=1", "alpha"):
        with pytest.raises(SystemExit):
            recipe.parse(["--set", wrong])
        assert f"expected a setting of train/settings.py and its value, found '{wrong}'" in capsys.readouterr().err
