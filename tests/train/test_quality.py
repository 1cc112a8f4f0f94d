"""The measures tell a texture from its exemplar, and the exemplar from nothing."""

from __future__ import annotations

import errno
import os
import shutil

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

pytest.importorskip(
    "stlpips_pytorch", reason="the VGG-16 weights come with stlpips-pytorch: pip install 'solidgrain[evaluate]'"
)

from solidgrain.export import evaluation as evaluation_module
from solidgrain.export.figures import make_figures
from solidgrain.runtime import ExemplarError, load_space
from solidgrain.runtime.bundle import embedded_folder
from solidgrain.train import quality
from solidgrain.train.copying import Copying
from solidgrain.train.exemplar import MIRRORED
from solidgrain.train.quality import Evaluation, disjoint_crops, distinct, evaluate, spread_out
from solidgrain.train.slices import Planes
from tests.bench import cells
from tests.train.conftest import blotches

EXEMPLAR = blotches(128, 128)


def resampled(points, seed):
    """Slices cut from more of the exemplar's own material: as good as it gets, in any orientation."""
    size = round(len(points) ** 0.5)
    draw = np.random.default_rng(seed)
    top, left = draw.integers(0, 128 - size, 2)
    return EXEMPLAR[top : top + size, left : left + size].reshape(-1, 3)


def test_crops_of_the_exemplar_score_about_one():
    evaluation = evaluate(EXEMPLAR, resampled, slices=4)
    assert evaluation.crop == 64
    for name in ("gram", "patches", "color"):
        assert 0.4 < evaluation.axis[name][0] < 1.6


def test_the_floor_is_the_same_whichever_crop_comes_first(monkeypatch):
    """Gram matrices differ relatively to the first of a pair."""
    exemplar = EXEMPLAR * np.linspace(0.4, 1, 128, dtype=np.float32)[:, None]
    floor = evaluate(exemplar, resampled, slices=1).floor
    monkeypatch.setattr(quality, "spread_out", lambda squares, most: spread_out(squares, most)[::-1])
    assert evaluate(exemplar, resampled, slices=1).floor == pytest.approx(floor, rel=1e-4)


def test_slices_from_each_other_tell_a_texture_that_varies_from_one_that_repeats_itself():
    varied = evaluate(EXEMPLAR, resampled, slices=4)
    assert 0.3 < varied.among["gram"] < 1.6
    repeated = evaluate(EXEMPLAR, lambda points, seed: resampled(points, 0), slices=2)
    assert repeated.among == pytest.approx(dict.fromkeys(repeated.floor, 0.0), abs=1e-3)
    single = evaluate(EXEMPLAR, resampled, slices=1)
    assert single.among == {}
    headers = [make_figures(one, Copying(256, 0.1, 1.25, 0.004)).header for one in (varied, single)]
    assert headers[0] == (*headers[1], "slices from each other")


@pytest.mark.parametrize("side", [64, 72, 80, 88, 136])
def test_exemplars_of_any_size_are_measured(side):
    """Whatever VGG's pyramid leaves of their crops."""
    exemplar = blotches(side, side)
    evaluation = evaluate(exemplar, lambda points, seed: np.resize(exemplar, (len(points), 3)), slices=1)
    assert all(np.isfinite(floor) for floor in evaluation.floor.values())


def test_an_exemplar_with_a_direction_is_far_from_itself_turned():
    even = evaluate(blotches(160, 160), resampled, slices=1).turned
    streaks = np.repeat(blotches(160, 160)[:, :20], 8, axis=1)
    lying = evaluate(streaks, lambda points, seed: np.resize(streaks, (len(points), 3)), slices=1).turned
    assert even.keys() == lying.keys()
    assert 0.5 < even["gram"] < 1.5
    assert lying["vgg_frechet"] > 2 * even["vgg_frechet"]


@pytest.mark.parametrize("grain", ["x", "y"])
def test_a_grained_exemplar_that_is_lit_from_one_side_is_far_from_itself_mirrored(grain):
    """Slices about the grain show its ridges from behind, too."""
    place = np.arange(160.0)[:, None] + 2 * np.random.default_rng(0).normal(size=160).cumsum()
    lit, even = place % 16 / 16, abs(place % 16 - 8) / 8

    def mirrored(ridges):
        exemplar = (blotches(160, 160) + ridges[..., None].astype(np.float32)) / 2
        exemplar = exemplar if grain == "x" else exemplar.transpose(1, 0, 2).copy()
        evaluation = evaluate(exemplar, lambda points, seed: np.resize(exemplar, (len(points), 3)), 1, Planes(grain))
        assert evaluation.turn == "mirrored across its grain"
        return evaluation.turned["vgg_frechet"]

    assert mirrored(lit) > 2 * mirrored(even)


def test_white_noise_scores_far_above_one():
    evaluation = evaluate(
        EXEMPLAR, lambda points, seed: np.random.default_rng(seed).random((len(points), 3), np.float32), slices=2
    )
    assert evaluation.axis["vgg_frechet"][0] > 5
    assert evaluation.oblique["gram"][0] > 1.5


def test_a_grain_limits_the_orientations(monkeypatch):
    seen = []

    def sample(points, seed):
        size = round(len(points) ** 0.5)
        seen.append(points.reshape(size, size, 3))
        return resampled(points, seed)

    evaluate(EXEMPLAR, sample, slices=3, planes=Planes("x"))
    for points in seen:
        along = points[:, 1:] - points[:, :-1]
        np.testing.assert_allclose(along, np.broadcast_to([1.0, 0, 0], along.shape), atol=1e-4)


def test_what_is_upright_is_measured_upright():
    """Down in a slice is down, or into the depth, or between the two: it is never up."""
    downwards = []

    def sample(points, seed):
        size = round(len(points) ** 0.5)
        points = points.reshape(size, size, 3)
        downwards.append(points[1, 0] - points[0, 0])
        return resampled(points.reshape(-1, 3), seed)

    evaluation = evaluate(EXEMPLAR, sample, slices=8, planes=Planes("x", upright=True))
    assert (evaluation.grain, evaluation.upright) == ("x", True)
    assert np.min(downwards) > -1e-4
    assert np.ptp([step[1] for step in downwards]) > 0.5


def test_the_command_measures_a_bundle_and_writes_its_card(solidgrain, toy_folder, tmp_path):
    import shutil

    import OpenImageIO as oiio

    folder = shutil.copytree(toy_folder, tmp_path / "toy")
    oiio.ImageBuf(np.ascontiguousarray(EXEMPLAR[:64, :64])).write(str(tmp_path / "exemplar.png"), oiio.UINT8)
    outcome = solidgrain("evaluate", folder, "--exemplar", tmp_path / "exemplar.png", "--slices", 1, "--card")
    assert outcome.code == 0, outcome.err
    assert "| vgg_frechet |" in outcome.out
    assert outcome.out.strip() in (folder / "card.md").read_text()
    assert "Copying: patches are" in outcome.out
    (folder / "card.md").write_text((folder / "card.md").read_text() + "\n## Usage\n\nFor floors.\n")
    solidgrain("evaluate", folder, "--exemplar", tmp_path / "exemplar.png", "--slices", 1, "--card")
    assert (folder / "card.md").read_text().count("## Quality") == 1
    assert (folder / "card.md").read_text().endswith("\n\n## Usage\n\nFor floors.\n")
    (folder / "card.md").write_bytes(b"caf\xe9")
    outcome = solidgrain("evaluate", folder, "--exemplar", tmp_path / "exemplar.png", "--slices", 1, "--card")
    assert outcome.code == 1
    assert "card.md: not UTF-8, so that nothing can be written into it" in outcome.err


def test_another_photograph_than_the_texture_s_own_is_said_to_be_and_not_written_down(solidgrain, tmp_path):
    folder = shutil.copytree(embedded_folder("lichen"), tmp_path / "lichen")
    oiio.ImageBuf(EXEMPLAR).write(os.fspath(tmp_path / "other.png"))
    flags = ("evaluate", folder, "--exemplar", tmp_path / "other.png", "--slices", 1)
    outcome = solidgrain(*flags)
    assert outcome.code == 0
    assert f"warning: {tmp_path / 'other.png'}: lichen was not learned from it, by its pixels" in outcome.err
    refused = solidgrain(*flags, "--card")
    assert (refused.code, "--card: lichen was not learned from" in refused.error) == (2, True)


def test_a_sheet_that_could_not_be_written_is_refused_before_measuring(solidgrain, toy_folder, tmp_path):
    oiio.ImageBuf(EXEMPLAR).write(os.fspath(tmp_path / "photo.png"))
    (tmp_path / "sheet.png").mkdir()
    outcome = solidgrain("evaluate", toy_folder, "--exemplar", tmp_path / "photo.png", "--sheet", tmp_path / "sheet.png")
    assert (outcome.code, outcome.out) == (2, "")
    assert "is a folder" in outcome.error


def test_a_card_that_cannot_be_written_is_one_line_after_the_figures(solidgrain, toy_folder, tmp_path, monkeypatch):
    cells.write_png(tmp_path / "exemplar.png", EXEMPLAR[:64, :64])

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(evaluation_module, "replacing", full)
    outcome = solidgrain(
        "evaluate", toy_folder, "--exemplar", tmp_path / "exemplar.png", "--slices", 1, "--card", "--threads", 1
    )
    assert (outcome.code, torch.get_num_threads()) == (1, 1)
    assert "| vgg_frechet |" in outcome.out
    assert f"{toy_folder / 'card.md'}: cannot write the model card (No space left on device)" in outcome.err


def test_a_photograph_that_is_too_small_to_measure_by_is_refused_with_flags_that_are_there(solidgrain, toy_folder, tmp_path):
    cells.write_png(tmp_path / "small.png", blotches(100, 100))
    outcome = solidgrain("evaluate", toy_folder, "--exemplar", tmp_path / "small.png", "--patch-scale", 2)
    assert outcome.code == 1
    assert outcome.error.endswith(
        "100x100 pixels, expected at least 128x128; use a larger photograph or a smaller --patch-scale"
    )


def test_a_blend_in_space_has_no_exemplar(solidgrain, toy_space_folder, tmp_path):
    space = load_space(toy_space_folder)
    ends = [space.encode(picture) for picture in (blotches(128, 128), blotches(150, 128))]
    space.blend_along(*ends, "x", 0, 64).save(tmp_path / "ab.sgt.npz")
    cells.write_png(tmp_path / "a.png", blotches(128, 128))
    flags = ("--bundle", toy_space_folder, "--exemplar", tmp_path / "a.png", "--slices", 1)
    outcome = solidgrain("evaluate", tmp_path / "ab.sgt.npz", *flags)
    assert (outcome.code, outcome.out) == (2, "")
    assert "ab.sgt.npz: is a blend in space, which has no exemplar of its own; evaluate its ends" in outcome.error


def test_a_card_is_not_that_of_one_texture_of_a_space(solidgrain, toy_space_folder, tmp_path):
    texture = load_space(toy_space_folder).encode(blotches(128, 128), "blotches")
    texture.save(tmp_path / "blotches.sgt.npz")
    before = (toy_space_folder / "card.md").read_bytes() if (toy_space_folder / "card.md").exists() else None
    cells.write_png(tmp_path / "blotches.png", blotches(128, 128))
    flags = ("--bundle", toy_space_folder, "--exemplar", tmp_path / "blotches.png", "--slices", 1, "--card")
    outcome = solidgrain("evaluate", tmp_path / "blotches.sgt.npz", *flags)
    assert (outcome.code, "leave --card out" in outcome.error) == (2, True)
    assert ((toy_space_folder / "card.md").read_bytes() if before is not None else None) == before


@pytest.mark.parametrize("exemplar", [np.tile(EXEMPLAR[:64, :64], (2, 2, 1)), np.full((128, 128, 3), 0.5, np.float32)])
def test_what_has_no_floor_is_refused(exemplar):
    with pytest.raises(ExemplarError, match="one side or one period of it"):
        evaluate(exemplar, resampled, slices=1)


@pytest.mark.parametrize(("flags", "code", "message"), [(["--slices", "0"], 2, "--slices"), ([], 1, "at least 64x64")])
def test_the_command_refuses_what_it_cannot_measure(solidgrain, toy_folder, tmp_path, flags, code, message):
    import OpenImageIO as oiio

    oiio.ImageBuf(np.ascontiguousarray(EXEMPLAR[:40, :40])).write(str(tmp_path / "small.png"), oiio.UINT8)
    outcome = solidgrain("evaluate", toy_folder, "--exemplar", tmp_path / "small.png", *flags)
    assert outcome.code == code
    assert message in outcome.err


def test_an_exemplar_that_changes_across_itself_is_said_to():
    even, uneven = (said_after(nonstationarity=value) for value in (0.2, 0.34))
    assert uneven == f"{even} The exemplar changes across itself (nonstationarity 0.34, above 0.3)."


def test_one_side_of_a_mirrored_exemplar_is_compared():
    mirrored = np.concatenate([EXEMPLAR, EXEMPLAR[:, ::-1]], axis=1)
    side = np.ascontiguousarray(mirrored[:, : (mirrored.shape[1] - 3) // 2])
    whole, part = (evaluate(one, resampled, slices=1) for one in (mirrored, side))
    assert (whole.one_side, part.one_side) == (True, False)
    assert whole.symmetry > MIRRORED > part.symmetry
    assert whole.floor == part.floor
    assert "(symmetry about its middle 0.94, above 0.1): one side of it was" in said_after(symmetry=0.94, one_side=True)
    assert "(symmetry about its middle 0.94, above 0.1): its floor is between mirror" in said_after(symmetry=0.94)


def test_of_a_small_mirrored_exemplar_no_side_is_compared():
    half = EXEMPLAR[:, :64]
    found = evaluate(np.concatenate([half, half[:, ::-1]], axis=1), resampled, slices=1)
    assert found.symmetry > MIRRORED
    assert not found.one_side


def test_flags_for_an_exemplar_with_a_direction_are_named_where_slices_lack_it():
    lit = {"slices": 4.0, "turned": 16.66}
    assert "16.7 times its floor when mirrored across its grain" in said_after(grain="x", **lit)
    assert "train with --upright for" in said_after(grain="x", **lit)
    assert "train with --anisotropic, and --upright if light" in said_after(**lit)
    assert said_after(grain="x", upright=True, **lit) == said_after(slices=4.0) == said_after(turned=16.66) == said_after()


def said_after(slices=1.0, turned=1.0, **facts):
    """What follows the table of an evaluation that found such distances."""
    found = {"vgg_frechet": (slices, 0.1)}
    evaluation = Evaluation(64, 1, {"vgg_frechet": 1.0}, found, found, {"vgg_frechet": turned}, **facts)
    return make_figures(evaluation, Copying(256, 0.1, 1.0, 0.01)).after


def test_crops_of_a_large_exemplar_are_all_over_it():
    image = torch.arange(16.0).reshape(4, 4).kron(torch.ones(8, 8))[None, None]
    squares = spread_out(disjoint_crops(image, 8), 6)
    assert all(divmod(int(square.pixels.mean()), 4) == (square.row, square.column) for square in squares)
    for side in 3, 4, 5, 10:
        chosen = spread_out(disjoint_crops(torch.zeros(1, 1, side, side), 1), 6)
        for places in {square.row for square in chosen}, {square.column for square in chosen}:
            assert {0, side - 1} < places
    assert len(spread_out(disjoint_crops(image[..., :16, :16], 8), 6)) == 4


def test_what_no_square_has_room_for_is_left_at_all_edges_alike():
    image = torch.arange(20.0).expand(1, 3, 20, 20)
    (first, *_), last = squares = disjoint_crops(image, 8), disjoint_crops(image, 8)[-1]
    assert (first.pixels[0, 0, 0, 0], last.pixels[0, 0, -1, -1]) == (2, 17)
    assert len(squares[0]) == 4


def test_crops_that_repeat_each_other_count_once():
    image = torch.from_numpy(blotches(128, 128)).permute(2, 0, 1)[None]
    squares = disjoint_crops(image, 64)
    twice = torch.cat([image, image + 0.002], dim=3)  # two periods, a level apart
    left = distinct(disjoint_crops(twice, 64))
    assert len(left) == len(squares) == 4
    assert all(torch.equal(a.pixels, b.pixels) for a, b in zip(left, squares, strict=True))
    assert len(distinct(squares)) == 4
    assert len(distinct(disjoint_crops(torch.tile(image[..., :64, :64], (2, 2)), 64))) == 4  # no two differ: evaluate says so


def test_of_a_gradient_there_are_always_crops_to_compare():
    ramp = torch.linspace(0, 1, 64 * 50).expand(1, 3, 64, -1)  # each crop is near the one before it
    left = distinct(disjoint_crops(ramp, 64))
    assert 2 <= len(left) < 50
    assert left[0].pixels.mean() < left[-1].pixels.mean() - 0.5


def test_inception_weights_that_are_missing_are_noticed_before_measuring(solidgrain, toy_folder, tmp_path):
    outcome = solidgrain("evaluate", toy_folder, "--exemplar", tmp_path / "none.png", "--inception", tmp_path / "none.pth")
    assert outcome.code == 1
    assert "none.pth: no such file" in outcome.error
