"""The colour of a voxel depends on texture, seed and coordinate, and on nothing else."""

import copy
import itertools
import pickle
import shutil

import numpy as np
import pytest

from solidgrain.runtime import BundleError, EvaluationError, load, workers
from solidgrain.runtime.bundle import embedded_folder
from solidgrain.runtime.noise import noise_offsets, noise_tables
from solidgrain.runtime.onnx_engine import CPU_CHUNK
from tests.reference import color
from tests.toy import toy_weights

AXES = ["".join(axes) for count in (1, 2, 3) for axes in itertools.combinations("xyz", count)]


@pytest.fixture(scope="module", params=["auto", "cpu"])
def toy(toy_folder, request):
    """Every claim holds for the fused kernel, where there is one, and for ONNX Runtime."""
    return load(toy_folder, provider=request.param)


@pytest.mark.parametrize("reach", [64.0, 1e4, 1e9])
def test_sampler_is_the_formula_near_and_far(toy, reach):
    points = np.random.default_rng(0).uniform(-reach, reach, (20, 3))
    tables = noise_tables(3, 16)
    offsets = noise_offsets(3, 16)
    expected = [color(toy_weights(), tables, offsets, tuple(point)) for point in points]
    np.testing.assert_allclose(toy.sample(points, seed=3), expected, atol=1e-4)


def test_a_grid_is_sampled_at_voxel_centres_x_fastest(toy):
    volume = toy.grid((2, 3, 4), seed=1, origin=(10, 20, 30), spacing=(0.5, 1.0, 2.0))
    z, y, x = 1, 2, 3
    point = [10 + (x + 0.5) * 0.5, 20 + (y + 0.5) * 1.0, 30 + (z + 0.5) * 2.0]
    assert np.array_equal(volume[z, y, x], toy.sample([point], seed=1)[0])


def test_slabs_of_any_thickness_make_the_same_grid(toy):
    whole = toy.grid((7, 33, 50), seed=2)
    for thickness in (1, 3, 7, 16):
        slabs = list(toy.slabs((7, 33, 50), seed=2, slab=thickness))
        assert [z for z, _ in slabs] == list(range(0, 7, thickness))
        assert np.array_equal(np.concatenate([slab for _, slab in slabs]), whole)


def test_the_origin_is_a_place_like_any_other(toy):
    """Over many instances, colours at the origin vary as much as elsewhere: no octave has a texel just there."""
    there = np.concatenate([toy.sample([[0, 0, 0], [100.3, 7.7, 31.1]], seed)[None] for seed in range(150)])
    spread = there.std(0).mean(-1)
    assert abs(spread[0] / spread[1] - 1) < 0.25


def test_threads_change_nothing(toy_folder):
    one, four = (load(toy_folder, threads=threads).grid((4, 48, 48), seed=2) for threads in (1, 4))
    assert np.array_equal(one, four)


@pytest.mark.parametrize("distance", [0, 2**20, 10**9])
def test_a_region_is_bit_identical_whichever_way_it_is_reached(toy, distance):
    around = toy.grid((9, 40, 70), seed=4, origin=(distance, -distance, 7))
    inside = toy.grid((2, 11, 13), seed=4, origin=(distance + 33, 5 - distance, 10))
    assert np.array_equal(around[3:5, 5:16, 33:46], inside)


@pytest.mark.parametrize("distance", [10**6, 10**9])
def test_the_texture_is_as_detailed_far_away_as_at_the_origin(toy, distance):
    near, far = (toy.grid((1, 64, 64), origin=(start, 0, 0))[0] for start in (0, distance))
    steps = [np.abs(np.diff(picture, axis=1)).mean() for picture in (near, far)]
    assert abs(steps[1] / steps[0] - 1) < 0.2


def test_seeds_are_different_instances_of_the_same_material(toy):
    first, second = toy.grid((4, 64, 64), seed=0), toy.grid((4, 64, 64), seed=1)
    assert np.abs(first - second).mean() > 0.01
    assert np.abs(first.mean((0, 1, 2)) - second.mean((0, 1, 2))).max() < 0.1


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("distance", [0, 10**9])
def test_a_tile_repeats_along_its_axes_and_along_no_other(toy, axes, distance):
    period = (64, 80, 96)  # z, y, x
    here = toy.grid((5, 5, 5), seed=3, tile=axes, period=period, origin=(distance + 94, 78, 62))
    for k, axis in enumerate("xyz"):
        origin = [distance + 94.0, 78.0, 62.0]
        origin[k] += period[2 - k]
        difference = np.abs(toy.grid((5, 5, 5), seed=3, tile=axes, period=period, origin=origin) - here).max()
        assert difference <= 1e-4 if axis in axes else difference > 0.01


@pytest.mark.parametrize("axes", AXES)
def test_a_tile_is_continuous_across_its_seam(toy, axes):
    """Two planes a thousandth of a pixel apart, on either side of the seam, against the same inside the tile."""
    period = (48, 48, 48)
    for axis in axes:
        k = "xyz".index(axis)

        def step(at, k=k):
            planes = []
            for side in (-0.0005, 0.0005):
                origin = np.zeros(3)
                origin[k] = at + side - 0.5
                shape = [24, 24, 24]
                shape[2 - k] = 1
                planes.append(toy.grid(shape, seed=3, tile=axes, period=period, origin=origin))
            return np.abs(planes[1] - planes[0]).max()

        assert step(48.0) < 3 * max(step(17.3), step(31.7)) < 0.01


@pytest.mark.parametrize("side", [512, 1000, 1024, 4096, 8192])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_large_tile_is_as_continuous_as_a_small_one(toy, side, axis):
    def step(at):
        planes = []
        for across in (-0.0005, 0.0005):
            origin, shape = np.array([7.0, 8.0, 9.0]), [16, 16, 16]
            origin[axis], shape[2 - axis] = at + across - 0.5, 1
            planes.append(toy.grid(shape, seed=3, tile="xyz", period=(side, side, side), origin=origin))
        return np.abs(planes[1] - planes[0]).max()

    assert step(side) < 3 * max(step(17.3), step(31.7)) < 0.01


@pytest.mark.parametrize(("axes", "side"), [("x", 1024), ("xz", 1024), ("xz", 4096), ("yz", 512)])
def test_a_tile_repeats_far_out_along_the_axes_that_do_not_tile(toy, axes, side):
    origin = [side - 2.0 if axis in axes else 1e9 for axis in "xyz"]
    here = toy.grid((4, 4, 4), seed=3, tile=axes, period=(side, side, side), origin=origin)
    for k, axis in enumerate("xyz"):
        if axis in axes:
            there = [*origin[:k], origin[k] - side, *origin[k + 1 :]]
            again = toy.grid((4, 4, 4), seed=3, tile=axes, period=(side, side, side), origin=there)
            assert np.abs(here - again).max() <= 1e-4
    assert np.abs(np.diff(here, axis=2 - "xyz".index(axes[0]))).max() < 0.35


def test_a_tile_too_large_to_be_exact_is_refused(toy):
    with pytest.raises(EvaluationError, match="too large for an exact seam"):
        toy.slabs((1, 1, 1), tile="xyz", period=(2**22, 2**22, 2**22))


def test_a_tiled_texture_keeps_the_look_of_the_plain_one(toy):
    """Every octave still reads many unrelated texels: neighbouring pixels vary as much, distant ones do not repeat."""
    plain = toy.grid((1, 128, 128), seed=3)[0].mean(-1)
    tile = toy.grid((1, 128, 128), seed=3, tile="xyz", period=(128, 128, 128))[0].mean(-1)
    assert abs(tile.std() / plain.std() - 1) < 0.25
    centred = tile - tile.mean()
    correlation = np.fft.ifft2(np.abs(np.fft.fft2(centred)) ** 2).real / (centred**2).sum()
    assert np.abs(correlation[12:117, 12:117]).max() < 0.35


def test_numpy_numbers_are_numbers(toy):
    plain = toy.grid((2, 3, 4), 5, spacing=2.0)
    assert np.array_equal(toy.grid(np.array([2, 3, 4]), np.uint64(5), spacing=np.float32(2)), plain)
    assert np.array_equal(toy.grid((2, 3, 4), 5, spacing=np.int64(2)), plain)


def test_any_number_of_points_can_be_sampled(toy):
    points = np.random.default_rng(0).uniform(0, 100, (CPU_CHUNK + 1, 3))
    whole = toy.sample(points)
    assert np.array_equal(whole[-1:], toy.sample(points[-1:]))
    assert toy.sample(np.empty((0, 3))).shape == (0, 3)


def test_colours_are_clipped_to_the_unit_range(toy_folder, tmp_path):
    volume = load(toy_folder).grid((8, 64, 64))
    assert volume.dtype == np.float32
    assert volume.min() >= 0
    assert volume.max() <= 1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda t: t.sample(np.zeros(3)), "points have shape"),
        (lambda t: t.sample([["a", "b", "c"]]), "not numbers"),
        (lambda t: t.grid(4), "shape"),
        (lambda t: t.grid((1.5, 1, 1)), "shape"),
        (lambda t: t.grid((1, 1, 1), seed=1.5), "seed"),
        (lambda t: t.grid((1, 1, 1), seed=None), "seed"),
        (lambda t: t.grid((1, 1, 1), origin=(1e300, 0, 0)), "at most"),
        (lambda t: t.grid((0, 1, 1)), "shape"),
        (lambda t: t.grid((1, 1)), "shape"),
        (lambda t: t.grid((1, 1, 1), spacing=0), "spacing"),
        (lambda t: t.grid((1, 1, 1), spacing=(1, 1, -1)), "spacing"),
        (lambda t: t.grid((1, 1, 1), origin=(np.inf, 0, 0)), "origin"),
        (lambda t: t.grid((1, 1, 1), tile="q"), "tile"),
        (lambda t: t.grid((1, 1, 1), tile="x", period=(0, 1, 1)), "period"),
        (lambda t: t.slabs((1, 1, 1), slab=0), "slab"),
        (lambda t: t.grid((1, 1, 1), seed=-1), "seed"),
        (lambda t: t.grid((600, 2000, 2000), tile="w"), "tile"),
        (lambda t: t.grid((2**40,) * 3), "shape|pixels"),
        (lambda t: t.grid((2**22,) * 3, spacing=1e-3), r"take slabs\(\) instead"),
        (lambda t: t.grid((1, 1, 1), spacing=[1, [2, 3], 1]), "spacing"),
        (lambda t: t.grid((1, 1, 1), tile=5), "tile"),
        (lambda t: t.grid((30_000, 30_000, 3_000)), "take slabs"),
    ],
)
def test_arguments_that_make_no_sense_are_refused_with_their_name(toy, call, message):
    with pytest.raises(EvaluationError, match=message):
        call(toy)


def test_a_texture_of_a_relative_path_goes_along_when_the_process_changes_its_folder(toy_folder, tmp_path, monkeypatch):
    monkeypatch.chdir(toy_folder.parent)
    texture = load(toy_folder.name, provider="cpu")
    pickled = pickle.dumps(texture)
    monkeypatch.chdir(tmp_path)
    assert np.array_equal(pickle.loads(pickled).sample([[1, 2, 3]]), copy.deepcopy(texture).sample([[1, 2, 3]]))


def test_a_pickled_texture_opens_the_bundle_that_it_had_and_no_other(toy_folder, tmp_path):
    """Wherever the package lies, an embedded one; one that was replaced or moved away is an error."""
    folder = tmp_path / "bundle"
    shutil.copytree(toy_folder, folder)
    pickled = pickle.dumps(load(folder))
    shutil.copy(embedded_folder("lichen") / "sampler.onnx", folder / "sampler.onnx")
    with pytest.raises(BundleError, match="no longer there"):
        pickle.loads(pickled)
    shutil.rmtree(folder)
    with pytest.raises(BundleError, match="no longer there"):
        pickle.loads(pickled)
    moved = tmp_path / "elsewhere" / "lichen"
    shutil.copytree(embedded_folder("lichen"), moved)
    pickled = pickle.dumps(load(moved))
    shutil.rmtree(moved)
    assert pickle.loads(pickled).bundle.folder == embedded_folder("lichen")


def test_a_copy_asks_for_as_many_threads_as_the_original_did(toy_folder, monkeypatch):
    asked, free = load(toy_folder, threads=2), load(toy_folder)
    monkeypatch.setattr(workers, "usable_threads", lambda: 5)
    assert [pickle.loads(pickle.dumps(texture)).threads for texture in (asked, free)] == [2, 5]


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda texture: pickle.loads(pickle.dumps(texture))])
def test_a_copy_in_this_process_or_another_is_the_same_texture(toy, copied):
    points = np.random.default_rng(0).normal(0, 100, (50, 3))
    again = copied(toy)
    np.testing.assert_array_equal(again.sample(points, 7), toy.sample(points, 7))
    assert (again.provider, again.precision, again.threads, again.name) == (toy.provider, toy.precision, toy.threads, toy.name)


def test_a_column_of_any_depth_costs_no_more_than_its_slabs(toy):
    column = toy.slabs((2**39, 1, 1), spacing=0.01)
    z, slab = next(column)
    assert (z, slab.shape) == (0, (16, 1, 1, 3))
    np.testing.assert_array_equal(slab, toy.grid((16, 1, 1), spacing=0.01))
    with pytest.raises(EvaluationError, match="more than an array can hold here"):
        toy.slabs((1, 1, 2**40), spacing=0.01)
