"""The table of texture spaces at a toy's size: everything is measured once, kept, and told as the paper tells it."""

from __future__ import annotations

import itertools
import json
import os
import shutil
from dataclasses import replace

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

pytest.importorskip("stlpips_pytorch", reason="the measures need VGG-16: pip install 'solidgrain[evaluate]'")

from solidgrain.export.bundle import Details, write_bundle
from solidgrain.export.from_space_run import export_space_run
from solidgrain.export.space_graphs import EncoderWeights
from solidgrain.runtime import SolidgrainError, load_space
from solidgrain.runtime.texture_file import read_texture
from solidgrain.train.cuts import as_image
from solidgrain.train.loop import train
from solidgrain.train.photograph import read_exemplar
from solidgrain.train.quality import Measure
from solidgrain.train.settings import Budget
from tests.bench import cells, space_measure, space_table, space_values
from tests.bench.likelihood import BANDWIDTHS
from tests.bench.signed_rank import signed_rank
from tests.bench.space_measure import Reference, cut_crops
from tests.bench.space_methods import Methods, open_henzler
from tests.toy_space import LATENT, toy_space_weights
from tests.train.conftest import blotches
from tests.train.spaces import new_space
from tests.train.spaces import photographs as photographs_folder

PATCH = 64
HELD_OUT = ("granite.png", "marble.png")


@pytest.fixture(autouse=True)
def few_patches(monkeypatch):
    monkeypatch.setattr(space_measure, "SAMPLES", 32)
    monkeypatch.setattr(space_measure, "TRUTH", 128)
    monkeypatch.setattr(space_measure, "MOST", 4)


@pytest.fixture(scope="module")
def measure():
    torch.set_num_threads(1)
    return Measure()


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    """A space that sees 64² pixels, and says that it was never shown two photographs."""
    draw = np.random.default_rng(1)
    dense = [(draw.standard_normal((3 * PATCH**2, LATENT)).astype(np.float32) / 32, np.zeros(LATENT, np.float32))]
    weights = replace(toy_space_weights(), encoder=EncoderWeights([], dense, PATCH))
    details = Details(name="toys", patch=PATCH, training={"held_out": [*HELD_OUT], "iterations": 7})
    return write_bundle(tmp_path_factory.mktemp("bundles") / "toys", weights, details)


@pytest.fixture
def photographs(tmp_path):
    """A folder with what was held out, what is no stone, and a larger one."""
    sizes = {"stones/granite.png": 64, "stones/marble.png": 80, "wood.png": 64, "large/cliff.png": 256}
    for number, (name, size) in enumerate(sizes.items()):
        path = tmp_path / "photographs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.roll(blotches(size, size), number, 2) ** (1 + number)
        assert oiio.ImageBuf(np.ascontiguousarray(pixels)).write(os.fspath(path), oiio.UINT8)
    return tmp_path / "photographs"


@pytest.fixture
def flags(bundle, photographs, tmp_path):
    where = ["--bundle", str(bundle), "--exemplars", str(photographs), "--far", str(photographs / "wood.png")]
    return [*where, "--slices", "1", "--threads", "1", "--out", str(tmp_path / "out")]


@pytest.fixture
def adapted(monkeypatch):
    """Adapting that takes no time and changes nothing; what was asked of it."""
    asked = []

    def adapt(self, photograph, out, features):
        asked.append((photograph.parent.name, features, self.budget))
        if photograph.parent.name == "wood.png" and features == "vgg":
            raise SolidgrainError(f"{photograph}: adapting failed")
        shutil.copy(out.with_name("unadapted.sgt.npz"), out)
        cells.keep(out.with_name(f"{features}-adapted.json"), {"iterations": 3, "seconds": 4.2})

    monkeypatch.setattr(Methods, "adapt", adapt)
    monkeypatch.setattr(space_table, "find_companion", lambda bundle, named: named)
    return asked


def test_a_table_grows_by_what_is_asked_and_nothing_is_made_twice(flags, adapted, tmp_path, capsys):
    out = tmp_path / "out"
    space_table.main([*flags, "--only-unadapted", "--only", "granite.png"])
    assert not adapted
    assert cells.reported(lambda: space_table.main([*flags, "--seconds", "5"])) == 2  # not without --resume
    first = (out / "held-out/granite.png/unadapted.json").stat().st_mtime_ns

    assert cells.reported(lambda: space_table.main([*flags, "--seconds", "5", "--resume"])) == 1  # one could not be adapted
    err = capsys.readouterr().err
    assert "left out: " in err and "1 results are missing" in err
    assert adapted == [(name, f, ("--seconds", "5")) for f in ("critic", "vgg") for name in (*HELD_OUT, "wood.png")]
    assert (out / "held-out/granite.png/unadapted.json").stat().st_mtime_ns == first
    assert not (out / "far/wood.png/vgg.json").exists()

    adapted.clear()
    assert cells.reported(lambda: space_table.main([*flags, "--seconds", "5", "--resume"])) == 1
    assert adapted == [("wood.png", "vgg", ("--seconds", "5"))]  # nothing else is tried again
    assert cells.reported(lambda: space_table.main([*flags, "--iterations", "9", "--resume"])) == 2
    assert "started with other budget" in capsys.readouterr().err

    told = (out / "table.md").read_text()
    assert "| SIFID × 10⁵ (the paper, Table 2) | 2.46 ± 2.80 | 2.60 ± 2.85 | 2.47 ± 2.23 | – | – |" in told
    assert "| photographs | 2 | – | 2 | 2 | 2 |" in told
    assert "| iterations, seconds of adapting | – | – | – | 3, 4 | 3, 4 |" in told
    assert "Compared are squares, of 32² pixels for 1: slices with all disjoint crops, each crop with" in told
    assert "A photograph unlike all that the space has seen: wood.png" in told
    assert "- the paper's SIFID: ours, adapted (D) < ours, adapted (VGG) < ours < Henzler et al." in told
    found = json.loads((out / "table.json").read_text())
    unadapted, critic = (found["photographs"]["held-out"]["marble.png"][c]["oblique"] for c in ("unadapted", "critic"))
    assert unadapted == critic  # our adapting changed nothing: the same slices, the same figures
    assert found["summary"]["oblique"]["gram"]["unadapted"]["photographs"] == 2
    assert found["summary"]["window"]["methods"] == ["unadapted", "critic"]
    shape = oiio.ImageBuf(str(out / "held-out.png")).spec()
    assert (shape.height, shape.width) == (PATCH, 2 * (3 * PATCH + 4) + 8)
    shape = oiio.ImageBuf(str(out / "interpolation.png")).spec()
    assert (shape.height, shape.width) == (PATCH, 9 * PATCH + 8 * 8)


def test_the_column_of_vgg_may_be_left_out(flags, adapted):
    space_table.main([*flags, "--seconds", "5", "--without-vgg", "--only", "granite.png"])
    assert adapted == [("granite.png", "critic", ("--seconds", "5"))]


def test_large_photographs_are_scaled_and_what_is_measured_is_the_runtime_s_texture_of_their_middle(
    flags, bundle, photographs, tmp_path
):
    space_table.main([*flags, "--only-unadapted", "--large", "--patch-scale", "2", "--only", "cliff.png"])
    folder = tmp_path / "out" / "large" / "cliff.png"
    told = (tmp_path / "out" / "table.md").read_text()
    assert "1 large photographs" in told and "| cliff.png | " in told
    pixels = read_exemplar(folder / "exemplar.png", PATCH)
    assert pixels.shape == (PATCH, PATCH, 3)
    space = load_space(bundle)
    np.testing.assert_allclose(read_texture(folder / "unadapted.sgt.npz").latent, space.code(pixels), atol=1e-3)
    assert json.loads((folder / "truth.json").read_text())["crop"] == PATCH  # 128² after scaling: four quarters


def test_the_patch_that_is_kept_holds_every_level_of_the_photograph(tmp_path):
    pixels = read_exemplar(written(tmp_path / "photograph.png", blotches(70, 64)), 64)
    space_table.write_exactly(tmp_path / "exemplar.png", pixels)
    np.testing.assert_allclose(read_exemplar(tmp_path / "exemplar.png", 64), pixels, atol=1e-7)


def written(path, pixels):
    assert oiio.ImageBuf(np.ascontiguousarray(pixels)).write(os.fspath(path), oiio.UINT8)
    return path


@pytest.mark.parametrize(
    ("flag", "value", "told"),
    [
        ("--exemplars", "nowhere", "no such folder"),
        ("--exemplars", "photographs/large", "no file in it is called granite.png"),
        ("--far", "nowhere.png", "no such file"),
        ("--only", "basalt.png", "none of the 3 photographs"),
        ("--henzler", "photographs", "neither a bundle nor a run directory"),
    ],
)
def test_bad_input_is_one_line_before_anything_is_made(flags, tmp_path, capsys, flag, value, told):
    more = [flag, value if flag == "--only" else str(tmp_path / value)]
    assert cells.reported(lambda: space_table.main([*flags, "--only-unadapted", *more])) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line
    assert not (tmp_path / "out").exists()


def test_adapting_with_d_needs_it_before_anything_is_made(flags, tmp_path, capsys):
    assert cells.reported(lambda: space_table.main(flags)) == 1
    assert "adapting needs the critic" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_adapting_leaves_a_texture_that_is_called_like_its_photograph_or_says_why_not(toy_space_folder, tmp_path):
    methods = Methods(load_space(toy_space_folder), 1, ("--iterations", "1"), None, None)
    out = tmp_path / "stone.png" / "critic.sgt.npz"
    out.parent.mkdir()
    methods.adapt(written(out.with_name("exemplar.png"), blotches(128, 128)), out, "critic")
    assert read_texture(out).name == "stone.png"
    assert json.loads(out.with_name("critic-adapted.json").read_text())["iterations"] == 1
    with pytest.raises(SolidgrainError, match=r"nothing\.png: adapting with critic failed: .*no such file"):
        methods.adapt(tmp_path / "nothing.png", tmp_path / "a.sgt.npz", "critic")
    assert not list(tmp_path.rglob("*.part*"))


def test_another_method_must_not_have_seen_the_photographs_either(flags, toy_space_folder, tmp_path, capsys):
    assert cells.reported(lambda: space_table.main([*flags, "--only-unadapted", "--henzler", str(toy_space_folder)])) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "was trained on granite.png; --hold-out the same photographs" in line
    assert not (tmp_path / "out").exists()


def test_another_method_has_a_column_of_its_own(flags, bundle, tmp_path):
    space_table.main([*flags, "--only-unadapted", "--only", "granite.png", "--henzler", str(bundle)])
    found = json.loads((tmp_path / "out" / "table.json").read_text())["photographs"]["held-out"]["granite.png"]
    assert found["henzler"] == found["unadapted"]  # it is the same space
    told = (tmp_path / "out" / "table.md").read_text()
    assert "- the paper's ALL: ground truth > ours > Henzler et al." in told
    assert "that tells Henzler et al. from ours, or the last: it does not" in told


def test_a_patch_is_compared_with_crops_that_it_does_not_overlap(monkeypatch):
    monkeypatch.setattr(space_measure, "MOST", 8)
    where = torch.arange(256.0).expand(1, 3, 256, 256)
    places = torch.cat([where.transpose(2, 3)[:, :1], where[:, :1], where[:, :1]], 1)  # every pixel says its row and column
    crops = cut_crops(places, 64)
    assert not crops.same and len(crops.compared) == 1 and len(crops.truth) == 8
    assert crops.compared[0][0, :2, 0, 0].tolist() == [96, 96]
    corners = [tuple(crop[0, :2, 0, 0].tolist()) for crop in crops.truth]
    for (a, b), (c, d) in itertools.combinations([(96, 96), *corners], 2):
        assert abs(a - c) >= 64 or abs(b - d) >= 64


def test_a_photograph_of_the_patch_s_size_is_compared_by_its_quarters():
    crops = cut_crops(torch.rand(1, 3, 128, 128), 128)
    assert crops.same and [crop.shape[-1] for crop in crops.compared] == [64] * 4


@pytest.mark.parametrize("size", [64, 224])
def test_truth_is_as_near_as_truth_and_a_wrong_picture_is_not(measure, size):
    """Independent pixels: every crop is as good as another, so truth and fair slices are at the floor and equally likely."""

    def noise(seed, height):
        return as_image(np.random.default_rng(seed).random((height, height, 3), np.float32))

    reference = Reference(cut_crops(noise(0, size), 64 if size > 64 else 48), measure)
    truth = reference.of_truth()
    fair = reference.of_slices([noise(seed, reference.size) for seed in range(1, 5)])
    wrong = reference.of_slices([0.5 + 0.3 * noise(seed, reference.size) for seed in range(1, 3)])
    wide = BANDWIDTHS.index(64.0)
    for name in reference.names:
        assert truth["ratios"][name][0] == pytest.approx(1, rel=0.3)
        assert fair["ratios"][name][0] == pytest.approx(1, rel=0.35)
        assert wrong["ratios"][name][0] > 1.4
    assert truth["likelihood"]["3"][wide] == pytest.approx(fair["likelihood"]["3"][wide], rel=0.02)
    assert list(truth["likelihood"]) == [str(kernel) for kernel in space_measure.KERNELS if kernel <= reference.size]


def results(shift_at_5, shift_at_3):
    """Eight photographs, of which two columns differ by so much at patches of 5² and 3²; bandwidth 4 suits the truth best."""
    found = {}
    for k in range(8):

        def cell(shift, kind="oblique", k=k):
            by_kernel = {
                str(kernel): [-abs(np.log2(b) - 2) - k * (-1) ** k + shift.get(kernel, 0) * (k + 1) for b in BANDWIDTHS]
                for kernel in space_measure.KERNELS
            }
            return {kind: {"ratios": {"gram": [1.0 + k, 0.1]}, "likelihood": by_kernel}}

        found[f"{k}.png"] = {
            "truth": cell({}, "truth"),
            "unadapted": cell({}),
            "critic": cell({15: (-1) ** k, 5: shift_at_5, 3: shift_at_3}),
        }
    return found


def test_likelihood_is_quoted_at_the_largest_patches_that_tell_the_methods_apart():
    window = space_values.choose_window(results(shift_at_5=0.1, shift_at_3=9.0))
    assert (window.kernel, window.bandwidth, window.methods) == (5, 4.0, ("unadapted", "critic"))
    assert window.p == pytest.approx(2 / 2**8)
    alike = space_values.choose_window(results(shift_at_5=0, shift_at_3=0))
    assert (alike.kernel, alike.p) == (3, 1.0)
    only_truth = {name: {"truth": cell["truth"]} for name, cell in results(0, 0).items()}
    assert space_values.choose_window(only_truth) is None


def with_positive_sum(count, total):
    """Differences 1..count, of which those that sum to `total` are positive."""
    signs = -np.ones(count)
    for rank in range(count, 0, -1):
        if rank <= total:
            signs[rank - 1], total = 1, total - rank
    return signs * np.arange(1, count + 1)


@pytest.mark.parametrize(("count", "critical"), [(6, 0), (10, 8), (15, 25), (20, 52), (22, 65), (25, 89)])
def test_signed_ranks_have_the_published_critical_values(count, critical):
    """Largest sums of ranks that are significant at 5 %, two-sided, as statistics books print them."""
    assert signed_rank(with_positive_sum(count, critical)) <= 0.05 < signed_rank(with_positive_sum(count, critical + 1))


def test_signed_ranks_of_darwin_s_maize_and_of_ties():
    """Differences in height of crossed and self-fertilised plants (Fisher 1935); then, signs tossed one by one."""
    maize = [6, 8, 14, 16, 23, 24, 28, 29, 41, -48, 49, 56, 60, -67, 75]
    assert signed_rank(maize) == 0.041259765625
    ties = np.array([3, 3, -1, 0, 5, 1, 1, -3])
    sizes, ranks = np.abs(ties[ties != 0]), np.array([5, 5, 2, 7, 2, 2, 5])  # mean ranks
    assert sorted(zip(sizes, ranks, strict=True))[0] == (1, 2)
    sums = [ranks[np.array(signs)].sum() for signs in itertools.product([False, True], repeat=7)]
    positive = ranks[ties[ties != 0] > 0].sum()
    tail = min(np.mean([one <= positive for one in sums]), np.mean([one >= positive for one in sums]))
    assert signed_rank(ties.tolist()) == pytest.approx(2 * tail)
    assert signed_rank([0.0, 0.0]) == signed_rank([1.0, -1.0]) == 1.0


def test_a_run_is_sampled_in_torch_as_its_bundle_is_by_the_runtime(tmp_path):
    run = new_space(tmp_path / "run", photographs_folder(tmp_path / "stones"))
    train(run, Budget(iterations=1), torch.device("cpu"))
    space = load_space(export_space_run(run.folder, tmp_path / "space"))
    patch = read_exemplar(tmp_path / "stones" / "stone2.png", 128)[16:144, 16:144]
    points = cells.plane(16, torch.eye(3), np.array([100.0, 200.0, 300.0]))
    near = points - points.mean(0)  # where a run is sampled
    of_run, of_bundle = open_henzler(run.folder, 1).samples_of(patch), space.encode(patch).sample
    np.testing.assert_allclose(of_run(points, 3), of_bundle(near, 3), atol=5e-3)  # E is rounded to half precision
    assert np.abs(of_run(points, 3) - of_run(points, 4)).max() > 0.02
