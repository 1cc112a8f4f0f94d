"""The sheet of an evaluation: a PNG or one HTML file, the same every time, with what it says it shows."""

from __future__ import annotations

import base64
import json
import os
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

pytest.importorskip("torch", reason="evaluating needs torch: pip install 'solidgrain[evaluate]'")
pytest.importorskip(
    "stlpips_pytorch", reason="the VGG-16 weights come with stlpips-pytorch: pip install 'solidgrain[evaluate]'"
)

import OpenImageIO as oiio

from solidgrain.export.figures import Figures
from solidgrain.export.sheet import GAP, aligned, as_html, make_sheet, write_sheet
from solidgrain.runtime import load_texture
from solidgrain.runtime.errors import SolidgrainError
from solidgrain.train.copying import Pair
from solidgrain.train.preview import as_png
from solidgrain.train.slices import ALL_PLANES
from tests.train.conftest import blotches

EXEMPLAR = blotches(80, 96)
FIGURES = Figures("Before <all>", ("measure", "floor"), [("gram", "0.5"), ("color & more", "1")], "After")
PAIRS = [Pair(np.full((15, 15, 3), 0.1 * i, np.float32), np.full((15, 15, 3), 0.9, np.float32), 0.1 * i) for i in range(8)]


def coordinates(points, seed):
    """A texture whose colour says where it was asked: the fraction of each coordinate, in steps of 512 pixels."""
    return (points / 512 % 1).astype(np.float32)


@pytest.fixture(scope="module")
def sheet():
    return make_sheet("toy", EXEMPLAR, coordinates, ALL_PLANES, PAIRS, FIGURES)


def pixels_of(data, tmp_path):
    (tmp_path / "part.png").write_bytes(data)
    return np.asarray(oiio.ImageBuf(os.fspath(tmp_path / "part.png")).get_pixels(oiio.UINT8))


def steps(picture):
    """Exemplar pixels between neighbours of a slice of `coordinates` along x and y, read off its colours."""
    values = picture[::4, ::4].astype(np.float64) / 255 * 512  # each pixel of an exemplar of 80 pixels is drawn 4 x 4
    across, down = values[:, 40] - values[:, 20], values[40] - values[20]
    return [np.linalg.norm(np.median((difference + 256) % 512 - 256, axis=0)) / 20 for difference in (across, down)]


def test_slices_have_the_exemplar_s_scale_and_the_wide_one_twice_its_width(sheet):
    (_, exemplar), *axis = sheet.rows[0]
    (wide_label, wide), *oblique = sheet.rows[1]
    np.testing.assert_array_equal(exemplar[::4, ::4], np.round(EXEMPLAR[:, 8:88] * 255).astype(np.uint8))
    assert wide_label == "twice the width"
    for _, picture in [*axis, *oblique]:
        assert picture.shape == exemplar.shape == wide.shape
        np.testing.assert_allclose(steps(picture), 1, atol=0.2)
    np.testing.assert_allclose(steps(wide), 2, atol=0.2)


def test_three_slices_lie_along_the_axes_and_three_do_not(sheet):
    def varying(picture):
        """How many channels change in the slice: an axis-aligned one has two."""
        return sum(np.ptp(picture[..., channel].astype(int)) > 2 for channel in range(3))

    assert [varying(picture) for _, picture in sheet.rows[0][1:]] == [2, 2, 2]
    assert [varying(picture) for _, picture in sheet.rows[1][1:]] == [3, 3, 3]


def test_each_patch_is_drawn_beside_its_nearest(sheet):
    drawn = [one for row in sheet.rows[2:] for one in row]
    assert [label for label, _ in drawn] == [f"{pair.distance:.4f}" for pair in PAIRS]
    for (_, picture), pair in zip(drawn, PAIRS, strict=True):
        width = picture.shape[1]
        assert abs(int(picture[5, 5, 0]) - 255 * pair.patch[0, 0, 0]) <= 0.51
        assert picture[5, width - 5, 0] == 230


class Reader(HTMLParser):
    def __init__(self):
        super().__init__()
        self.pictures, self.cells, self.open, self.others = [], [], [], []

    def handle_starttag(self, tag, attributes):
        self.open.append(tag)
        for name, value in attributes:
            if name == "src":
                self.pictures.append(base64.b64decode(value.removeprefix("data:image/png;base64,"), validate=True))
            if name in ("href", "srcset"):
                self.others.append(value)

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.cells.append(data)

    def handle_endtag(self, tag):
        if tag in self.open:
            while self.open.pop() != tag:
                pass


def test_the_page_needs_no_other_file_and_holds_every_picture_and_figure(sheet, tmp_path):
    reader = Reader()
    reader.feed(as_html(sheet))
    assert len(reader.pictures) == 16
    assert reader.others == []
    assert reader.cells == ["measure", "floor", "gram", "0.5", "color & more", "1"]
    shown = [picture for row in sheet.rows for _, picture in row]
    for data, picture in zip(reader.pictures, shown, strict=True):
        np.testing.assert_array_equal(pixels_of(data, tmp_path), picture)


def test_a_png_that_we_write_is_what_openimageio_reads(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (13, 7, 3), np.uint8)
    np.testing.assert_array_equal(pixels_of(as_png(pixels), tmp_path), pixels)


@pytest.mark.parametrize("name", ["sheet.png", "sheet.html", "sheet.PNG"])
def test_a_sheet_is_the_same_bytes_every_time(sheet, tmp_path, name):
    write_sheet(tmp_path / name, sheet)
    first = (tmp_path / name).read_bytes()
    write_sheet(tmp_path / name, make_sheet("toy", EXEMPLAR, coordinates, ALL_PLANES, PAIRS, FIGURES))
    assert (tmp_path / name).read_bytes() == first


def test_the_picture_has_its_pictures_and_text_on_white(sheet, tmp_path):
    write_sheet(tmp_path / "sheet.png", sheet)
    page = pixels_of((tmp_path / "sheet.png").read_bytes(), tmp_path)
    _, exemplar = sheet.rows[0][0]
    rows, columns = np.nonzero((page == exemplar[0, 0]).all(-1))
    assert any(
        np.array_equal(page[top : top + len(exemplar), left : left + exemplar.shape[1]], exemplar)
        for top, left in zip(rows[:50], columns[:50], strict=True)
    )
    bottom = page[-60:]
    assert (bottom == 255).mean() > 0.8
    assert (bottom < 60).any()


def test_a_page_is_as_wide_as_its_table(sheet, tmp_path):
    """No column is cut off: a wider table ends as far from the page's edge."""
    wide = Figures("", ("measure", "m" * 145, "last column"), [("gram", "0.5", "1.0")], "")
    write_sheet(tmp_path / "sheet.png", replace(sheet, figures=wide))
    page = pixels_of((tmp_path / "sheet.png").read_bytes(), tmp_path)
    assert page.shape[1] > 165 * 8
    assert (page[:, -GAP:] == 255).all()


def test_a_sheet_that_cannot_be_written_is_one_line(sheet, tmp_path):
    (tmp_path / "sheet.html").mkdir()
    with pytest.raises(SolidgrainError, match=r"--sheet .*cannot write"):
        write_sheet(tmp_path / "sheet.html", sheet)


def test_the_command_writes_the_sheet_and_reports_copying(solidgrain, toy_folder, tmp_path):
    oiio.ImageBuf(EXEMPLAR).write(os.fspath(tmp_path / "exemplar.png"), oiio.UINT8)
    outcome = solidgrain(
        "evaluate", toy_folder, "--exemplar", tmp_path / "exemplar.png", "--slices", 1, "--sheet", tmp_path / "a.html", "--json"
    )
    assert outcome.code == 0, outcome.err
    found = json.loads(outcome.out)
    assert found["copying"].keys() == {"patches", "floor", "ratio", "closer"}
    assert (found["texture"], found["patch_scale"]) == ("toy", 1.0)
    assert found["sampler_sha256"] == load_texture(toy_folder).data.sampler_sha256
    page = (tmp_path / "a.html").read_text("utf-8")
    assert "toy" in page
    assert re.search(r"<td>vgg_frechet</td>", page)


@pytest.mark.parametrize(
    ("name", "message"),
    [("sheet.jpg", "ends in .png or .html"), ("none/sheet.png", "no folder"), ("exemplar.png", "is the exemplar itself")],
)
def test_a_sheet_that_makes_no_sense_is_refused_before_measuring(solidgrain, toy_folder, tmp_path, name, message):
    oiio.ImageBuf(EXEMPLAR).write(os.fspath(tmp_path / "exemplar.png"), oiio.UINT8)
    outcome = solidgrain("evaluate", toy_folder, "--exemplar", tmp_path / "exemplar.png", "--sheet", tmp_path / name)
    assert outcome.code == 2
    assert message in outcome.error


def test_columns_of_the_table_never_touch():
    lines = aligned([("measure", "exemplar turned by 90°", "last"), ("gram", "1.00", "2")])
    assert lines == ["measure   exemplar turned by 90°   last   ", "gram      1.00                     2      "]
