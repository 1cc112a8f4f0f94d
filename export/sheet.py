"""An evaluation to look at: the exemplar beside slices of the texture, the patches nearest to the exemplar, and the figures.

All slices have the exemplar's scale, but for one that covers twice the width. A sheet is one file: a PNG, or HTML with its
pictures inside. The same texture and exemplar give the same bytes.
"""

from __future__ import annotations

import base64
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from solidgrain.export.figures import Figures
from solidgrain.runtime.errors import SolidgrainError
from solidgrain.runtime.files import replacing
from solidgrain.train.copying import Pair
from solidgrain.train.cuts import Sample, axis_rotation, oblique_rotation, take_slices
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.preview import Pixels, as_png
from solidgrain.train.slices import Planes

PANEL = 256  # pixels along each side of a picture: at most of the exemplar, at least on the sheet
ENLARGED = 6  # screen pixels per pixel of a patch
GAP, LINE, LETTER = 16, 24, 15  # screen pixels between pictures, from one line of text to the next, and of a letter's height
LABELS, TABLE = "DroidSans", "DroidSansMono"  # fonts that OpenImageIO brings along
BETWEEN = 3  # letters, the columns of the table
STYLE = """
body { font: 15px sans-serif; margin: 2em; max-width: 1150px }
figure { display: inline-block; margin: 0 1em 1em 0 }
img { display: block; image-rendering: pixelated }
td, th { padding: 0.2em 1em; text-align: left; border-bottom: 1px solid #ccc }
"""


@dataclass(frozen=True)
class Sheet:
    """Pictures with their labels, row by row, and the figures."""

    title: str
    rows: list[list[tuple[str, Pixels]]]
    figures: Figures


def make_sheet(name: str, exemplar: FloatArray, sample: Sample, planes: Planes, pairs: list[Pair], figures: Figures) -> Sheet:
    """Draw everything that a sheet shows."""
    size = min(*exemplar.shape[:2], PANEL)
    top, left = ((extent - size) // 2 for extent in exemplar.shape[:2])
    wide = _slices(sample, 2 * size, planes, axis=True, count=1)[0].reshape(size, 2, size, 2, 3).mean((1, 3))
    rows = [
        [("exemplar", exemplar[top : top + size, left : left + size])]
        + [(f"axis-aligned slice {i}", one) for i, one in enumerate(_slices(sample, size, planes, axis=True), 1)],
        [("twice the width", wide)]
        + [(f"oblique slice {i}", one) for i, one in enumerate(_slices(sample, size, planes, axis=False), 1)],
    ]
    scale = -(-PANEL // size)
    shown = [[(label, _enlarged(picture, scale)) for label, picture in row] for row in rows]
    border = np.ones((len(pairs[0].patch), 1, 3), np.float32)
    patches = [(f"{pair.distance:.4f}", np.hstack([pair.patch, border, pair.nearest])) for pair in pairs]
    enlarged = [(label, _enlarged(picture, ENLARGED)) for label, picture in patches]
    half = len(enlarged) // 2
    return Sheet(f"{name}, and its exemplar", [*shown, enlarged[:half], enlarged[half:]], figures)


def write_sheet(path: Path, sheet: Sheet) -> None:
    """Write a sheet, as HTML or as PNG by the path's suffix. Raises SolidgrainError if that cannot be done."""
    content = as_html(sheet).encode() if path.suffix.lower() == ".html" else as_png(_drawn(sheet))
    try:
        with replacing(path) as file:
            file.write(content)
    except OSError as error:
        raise SolidgrainError(f"--sheet {path}: cannot write ({error.strerror})") from error


def _slices(sample: Sample, size: int, planes: Planes, axis: bool, count: int = 3) -> list[FloatArray]:
    """Slices of as many instances, at fixed random places."""

    def rotation_of(seed: int, generator: torch.Generator) -> Tensor:
        return axis_rotation(seed, planes) if axis else oblique_rotation(generator, planes)

    return list(take_slices(sample, size, count, rotation_of))


def _enlarged(picture: FloatArray, scale: int) -> Pixels:
    """8-bit pixels, each drawn `scale` times as wide and high."""
    pixels = np.round(picture.clip(0, 1) * 255).astype(np.uint8)
    return pixels.repeat(scale, 0).repeat(scale, 1)


PAIRS = "The patches that come nearest to the exemplar, each beside what is nearest there, and their distance:"


def as_html(sheet: Sheet) -> str:
    """The sheet as one page that needs no other file."""

    def figure(label: str, pixels: Pixels) -> str:
        data = base64.b64encode(as_png(pixels)).decode()
        return f'<figure><img alt="{label}" src="data:image/png;base64,{data}"><figcaption>{label}</figcaption></figure>'

    def cells(kind: str, row: tuple[str, ...]) -> str:
        return "<tr>" + "".join(f"<{kind}>{escape(cell)}</{kind}>" for cell in row) + "</tr>"

    rows = ["<div>" + "\n".join(figure(*one) for one in row) + "</div>" for row in sheet.rows]
    figures, title = sheet.figures, escape(sheet.title)
    body = [f"<h1>{title}</h1>", *rows[:2], f"<p>{PAIRS}</p>", *rows[2:], f"<p>{escape(figures.before)}</p>", "<table>"]
    body += [cells("th", figures.header), *(cells("td", row) for row in figures.rows), "</table>"]
    body.append(f"<p>{escape(figures.after)}</p>")
    head = f'<meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n' + "\n".join(body) + "\n</body></html>\n"


def _drawn(sheet: Sheet) -> Pixels:
    """The sheet as one picture."""
    figures = sheet.figures
    table = aligned((figures.header, *figures.rows))
    pictures = max(sum(picture.shape[1] + GAP for _, picture in row) for row in sheet.rows) + GAP
    width = max(pictures, *(_letters_width(line, TABLE) + 2 * GAP for line in table))
    page = Page(width)
    page.write([sheet.title], LABELS)
    for row in sheet.rows[:2]:
        page.show(row)
    page.write([PAIRS], LABELS)
    for row in sheet.rows[2:]:
        page.show(row)
    letters = width // 8
    page.write(textwrap.wrap(figures.before, letters), LABELS)
    page.write(table, TABLE)
    page.write(textwrap.wrap(figures.after, letters), LABELS)
    return page.pixels()


def _letters_width(text: str, font: str) -> int:
    """Screen pixels that a line of text takes."""
    import OpenImageIO as oiio

    return int(oiio.ImageBufAlgo.text_size(text, LETTER, font).width)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """The rows of a table as lines, each column as wide as its widest cell and a gap."""
    widths = [max(map(len, column)) + BETWEEN for column in zip(*rows, strict=True)]
    return ["".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]


class Page:
    """A white page that grows downwards."""

    def __init__(self, width: int) -> None:
        self.width = width
        self.parts = [self._blank(GAP)]

    def write(self, lines: list[str], font: str) -> None:
        self.parts += [self._lettered([(GAP, line)], font) for line in lines] + [self._blank(GAP // 2)]

    def show(self, row: list[tuple[str, Pixels]]) -> None:
        """Pictures of one height side by side, their labels under them."""
        strip, places, left = self._blank(len(row[0][1])), [], GAP
        for label, picture in row:
            strip[:, left : left + picture.shape[1]] = picture
            places.append((left, label))
            left += picture.shape[1] + GAP
        self.parts += [strip, self._lettered(places, LABELS), self._blank(GAP // 2)]

    def pixels(self) -> Pixels:
        return np.concatenate(self.parts)

    def _blank(self, height: int) -> Pixels:
        return np.full((height, self.width, 3), 255, np.uint8)

    def _lettered(self, places: list[tuple[int, str]], font: str) -> Pixels:
        """A line of text: black words, each from its own left."""
        import OpenImageIO as oiio

        buffer = oiio.ImageBuf(self._blank(LINE))
        for left, text in places:
            if not oiio.ImageBufAlgo.render_text(buffer, left, LINE - 7, text, LETTER, font, (0.0, 0.0, 0.0)):
                reason = buffer.geterror().strip()
                raise SolidgrainError(f"--sheet: this OpenImageIO cannot draw text ({reason}); write a FILE.html instead")
        drawn: Pixels = np.asarray(buffer.get_pixels(oiio.UINT8))
        return drawn
