"""Quality over time as a picture: one line per row of a table, one panel per measure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from solidgrain.runtime.files import replacing

MOST_COLORS = 10  # of matplotlib's cycle, after which lines are dashed
DASHES = ("-", "--", ":")
Curves = Mapping[str, Mapping[float, Sequence[float]]]  # by title, then by mark: the means of each seed


def draw(path: Path, panels: Mapping[str, Curves], by: str) -> None:
    """A PNG of ratios to the floor, by marks: the geometric mean over seeds, in a band from the nearest seed to the furthest.

    Both axes are logarithmic; a line at 1 is the floor.
    """
    figure = Figure((6 * len(panels), 6), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for panel, (measure, curves) in zip(axes, panels.items(), strict=True):
        for index, (title, of_mark) in enumerate(curves.items()):
            marks = sorted(of_mark)
            means = [geometric_mean(of_mark[mark]) for mark in marks]
            color, dash = f"C{index % MOST_COLORS}", DASHES[index // MOST_COLORS % len(DASHES)]
            panel.plot(marks, means, dash, color=color, marker=".", label=title)
            bounds = ([bound(of_mark[mark]) for mark in marks] for bound in (min, max))
            panel.fill_between(marks, *bounds, color=color, alpha=0.15, linewidth=0)
        panel.axhline(1, color="grey", linewidth=0.8)
        panel.set(xscale="log", yscale="log", xlabel=by, title=f"{measure}, oblique slices / floor")
        panel.set_xticks(sorted({mark for of_mark in curves.values() for mark in of_mark}))
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_formatter("")
        panel.yaxis.set_major_formatter("{x:g}")
        panel.yaxis.set_minor_formatter("{x:g}")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize="small")
    with replacing(path) as file:
        figure.savefig(file, format="png")


def geometric_mean(ratios: Sequence[float]) -> float:
    return float(np.exp(np.mean(np.log(ratios))))
