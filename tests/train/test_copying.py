"""The check for copies finds them wherever and however they are turned, and lets invention pass."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from solidgrain.export.figures import about
from solidgrain.train.copying import SHOWN, SIDE, measure_copying, search
from solidgrain.train.cuts import as_image
from solidgrain.train.slices import Planes
from tests.train.conftest import blotches

MATERIAL = blotches(128, 256)
EXEMPLAR, REST = (np.ascontiguousarray(half) for half in np.split(MATERIAL, 2, axis=1))


def crops_of(image):
    """A texture whose every slice is a crop of an image."""

    def sample(points, seed):
        size = round(len(points) ** 0.5)
        top, left = np.random.default_rng(seed).integers(0, [extent - size + 1 for extent in image.shape[:2]])
        return image[top : top + size, left : left + size].reshape(-1, 3)

    return sample


def test_more_of_the_same_material_is_no_copy():
    copying, pairs = measure_copying(EXEMPLAR, crops_of(REST))
    assert copying.patches == 256
    assert 0.95 < copying.ratio < 1.05
    assert copying.closer < 0.05
    assert all(pair.distance > 0.5 * copying.floor for pair in pairs)


@pytest.mark.parametrize("turned", [EXEMPLAR, EXEMPLAR[::-1], EXEMPLAR[:, ::-1], EXEMPLAR[::-1].transpose(1, 0, 2)])
def test_a_texture_that_copies_is_caught_however_it_turns_its_copies(turned):
    copying, pairs = measure_copying(EXEMPLAR, crops_of(np.ascontiguousarray(turned)))
    assert copying.ratio == 0
    assert copying.closer == 1
    for pair in pairs:
        np.testing.assert_array_equal(pair.patch, pair.nearest)


def test_a_texture_that_copies_with_a_little_noise_is_caught():
    noisy = EXEMPLAR + np.random.default_rng(1).normal(0, 0.02, EXEMPLAR.shape).astype(np.float32)
    copying, _ = measure_copying(EXEMPLAR, crops_of(noisy))
    assert copying.ratio < 0.2
    assert copying.closer == 1


def test_of_a_mirrored_exemplar_the_floor_is_that_of_one_side():
    mirrored = np.concatenate([EXEMPLAR, EXEMPLAR[:, ::-1]], axis=1)
    assert 0.95 < measure_copying(mirrored, crops_of(REST))[0].ratio < 1.05
    assert measure_copying(mirrored, crops_of(mirrored))[0].ratio == 0


def test_half_a_copy_shows_in_the_share():
    def sample(points, seed):
        return crops_of(EXEMPLAR if seed % 4 < 2 else REST)(points, seed)

    assert 0.45 < measure_copying(EXEMPLAR, sample)[0].closer < 0.6


def test_with_a_grain_transposed_patches_are_no_copies():
    copying, _ = measure_copying(EXEMPLAR, crops_of(np.ascontiguousarray(EXEMPLAR.transpose(1, 0, 2))), planes=Planes("x"))
    assert copying.ratio > 0.8


def test_the_search_finds_what_comparing_with_every_place_finds():
    draw = torch.Generator().manual_seed(3)
    image, patches = torch.rand(1, 3, 41, 57, generator=draw), torch.rand(6, 3, SIDE, SIDE, generator=draw)
    distances, nearest = search(image, patches, "none")
    everywhere = torch.stack(
        [
            turned[0, :, top : top + SIDE, left : left + SIDE]
            for turned in turns_of(image)
            for top in range(turned.shape[2] - SIDE + 1)
            for left in range(turned.shape[3] - SIDE + 1)
        ]
    )
    for patch, distance, found in zip(patches, distances, nearest, strict=True):
        errors = (everywhere - patch).square().mean((1, 2, 3)).sqrt()
        assert float(distance) == pytest.approx(float(errors.min()), abs=1e-6)
        assert float((found - patch).square().mean().sqrt()) == pytest.approx(float(distance))


def turns_of(image):
    for flips in ((), (2,), (3,), (2, 3)):
        flipped = image.flip(flips)
        yield from (flipped, flipped.transpose(2, 3))


def test_pairs_are_the_nearest_of_all_in_order():
    _, pairs = measure_copying(EXEMPLAR, crops_of(REST))
    distances = [pair.distance for pair in pairs]
    assert len(pairs) == SHOWN
    assert distances == sorted(distances)
    for pair in pairs:
        assert pair.patch.shape == pair.nearest.shape == (SIDE, SIDE, 3)
        assert pair.distance == pytest.approx(float(np.sqrt(((pair.patch - pair.nearest) ** 2).mean())), rel=1e-5)


@pytest.mark.parametrize("texture", [REST, EXEMPLAR])
def test_of_an_exemplar_that_repeats_itself_copying_cannot_be_told(texture):
    """Each half holds all of the other: what is as far from it as they are from each other is a copy, too."""
    tiles = np.tile(EXEMPLAR[:16, :16], (8, 8, 1))
    copying, pairs = measure_copying(tiles, crops_of(texture))
    assert (copying.ratio, copying.closer, copying.said()) == (None, None, "–")
    assert len(pairs) == SHOWN
    assert "cannot be told" in about(copying)


def test_the_largest_search_is_done_in_bands_with_the_same_result(monkeypatch):
    image, patches = as_image(MATERIAL), as_image(REST)[:, :, 5 : 5 + SIDE, 9 : 9 + SIDE]
    whole = search(image, patches, "none")
    monkeypatch.setattr("solidgrain.train.copying.BAND", 1)
    for one, other in zip(whole, search(image, patches, "none"), strict=True):
        torch.testing.assert_close(one, other)
