"""A folder of photographs: which of its files are read, where their crops come from, and which are never shown."""

from __future__ import annotations

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from solidgrain.runtime import ExemplarError
from solidgrain.train.collection import LEVELS, choose_held_out, draw_patches, read_members, wraps
from solidgrain.train.settings import preset
from tests.train.spaces import numbered, photographs, picture, write

NAMES = [f"{number}.png" for number in range(20)]


def generator():
    return torch.Generator().manual_seed(0)


def members_of(folder, skip=False, warnings=None):
    return list(read_members(folder, 128, skip, [].append if warnings is None else warnings.append))


def test_sizes_and_formats_may_be_mixed_and_other_files_are_ignored(tmp_path):
    wanted = {
        "a.PNG": (picture(130, 150, 0), oiio.UINT8, 0.5 / 255),
        "b.jpg": (picture(200, 128, 1), oiio.UINT8, 0.1),
        "c.tiff": (picture(128, 160, 2), oiio.UINT16, 1 / LEVELS),
        "d.exr": (picture(129, 129, 3), oiio.HALF, None),  # linear, so that its numbers change
        "e.png": (picture(140, 140, 4)[..., :1], oiio.UINT8, 0.5 / 255),
    }
    for name, (pixels, kind, _) in wanted.items():
        write(tmp_path / name, pixels, kind)
    (tmp_path / "README.txt").write_text("CC0")
    (tmp_path / ".a.png").write_text("what an operating system leaves beside a.png")
    (tmp_path / "more.png").mkdir()
    found = members_of(tmp_path)
    assert [member.name for member in found] == list(wanted)
    for member, (pixels, _, tolerance) in zip(found, wanted.values(), strict=True):
        assert member.exemplar.shape == (*pixels.shape[:2], 3)
        if tolerance is not None:
            assert np.abs(member.exemplar - pixels).max() <= tolerance + 1 / LEVELS
    assert found[3].colorspace != found[0].colorspace


@pytest.mark.parametrize("tiles", [(True, True), (True, False), (False, True), (False, False)])
def test_images_that_tile_are_recognised_axis_by_axis(tiles):
    assert [wraps(picture(140, 180, seed, tiles)) for seed in range(5)] == 5 * [tiles]


def test_what_has_a_frame_does_not_tile():
    framed = np.pad(0.4 + 0.2 * picture(140, 180, 0, (True, True)), ((3, 3), (3, 3), (0, 0)))
    assert wraps(framed) == (False, False)


def places(member, count=100, size=64):
    """Rows and columns [count, size] of random crops."""
    draw = generator()
    crops = torch.stack([member.crop(size, draw) for _ in range(count)]).mul(LEVELS).round().int()
    assert crops.shape == (count, 3, size, size)
    return crops[:, 0, :, 0], crops[:, 1, 0, :]


@pytest.mark.parametrize("tiles", [(True, False), (False, True), (False, False)])
def test_crops_cross_the_edges_of_images_that_tile_and_no_others(tiles):
    """Within a crop each row follows the one before; across an edge the first follows the last."""
    for extent, continues, found in zip((100, 80), tiles, places(numbered(7, 100, 80, tiles)), strict=True):
        steps = found.diff(dim=1)
        assert set(steps.unique().tolist()) == ({1, 1 - extent} if continues else {1})
        assert set(found.unique().tolist()) == set(range(extent))  # all of the image is seen
        assert len(found[:, 0].unique()) > (30 if continues else 10)


def test_a_crop_as_large_as_the_image_is_the_image():
    rows, columns = places(numbered(7, 64, 64), count=3)
    assert (rows == torch.arange(64)).all()
    assert (columns == torch.arange(64)).all()


@pytest.mark.parametrize(("grain", "ways"), [("none", 8), ("x", 4)])
def test_all_patches_drawn_of_a_member_are_its_own_turned_every_way_that_its_grain_allows(grain, ways):
    patches = draw_patches(numbered(7, 130, 190), 32, 200, preset("fast space", grain=grain), generator())
    levels = patches.mul(LEVELS).round().int()
    assert (levels[:, 2] == 7).all()
    corners = levels[:, :2, [0, 0, 1], [0, 1, 0]]  # (200, 2, 3): how the image's rows and columns run in the patch
    assert len((corners[..., 1:] - corners[..., :1]).flatten(1).unique(dim=0)) == ways


def test_so_many_are_held_out_by_a_draw_that_depends_on_the_seed_alone():
    held_out = choose_held_out(NAMES, 5, seed=3)
    assert len(held_out) == 5
    assert choose_held_out(NAMES, 5, seed=3) == held_out
    assert choose_held_out(NAMES, 6, seed=3) > held_out
    assert choose_held_out(NAMES, 5, seed=4) != held_out
    assert choose_held_out(NAMES, 0, seed=3) == frozenset()


def test_the_listed_ones_are_held_out_and_a_name_that_is_not_there_is_an_error():
    assert choose_held_out(NAMES, ["3.png", "7.png"], 0) == {"3.png", "7.png"}
    with pytest.raises(ExemplarError, match=r"no readable photograph 77\.png"):
        choose_held_out(NAMES, ["3.png", "77.png"], 0)


@pytest.mark.parametrize("wanted", [19, 20, 99, NAMES[1:]])
def test_at_least_two_are_left_to_train_on(wanted):
    with pytest.raises(ExemplarError, match=r"20 photographs, .*expected at least 2 to train on"):
        choose_held_out(NAMES, wanted, 0)


def damage(folder, kind):
    """A file of the folder that cannot be used. Its name."""
    path = folder / "stone1.png"
    content = path.read_bytes()
    if kind == "too small":
        write(path, picture(127, 400, 0))
    else:
        path.write_bytes({"empty": b"", "no image": b"hello" * 100, "cut short": content[: len(content) // 2]}[kind])
    return path.name


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("empty", "the file is empty"),
        ("no image", "not readable as an image"),
        ("cut short", "damaged or cut short"),
        ("too small", "400x127 pixels, expected at least 128x128"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_and_refused_or_left_out(tmp_path, kind, reason):
    folder, warnings = photographs(tmp_path / "stones", 3), []
    name = damage(folder, kind)
    with pytest.raises(ExemplarError, match=rf"{name}.*{reason}[^\n]*; or leave such files out with --skip-unreadable$"):
        members_of(folder)
    assert [member.name for member in members_of(folder, True, warnings)] == ["stone0.png", "stone2.png"]
    (warning,) = warnings
    assert name in warning
    assert reason in warning
    assert "--patch" not in warning  # a smaller one would not help: the encoder sees 128 pixels


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "no such folder"),
        (lambda path: path.write_text("hello"), "no such folder"),
        (lambda path: path.mkdir(), "no photographs in it; expected files ending in .bmp"),
        (lambda path: (path.mkdir(), (path / "README.txt").write_text("CC0")), "no photographs in it"),
    ],
)
def test_a_folder_without_photographs_is_an_error(tmp_path, make, message):
    make(tmp_path / "stones")
    with pytest.raises(ExemplarError, match=message):
        members_of(tmp_path / "stones", skip=True)


def test_what_a_file_says_of_its_colours_that_cannot_be_honoured_is_passed_on(tmp_path, monkeypatch):
    from solidgrain.train import collection

    read = collection.read_photograph
    monkeypatch.setattr(collection, "read_photograph", lambda *how: read(*how)._replace(warning="its profile is grey"))
    warnings = []
    members_of(photographs(tmp_path / "stones", 2), warnings=warnings)
    assert warnings == [f"{tmp_path}/stones/stone{number}.png: its profile is grey" for number in (0, 1)]
