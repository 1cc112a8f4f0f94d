"""A blend in space is its first texture here, its second there, and goes from one to the other without a seam."""

import itertools
import json
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest

from solidgrain.export.bundle import Details, write_bundle
from solidgrain.runtime import BundleError, EvaluationError, ExemplarError, ProviderError, load_space, load_texture
from solidgrain.runtime.blend_file import BlendData, blend_of, read_blend
from solidgrain.runtime.bundle import BLEND, MANIFEST
from solidgrain.runtime.lattice import tiled
from solidgrain.runtime.mask import make_mask, make_ramp
from solidgrain.runtime.noise import noise_offsets, noise_tables
from solidgrain.runtime.texture_file import read_texture, write_archive
from tests.reference import blended_color
from tests.toy_space import LATENT, toy_space_weights

RAMP = (10.0, 74.0)  # pixels along x


@pytest.fixture(scope="module", params=["auto", "cpu"])
def space(toy_space_folder, request):
    """Every claim holds whatever evaluates the textures on their own."""
    return load_space(toy_space_folder, provider=request.param)


@pytest.fixture(scope="module")
def ends(space):
    codes = np.random.default_rng(0).standard_normal((2, LATENT))
    return space.texture(codes[0], "a"), space.texture(codes[1], "b")


@pytest.fixture(scope="module")
def ramp(space, ends):
    return space.blend_along(*ends, "x", *RAMP)


@pytest.fixture(scope="module")
def volume():
    """A mask of 3 x 4 x 5 voxels (z, y, x), different along every axis; 0 and 1 are among them."""
    return np.random.default_rng(4).choice([0, 0.25, 0.5, 1], (3, 4, 5)).astype(np.float32)


def weight_at(volume, point, origin, spacing):
    """Trilinear, clamped: a slow one."""
    place = [(p - o) / s - 0.5 for p, o, s in zip(point, origin, spacing, strict=True)]
    total = 0.0
    for corner in itertools.product((0, 1), repeat=3):
        share, index = 1.0, []
        for at, count, end in zip(place, volume.shape[::-1], corner, strict=True):
            inside = min(max(at, 0.0), count - 1.0)
            below = int(np.floor(inside))
            share *= inside - below if end else 1 - (inside - below)
            index.append(min(below + end, count - 1))
        total += share * float(volume[index[2], index[1], index[0]])
    return total


def test_it_is_each_texture_itself_where_it_is_all_of_it(ramp, ends):
    place = {"shape": (9, 20, 50), "seed": 3, "origin": (-38, 5, 7)}
    whole = ramp.grid(**place)
    assert np.array_equal(whole[:, :, :48], ends[0].grid(**place)[:, :, :48])
    assert not np.array_equal(whole[:, :, 48:], ends[0].grid(**place)[:, :, 48:])
    place["origin"] = (70, 5, 7)
    assert np.array_equal(ramp.grid(**place)[:, :, 4:], ends[1].grid(**place)[:, :, 4:])
    points = np.random.default_rng(0).uniform(-100, 200, (400, 3))
    found = ramp.sample(points, 3)
    for end, inside in zip(ends, (points[:, 0] <= RAMP[0], points[:, 0] >= RAMP[1]), strict=True):
        assert np.array_equal(found[inside], end.sample(points, 3)[inside])


@pytest.mark.parametrize("reach", [64.0, 1e6])
def test_it_is_the_formula_in_between(ramp, reach):
    points = np.random.default_rng(1).uniform(-reach, reach, (12, 3))
    points[:, 0] = np.random.default_rng(2).uniform(*RAMP, 12)
    weights, tables, offsets = toy_space_weights(), noise_tables(3, 16), noise_offsets(3, 16)
    expected = [
        blended_color(weights, ramp.data, tables, offsets, tuple(point), (point[0] - RAMP[0]) / (RAMP[1] - RAMP[0]))
        for point in points
    ]
    np.testing.assert_allclose(ramp.sample(points, 3), np.clip(expected, 0, 1), atol=1e-4)


def test_its_style_follows_the_line_between_both_codes_and_adapted_textures_keep_what_they_learned(space, ends):
    draw = np.random.default_rng(5)
    adapted = [
        space.open(replace(end.data, **{key: (array + draw.normal(0, 0.1, array.shape)).astype(array.dtype)
                                        for key, array in end.data.arrays().items() if key != "transforms"}))
        for end in ends
    ]  # fmt: skip
    data = space.blend_along(*adapted).data
    for knot in (0, 3, 8, 16):
        expected = space.blend(*adapted, knot / 16).data
        assert np.array_equal(data.gamma[knot], expected.gamma)
        assert np.array_equal(data.delta[knot], expected.delta)
    for end, texture in zip(data.ends, adapted, strict=True):
        assert end.sha256 == texture.data.sha256


def test_it_goes_on_smoothly_at_its_ends_at_its_knots_and_from_brick_to_brick(ramp):
    """Half the step is half the largest change, on a line across all of them; a seam would stay."""

    def largest(step):
        x = np.arange(RAMP[0] - 4, RAMP[1] + 4, step)
        return np.abs(np.diff(ramp.sample(np.stack([x, 0 * x + 3.3, 0 * x + 5.7], axis=1), 3), axis=0)).max()

    steps = [largest(step) for step in (1 / 16, 1 / 32, 1 / 64)]
    assert steps[0] < 0.1
    for coarse, fine in itertools.pairwise(steps):
        assert 0.4 < fine / coarse < 0.6


def test_grid_slabs_and_points_are_the_same_bits(ramp):
    place = {"shape": (7, 18, 70), "seed": 2, "origin": (7.25, -5, 3), "spacing": (1, 0.5, 2)}
    whole = ramp.grid(**place)
    for thickness in (1, 4):
        assert np.array_equal(np.concatenate([slab for _, slab in ramp.slabs(**place, slab=thickness)]), whole)
    voxels = np.random.default_rng(0).integers(0, (70, 18, 7), (200, 3))
    points = np.array(place["origin"]) + (voxels + 0.5) * np.array(place["spacing"])
    x, y, z = voxels.T
    assert np.array_equal(ramp.sample(points, 2), whole[z, y, x])
    assert np.array_equal(ramp.sample(points[:1], 2), whole[z[:1], y[:1], x[:1]])


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.uint8, np.uint16, bool])
def test_a_mask_lies_where_it_is_put_and_is_read_between_its_voxels(volume, kind):
    largest = {"u": np.iinfo(kind).max} if np.dtype(kind).kind == "u" else {}
    values = (volume * largest.get(np.dtype(kind).kind, 1)).round(7).astype(kind)
    expected = values / largest.get(np.dtype(kind).kind, 1)
    origin, spacing = (-3.0, 10.0, 0.5), (2.0, 3.0, 0.7)
    mask = make_mask(values, origin, spacing)
    points = np.random.default_rng(0).uniform(-6, 24, (300, 3))
    found = [weight_at(expected, point, origin, spacing) for point in points]
    np.testing.assert_allclose(mask.weights(points), found, atol=1e-6)
    centres = np.array(origin) + (np.array([[4, 0, 2], [0, 3, 1]]) + 0.5) * np.array(spacing)
    np.testing.assert_allclose(mask.weights(centres), [expected[2, 0, 4], expected[1, 3, 0]], atol=1e-6)


def test_a_mask_that_repeats_goes_from_its_last_voxel_to_its_first(volume):
    mask = make_mask(volume, (1, 2, 3), (2, 3, 0.7))
    points = np.random.default_rng(0).uniform(-40, 40, (300, 3))
    again = np.concatenate([volume] * 3, axis=2)
    expected = [weight_at(again, (np.mod(x - 1, 10) + 11, y, z), (1, 2, 3), (2, 3, 0.7)) for x, y, z in points]
    np.testing.assert_allclose(mask.weights(points, (True, False, False)), expected, atol=1e-6)


def test_a_ramp_runs_from_start_to_stop_either_way():
    points = np.array([[0, 0, z] for z in (-9, 10, 12.5, 20, 99)], float)
    np.testing.assert_allclose(make_ramp("z", 10, 20).weights(points), [0, 0, 0.25, 1, 1])
    np.testing.assert_allclose(make_ramp("z", 20, 10).weights(points), [1, 1, 0.75, 0, 0])


def test_a_blend_by_a_mask_is_the_formula_with_its_axes_in_order(space, ends, volume):
    origin, spacing = (-3.0, 10.0, 0.5), (8.0, 9.0, 10.0)
    blend = space.blend_by(*ends, volume, origin, spacing)
    weights, tables, offsets = toy_space_weights(), noise_tables(3, 16), noise_offsets(3, 16)
    points = np.random.default_rng(0).uniform((-3, 10, 0), (37, 46, 30), (12, 3))
    expected = [
        blended_color(weights, blend.data, tables, offsets, tuple(point), weight_at(volume, point, origin, spacing))
        for point in points
    ]
    np.testing.assert_allclose(blend.sample(points, 3), np.clip(expected, 0, 1), atol=1e-4)


def test_a_region_of_one_texture_inside_a_mask_is_that_texture_to_the_bit(space, ends):
    """A ball of the second texture in the first, in bricks that hold some of both: no voxel depends on its brick."""
    z, y, x = np.mgrid[:24, :24, :24] - 11.5
    ball = np.clip(10 - np.sqrt(x**2 + y**2 + z**2), 0, 1)
    blend = space.blend_by(*ends, ball, (0, 0, 0), 2.0)
    whole, alone = blend.grid((48, 48, 48), 1), [end.grid((48, 48, 48), 1) for end in ends]
    middles = np.stack(np.meshgrid(*[np.arange(48) + 0.5] * 3, indexing="ij")[::-1], axis=-1).reshape(-1, 3)
    weights = blend.data.mask.weights(middles).reshape(48, 48, 48)
    for value, end in zip((0, 1), alone, strict=True):
        assert (weights == value).sum() > 1000
        assert np.array_equal(whole[weights == value], end[weights == value])
    assert np.array_equal(blend.grid((5, 7, 9), 1, origin=(11, 13, 17)), whole[17:22, 13:20, 11:20])


def test_the_mask_stays_in_the_texture_when_the_grid_is_placed_in_it(space, ends, volume):
    """Turned, scaled and shifted: the voxel at p has the colour of M p."""
    blend = space.blend_by(*ends, volume, (-3, 10, 0.5), (8, 9, 10))
    matrix = np.array([[0, -1.5, 0.2, 20], [0.8, 0, 0, 12], [0, 0.3, 1, -2], [0, 0, 0, 1]])
    found = blend.grid((6, 7, 8), 3, transform=matrix)
    z, y, x = np.meshgrid(*(np.arange(count) + 0.5 for count in (6, 7, 8)), indexing="ij")
    points = np.stack([x, y, z, np.ones_like(x)], axis=-1) @ matrix.T
    expected = blend.sample(points[..., :3].reshape(-1, 3), 3).reshape(found.shape)
    np.testing.assert_allclose(found, expected, atol=2e-3)  # T M p is rounded elsewhere than T (M p): a seam would be tenths
    assert np.abs(found - expected).mean() < 1e-5


def test_across_its_ramp_it_tiles_without_a_seam(ramp):
    period = (48, 40, 64)  # z, y, x
    here = ramp.grid((4, 4, 30), 3, origin=(20, 38, 46), tile="yz", period=period)
    for k in (1, 2):
        origin = [20.0, 38.0, 46.0]
        origin[k] += period[2 - k]
        assert np.array_equal(ramp.grid((4, 4, 30), 3, origin=origin, tile="yz", period=period), here)

    def step(at):
        sides = [ramp.grid((4, 1, 60), 3, origin=(12, at + by - 0.5, 0), tile="yz", period=period) for by in (-5e-4, 5e-4)]
        return np.abs(sides[1] - sides[0]).max()

    assert step(40.0) < 3 * max(step(17.3), step(31.7)) < 0.01


def test_on_a_tile_it_is_the_formula_and_each_texture_where_it_is_all_of_it(ramp, ends):
    tiling = {"tile": "yz", "period": (48, 40, 64)}
    for end, x in zip(ends, (-30.0, 80.0), strict=True):
        place = {"shape": (3, 4, 5), "seed": 3, "origin": (x, 7, 9), **tiling}
        assert np.array_equal(ramp.grid(**place), end.grid(**place))
    used = tiled(ramp.transforms, (64.0, 40.0, 48.0), "yz")
    weights, tables, offsets = toy_space_weights(), noise_tables(3, 16), noise_offsets(3, 16)
    found = ramp.grid((1, 1, 6), 3, origin=(20, 31, 11), spacing=(9, 1, 1), **tiling)[0, 0]
    for k in range(6):
        x = 20 + (k + 0.5) * 9
        expected = blended_color(weights, ramp.data, tables, offsets, (x, 31.5, 11.5), (x - 10) / 64, used)
        np.testing.assert_allclose(found[k], np.clip(expected, 0, 1), atol=1e-4)


def test_a_mask_tiles_with_its_own_period_and_with_no_other(space, ends, ramp, volume):
    blend = space.blend_by(*ends, volume, (3, 0, 0), (8, 9, 10))
    there = blend.grid((6, 6, 6), 1, origin=(38, 3, 3), tile="xz", period=(30, 1, 40))
    assert np.array_equal(there, blend.grid((6, 6, 6), 1, origin=(-2, 3, 33), tile="xz", period=(30, 1, 40)))
    x = np.arange(39.0, 47.0, 1 / 64)  # over the seam at 40, and the place where the last voxel meets the first
    line = blend.grid((1, 1, len(x)), 1, origin=(39, 3, 3), spacing=(1 / 64, 1, 1), tile="x", period=(1, 1, 40 * 64))
    assert np.abs(np.diff(line[0, 0], axis=0)).max() < 0.05
    with pytest.raises(EvaluationError, match="a tile along x repeats after 64 pixels of x, its mask after 40"):
        blend.slabs((1, 1, 1), tile="x", period=(1, 1, 64))
    with pytest.raises(EvaluationError, match="a tile along x repeats after 64 pixels of x, its mask after 128"):
        ramp.grid_start((1, 1, 64), tile="x")
    there_and_back = {"tile": "x", "period": (1, 1, 128)}
    assert ramp.grid((1, 1, 1), origin=(-10, 0, 0), **there_and_back).shape == (1, 1, 1, 3)


def test_a_turned_tile_is_held_against_the_axis_that_it_repeats_along(ramp):
    quarter = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    ramp.grid_start((1, 1, 64), tile="x", transform=quarter)
    with pytest.raises(EvaluationError, match="a tile along y repeats after 64 pixels of x"):
        ramp.grid_start((1, 64, 64), tile="y", transform=quarter)


def test_whole_numbers_and_floats_make_the_same_blend(space, ends):
    places = ((0, 96), (0.0, 96.0), (np.float32(0), np.float64(96)))
    assert len({space.blend_along(*ends, "z", *place).data.sha256 for place in places}) == 1


@pytest.mark.parametrize("asked", [{"provider": "nonsense"}, {"provider": "cuda"}, {"precision": "float8"}])
def test_a_space_that_cannot_be_evaluated_as_asked_is_not_loaded(toy_space_folder, asked):
    with pytest.raises(ProviderError):
        load_space(toy_space_folder, **asked)


def test_a_manifest_that_says_another_patch_than_the_encoder_takes_is_refused(toy_space_folder, tmp_path):
    folder = shutil.copytree(toy_space_folder, tmp_path / "space")
    manifest = json.loads((folder / MANIFEST).read_text())
    (folder / MANIFEST).write_text(json.dumps(manifest | {"encoded_patch": 3}))
    with pytest.raises(BundleError, match=r"encoder\.onnx: takes .*, the manifest says 3² pixels"):
        load_space(folder)


def test_a_saved_blend_is_the_same_elsewhere(ramp, toy_space_folder, tmp_path):
    for name in ("one.sgt.npz", "two.sgt.npz"):
        ramp.save(tmp_path / name)
    assert (tmp_path / "one.sgt.npz").read_bytes() == (tmp_path / "two.sgt.npz").read_bytes()
    again = load_texture(
        tmp_path / "one.sgt.npz", bundle=toy_space_folder, provider="auto" if "kernel" in ramp.provider else "cpu"
    )
    assert (again.name, again.data.sha256) == ("a-b", ramp.data.sha256)
    assert np.array_equal(again.grid((3, 4, 80), 5), ramp.grid((3, 4, 80), 5))
    with pytest.raises(BundleError, match="needs the bundle"):
        load_texture(tmp_path / "one.sgt.npz")


def test_every_value_counts_in_its_checksum(ends, volume):
    first, second = (end.data for end in ends)
    masks = [
        make_mask(volume),
        make_mask(volume, (0, 0, 1)),
        make_mask(volume, spacing=(1, 1, 2)),
        make_mask(volume.transpose(1, 0, 2)),
        make_mask(volume.reshape(1, 12, 5)),
        make_mask(1 - volume),
        make_mask(volume == 1),
        make_ramp("x", 0, 128),
        make_ramp("y", 0, 128),
    ]
    blends = [blend_of("ab", [first, second], mask) for mask in masks]
    blends += [blend_of("ba", [second, first], masks[0]), blend_of("ab", [first, first, second], masks[0])]
    assert len({blend.sha256 for blend in blends}) == len(blends)
    assert replace(blends[0], name="another").sha256 == blends[0].sha256


def test_a_mask_that_is_changed_afterwards_changes_nothing(space, ends, volume):
    mine = volume.copy()
    blend = space.blend_by(*ends, mine)
    before = blend.data.mask.sha256
    mine[:] = 0
    assert blend.data.mask.sha256 == before


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((2, 2)), r"mask of shape \(2, 2\)"),
        (np.zeros((2, 2, 2, 3)), "expected a volume"),
        (np.zeros((0, 2, 2)), "at least one voxel"),
        (np.full((1, 1, 2), np.nan), "values from nan"),
        (np.array([0.0, 0.5, np.nan]).reshape(3, 1, 1), "values from nan"),  # not in the first plane
        (np.full((1, 1, 2), 1.5), "to 1.5, expected 0 to 1"),
        (np.full((1, 1, 2), -0.5), "from -0.5"),
        (np.zeros((1, 1, 2), np.int64), "mask of int64"),
        ([["a"]], "mask of"),
        ([[[0], [0, 1]]], "mask"),
    ],
)
def test_what_is_no_mask_is_refused(space, ends, values, message):
    with pytest.raises(EvaluationError, match=message):
        space.blend_by(*ends, values)


@pytest.mark.parametrize(
    "place", [{"origin": (0, 0)}, {"origin": (0, 0, np.inf)}, {"spacing": 0}, {"spacing": (1, -1, 1)}, {"spacing": 1e-310}]
)
def test_a_mask_without_a_place_is_refused(space, ends, volume, place):
    with pytest.raises(EvaluationError, match="mask at"):
        space.blend_by(*ends, volume, **place)


@pytest.mark.parametrize(("axis", "start", "stop"), [("w", 0, 1), ("x", 3, 3), ("x", 0, np.nan), ("x", 0, np.inf)])
def test_a_ramp_to_nowhere_is_refused(space, ends, axis, start, stop):
    with pytest.raises(EvaluationError, match=r"axis 'w'|two different places"):
        space.blend_along(*ends, axis, start, stop)


def test_only_textures_of_the_space_that_are_one_everywhere_are_blended(space, ends, ramp, tmp_path):
    folder = write_bundle(tmp_path / "other", toy_space_weights(seed=6), Details(name="other", patch=128))
    other = load_space(folder).texture(np.ones(LATENT), "other")
    with pytest.raises(BundleError, match="only textures of one space"):
        space.blend_along(ends[0], other)
    with pytest.raises(BundleError, match="is a blend in space"):
        space.blend(ramp, ends[1], 0.5)
    with pytest.raises(BundleError, match="no latent code"):
        space.blend_along(ends[0], space.open(ramp.data.ends[1]))


def test_what_has_no_transitions_is_refused(toy_space_folder, ramp, tmp_path):
    ramp.save(tmp_path / "ab.sgt.npz")
    with pytest.raises(ProviderError, match="the fused kernel does not know transitions"):
        load_texture(tmp_path / "ab.sgt.npz", bundle=toy_space_folder, provider="kernel")
    with pytest.raises(ProviderError, match="are float32"):
        load_texture(tmp_path / "ab.sgt.npz", bundle=toy_space_folder, precision="bfloat16")
    old = shutil.copytree(toy_space_folder, tmp_path / "old")
    manifest = json.loads((old / MANIFEST).read_text())
    del manifest["files"][BLEND]
    (old / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(BundleError, match=r"old: has no blend\.onnx, which blends in space need; export the space again"):
        load_texture(tmp_path / "ab.sgt.npz", bundle=old)


@pytest.fixture
def parts(ramp):
    """Header and arrays of a blend's file, for breaking."""
    header = {"format": "solidgrain-blend", "format_version": 1, "name": "ab", "sampler_sha256": ramp.data.sampler_sha256}
    place = {"origin": np.zeros(3), "spacing": np.ones(3)}
    return header, {**ramp.data.arrays(), "mask": ramp.data.mask.values, **place}


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("gamma", np.zeros((17, 5), np.float32), "gamma has shape"),
        ("gamma", np.zeros((1, 5, 128), np.float32), "gamma has shape"),
        ("delta", np.full((17, 5, 128), np.nan, np.float32), "delta is not finite"),
        ("transforms", np.zeros((32, 3, 3), np.float32), "transforms is not finite float64"),
        ("transforms", np.zeros((31, 3, 3)), "transforms has shape"),
        ("noise_weights", np.zeros((1, 4, 4, 128), np.float32), "noise_weights has shape"),
        ("mask", np.zeros((2, 2), np.float32), "mask of shape"),
        ("mask", np.full((1, 1, 2), 2, np.float32), "mask has values"),
        ("spacing", np.zeros(3), "mask at"),
        ("origin", np.zeros(2), "origin has shape"),
    ],
)
def test_a_damaged_blend_is_refused(parts, tmp_path, name, value, message):
    header, arrays = parts
    write_archive(tmp_path / "bad.sgt.npz", header, {**arrays, name: value})
    with pytest.raises(BundleError, match=rf"bad\.sgt\.npz: {message}"):
        read_blend(tmp_path / "bad.sgt.npz")


def test_another_format_or_version_is_refused(parts, tmp_path, ramp):
    header, arrays = parts
    path = tmp_path / "odd.sgt.npz"
    write_archive(path, {**header, "format_version": 2}, arrays)
    with pytest.raises(BundleError, match="solidgrain-blend version 2, expected solidgrain-blend version 1"):
        load_texture(path)
    write_archive(path, header, {name: array for name, array in arrays.items() if name != "mask"})
    with pytest.raises(BundleError, match="not a texture file, or a damaged one"):
        load_texture(path)
    ramp.save(path)
    with pytest.raises(BundleError, match="solidgrain-blend version 1, expected solidgrain-texture version 1"):
        read_texture(path)
    path.write_bytes(path.read_bytes()[:-400])
    with pytest.raises(BundleError, match="not a texture file, or a damaged one"):
        load_texture(path)


def test_a_texture_of_another_shape_is_refused(parts, tmp_path, toy_space_folder):
    header, arrays = parts
    write_archive(
        tmp_path / "odd.sgt.npz", header, {**arrays, "gamma": arrays["gamma"][:, :4], "delta": arrays["delta"][:, :4]}
    )
    with pytest.raises(BundleError, match="gamma of texture 'ab' has shape"):
        load_texture(tmp_path / "odd.sgt.npz", bundle=toy_space_folder)


def test_a_colour_that_comes_out_as_no_number_is_an_error(space, ramp):
    data = ramp.data
    delta = data.delta.copy()
    delta[1:-1] = 3e38
    broken = BlendData(
        "broken", data.sampler_sha256, ("a", "b"), data.transforms, data.gamma, delta, data.noise_weights, data.mask
    )
    with pytest.raises(EvaluationError, match=r"broken: the sampler returned NaN at \(42"):
        space.open(broken).sample([[42.0, 0, 0]])


def test_a_copy_of_a_space_is_the_same_space(space):
    again, code = pickle.loads(pickle.dumps(space)), np.full(LATENT, 0.1, np.float32)
    assert np.array_equal(again.texture(code).sample([[1, 2, 3]]), space.texture(code).sample([[1, 2, 3]]))
    with pytest.raises(ExemplarError, match="above 0"):
        space.encode(np.zeros((64, 64, 3), np.uint8), scale="2")
