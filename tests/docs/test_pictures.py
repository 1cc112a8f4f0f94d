"""The pictures of the embedded textures: what is in the gallery, and that carved objects are measured truly."""

from __future__ import annotations

import os

import numpy as np
import pytest

pytest.importorskip("torch", reason="slices are turned with torch: pip install 'solidgrain[train]'")

import OpenImageIO as oiio

from docs import carving, pictures
from solidgrain.export.bundle import Details, write_bundle
from solidgrain.export.sheet import GAP
from solidgrain.runtime import bundle
from tests.toy import toy_weights

SIDE = 32


def test_an_oriented_texture_s_oblique_slice_holds_the_grain():
    for grain, axis in (("x", 0), ("y", 1)):
        rotation = pictures.oblique_rotation(grain)
        np.testing.assert_allclose(rotation[:, axis], np.eye(3)[axis], atol=1e-7)
    for grain in ("none", "x", "y"):
        normal = pictures.oblique_rotation(grain)[:, 2]
        assert np.abs(normal).max() < 0.95  # along none of the axes


def test_a_texture_without_its_photograph_has_a_white_panel_in_its_row(tmp_path, monkeypatch, capsys):
    training = {"exemplars": [{"exemplar": "lost.png", "sha256": "0"}], "settings": {"grain": "x"}}
    write_bundle(tmp_path / "embedded" / "toy", toy_weights(), Details(name="toy", patch=64, training=training))
    monkeypatch.setattr(bundle, "_embedded_root", lambda: tmp_path / "embedded")
    monkeypatch.setattr(pictures, "SIDE", SIDE)
    pictures.main(["--exemplars", f"{tmp_path}/none", "--out", f"{tmp_path}"])
    assert capsys.readouterr().err.startswith("toy: no lost.png in ")
    gallery = oiio.ImageBuf(os.fspath(tmp_path / "gallery.jpg")).get_pixels(oiio.UINT8)
    side = 2 * SIDE
    assert gallery.shape[1] == 4 * side + 5 * GAP
    columns = [GAP + number * (side + GAP) for number in range(4)]
    lost, axis, oblique, carved = (gallery[GAP : GAP + side, left : left + side] for left in columns)
    assert lost[:, 8:-8].min() > 240
    assert max(axis.mean(), oblique.mean()) < 200
    assert carved[:4, :4].min() > 240  # its background
    assert carved[side // 3, side // 3].max() < 220
    assert (gallery[GAP + side :] < 100).any()  # the labels


@pytest.mark.parametrize("shape", carving.SHAPES)
def test_no_object_is_nearer_than_its_distance_says(shape):
    draw = np.random.default_rng(0)
    points = draw.uniform(-1.2, 1.2, (20000, 3))
    steps = draw.normal(0, 0.05, points.shape)
    change = np.abs(shape(points + steps) - shape(points))
    assert (change <= np.linalg.norm(steps, axis=1) * (1 + 1e-9)).all()


@pytest.mark.parametrize("shape", carving.SHAPES)
def test_an_object_fits_its_picture(shape, toy):
    picture = carving.draw(toy, shape, side=48, pixels=64)
    border = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
    np.testing.assert_array_equal(border, 1)
    assert 0.2 < (picture < 1).any(-1).mean() < 0.8
