"""Tiling moves the transforms as little as it must and gives each octave an exact period."""

import itertools
import math
import warnings

import numpy as np
import pytest

from solidgrain.runtime import EvaluationError
from solidgrain.runtime.lattice import lattice_basis, tiled, untiled

AXES = ["".join(axes) for count in (1, 2, 3) for axes in itertools.combinations("xyz", count)]


def transforms(count: int = 16, seed: int = 0) -> np.ndarray:
    orthogonal = np.linalg.qr(np.random.default_rng(seed).standard_normal((count, 3, 3)))[0]
    return orthogonal * (2.0 ** (7 * np.arange(count) / (count - 1)) / 64)[:, None, None]


def reduce(cell: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """The canonical representative of a cell, one floor division per axis."""
    cell = cell.astype(float)
    for k in range(3):
        cell = cell - np.floor(cell[k] / basis[k, k]) * basis[:, k]
    return cell


@pytest.mark.parametrize("axes", AXES)
def test_a_period_lands_on_the_lattice_of_every_octave(axes):
    period = (96.0, 128.0, 65.0)
    tiling = tiled(transforms(), period, axes)
    draw = np.random.default_rng(1)
    for moved, basis in zip(tiling.transforms, tiling.lattice, strict=True):
        for axis in axes:
            step = np.zeros(3)
            step["xyz".index(axis)] = period["xyz".index(axis)]
            shift = moved @ step
            assert np.abs(shift - np.rint(shift)).max() < 1e-9
            cell = draw.integers(-500, 500, 3)
            assert np.array_equal(reduce(cell, basis), reduce(cell + np.rint(shift).astype(int), basis))


@pytest.mark.parametrize("axes", AXES)
def test_axes_that_do_not_tile_are_not_moved(axes):
    tiling = tiled(transforms(), (96.0, 128.0, 65.0), axes)
    others = [k for k in range(3) if "xyz"[k] not in axes]
    assert np.array_equal(tiling.transforms[:, :, others], transforms()[:, :, others])


def test_basis_is_lower_triangular_and_has_the_determinant_of_what_it_was_made_from():
    draw = np.random.default_rng(2)
    for _ in range(200):
        columns = draw.integers(-200, 200, (3, 3))
        determinant = round(np.linalg.det(columns))
        if determinant:
            basis = lattice_basis(columns)
            assert np.array_equal(basis, np.tril(basis))
            assert math.prod(np.diag(basis)) == abs(determinant)


def test_entries_left_of_a_pivot_are_smaller_than_it():
    draw = np.random.default_rng(3)
    for count in (1, 2, 3):
        basis = lattice_basis(draw.integers(-9000, 9000, (3, count)))
        for row in (1, 2):
            assert (basis[row, :row] >= 0).all()
            assert (basis[row, :row] < basis[row, row]).all()


def test_distortion_is_small_for_high_octaves_and_reported_for_low_ones():
    distortion = tiled(transforms(), (128.0, 128.0, 128.0), "xyz").distortion
    assert distortion[8:].max() < 0.06
    assert distortion.max() < 0.8


def test_an_octave_slower_than_the_tile_is_nudged_to_full_rank():
    slow = np.eye(3)[None] * 1e-3
    tiling = tiled(slow, (64.0, 64.0, 64.0), "xyz")
    assert np.linalg.matrix_rank(tiling.transforms[0]) == 3


def test_without_tiling_every_octave_repeats_as_its_table_does():
    tiling = untiled(transforms())
    assert np.array_equal(tiling.lattice, np.broadcast_to(64 * np.eye(3), (16, 3, 3)))
    assert not tiling.distortion.any()


@pytest.mark.parametrize(("period", "axes"), [((64.0, 64.0, 64.0), "xw"), ((64.0, 64.0, 64.0), "xx"), ((0.0, 64.0, 64.0), "x")])
def test_axes_and_periods_that_make_no_sense_are_refused(period, axes):
    with pytest.raises(EvaluationError, match="tile"):
        tiled(transforms(), period, axes)


def test_a_period_without_an_exact_seam_is_refused_without_warnings():
    with warnings.catch_warnings(), pytest.raises(EvaluationError, match="too large for an exact seam"):
        warnings.simplefilter("error")
        tiled(np.eye(3)[None], (2.0**70, 1.0, 1.0), "x")
