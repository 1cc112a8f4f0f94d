"""The table of texture spaces in Markdown and JSON, the paper's own figures beside ours."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from solidgrain.runtime.files import replacing
from tests.bench import cells
from tests.bench.signed_rank import signed_rank
from tests.bench.space_measure import KERNELS, KINDS
from tests.bench.space_methods import ADAPTED, TITLES
from tests.bench.space_values import (
    ALL,
    SIGNIFICANT,
    Photographs,
    Values,
    Window,
    choose_window,
    collect,
    figures,
    mean,
    measures,
    paired,
    present,
    ratios,
    read_group,
)

Pairs = Mapping[str, Sequence[float]]  # mean and deviation, by column

# Portenier et al. 2020: Table 2, and the figure of extrapolation
PAPER_SIFID = {"truth": (2.46, 2.80), "henzler": (2.60, 2.85), "unadapted": (2.47, 2.23)}  # x 10^5
PAPER_ALL = {"truth": (-294.85, 86.13), "henzler": (-319.02, 70.61), "unadapted": (-317.23, 74.30)}
PAPER_FAR = {"henzler": (11.31, 0.79), "unadapted": (2.04, 0.79), "critic": (1.46, 0.29), "vgg": (1.79, 0.30)}
SLICES = {"oblique": "oblique slices", "axis": "axis-aligned slices"}


def write_results(out: Path) -> None:
    """table.md and table.json of what there is."""
    groups = {group: read_group(out / group) for group in ("held-out", "far", "large")}
    sections = [of_space(groups["held-out"]), of_far(groups["far"]), of_large(groups["large"])]
    cells.keep(out / "table.json", {"summary": summary(groups["held-out"]), "photographs": groups})
    with replacing(out / "table.md") as file:
        file.write("\n\n".join(section for section in sections if section).encode() + b"\n")


def summary(photographs: Photographs) -> dict[str, Any]:
    """The held-out photographs' figures for other programs."""
    window = choose_window(photographs)
    found = {
        kind: {name: {column: _spread([*v.values()]) for column, v in by.items()} for name, by in of_kind.items()}
        for kind, of_kind in collect(photographs, window).items()
    }
    return {"window": window and window._asdict(), **found}


def _spread(values: Sequence[float]) -> dict[str, float]:
    moments = {"mean": float(np.mean(values)), "deviation": float(np.std(values)), "median": float(np.median(values))}
    return {**moments, "photographs": len(values)}


def of_space(photographs: Photographs) -> str:
    """Table 2 of the paper, with ours under it."""
    if not photographs:
        return ""
    window = choose_window(photographs)
    found = collect(photographs, window)
    lines = [f"## {len(photographs)} photographs that the space was never trained on", "", header("")]
    lines.append(row("SIFID × 10⁵ (the paper, Table 2)", pairs(PAPER_SIFID)))
    lines.append(row("ALL (the paper)", pairs(PAPER_ALL, 1)))
    for kind, title in SLICES.items():
        for name, values in found[kind].items():
            over_floor, digits = ("", 1) if name == ALL else (" / floor", 2)
            shown = {column: over_photographs([*by.values()], digits) for column, by in values.items()}
            lines.append(row(f"{name}{over_floor}, {title}", shown))
    counts = {column: sum(column in cell for cell in photographs.values()) for column in present(photographs)}
    lines.append(row("photographs", {column: str(count) for column, count in counts.items()}))
    lines.append(row("iterations, seconds of adapting", adapting(photographs)))
    lines += ["", f"Mean ± deviation over photographs, and the median in brackets. {of_crops(photographs)}", ""]
    lines += [of_window(window), ""] if window else []
    lines += ["Best to worst by the mean, oblique slices:", ""]
    lines.append(f"- the paper's SIFID: {order(PAPER_SIFID, least_first)}")
    lines.append(f"- the paper's ALL: {order(PAPER_ALL, most_first)}")
    for name, values in found[KINDS[0]].items():
        means = {column: (mean(by),) for column, by in values.items()}
        key, theirs = (most_first, PAPER_ALL) if name == ALL else (least_first, PAPER_SIFID)
        lines.append(f"- {name}: {order(means, key)}{agreement(means, theirs, key)}")
    return "\n".join([*lines, "", *contrasts(photographs)]).rstrip()


def of_crops(photographs: Photographs) -> str:
    """What truth is, and at which size everything was compared."""
    kinds = Counter(
        (cell["truth"]["crop"], cell["truth"]["apart_from_patch"]) for cell in photographs.values() if "truth" in cell
    )
    ways = {
        True: "slices and other crops with the encoded patch",
        False: "slices with all disjoint crops, each crop with the others",
    }
    told = (f"{size}² pixels for {count}: {ways[apart]}" for (size, apart), count in sorted(kinds.items()))
    return f"Compared are squares, of {'; of '.join(told)}." if kinds else ""


def adapting(photographs: Photographs) -> dict[str, str]:
    """What adapting took, on average."""
    shown = {}
    for column in ADAPTED:
        reports = [report for cell in photographs.values() if (report := cell.get(column, {}).get("adapting"))]
        if reports:
            iterations, seconds = (np.mean([report[name] for report in reports]) for name in ("iterations", "seconds"))
            shown[column] = f"{iterations:.0f}, {seconds:.0f}"
    return shown


def of_window(window: Window) -> str:
    first, second = (TITLES[column] for column in window.methods)
    told = "tells" if window.p < SIGNIFICANT else "does not tell"
    return (
        f"ALL is that of {window.kernel}² pixels, with a bandwidth of {window.bandwidth:.3g} levels, the best for the truth. "
        f"Of {', '.join(map(str, KERNELS))} it is the first size that tells {first} from {second}, or the last: "
        f"it {told} them apart (paired Wilcoxon, p = {window.p:.2g})."
    )


def contrasts(photographs: Photographs) -> list[str]:
    """What adapting does, photograph by photograph."""
    lines = []
    for column in ADAPTED:
        for name in measures(photographs):
            values = ratios(photographs, KINDS[0], name)
            if change := paired(values.get(column, {}), values.get("unadapted", {})):
                nearer = f"nearer for {sum(one < 0 for one in change)} of {len(change)}"
                lines.append(f"- {TITLES[column]}, {name}: {nearer} (paired Wilcoxon, p = {signed_rank(change):.2g})")
    return ["Adapted against un-adapted, oblique slices:", "", *lines] if lines else []


def of_far(photographs: Photographs) -> str:
    """The paper's figure of extrapolation, for one photograph."""
    if not photographs:
        return ""
    (name, cell), *_ = photographs.items()
    lines = [f"## A photograph unlike all that the space has seen: {name}", "", header("")]
    lines.append(row("SIFID × 10⁵ (the paper)", pairs(PAPER_FAR)))
    notes = [f"- the paper's SIFID: {order(PAPER_FAR, least_first)}"]
    for kind, title in SLICES.items():
        for measure in measures(photographs):
            found = {column: figures(cell[column], kind)["ratios"][measure] for column in cell}
            lines.append(row(f"{measure} / floor, {title}", pairs(found)))
            if kind == KINDS[0]:
                notes.append(f"- {measure}: {order(found, least_first)}{agreement(found, PAPER_FAR, least_first)}")
    return "\n".join([*lines, "", "Mean ± deviation over slices. Best to worst, oblique slices:", "", *notes])


def of_large(photographs: Photographs) -> str:
    """Every large photograph: what adapting makes of each measure."""
    if not photographs:
        return ""
    values: dict[str, Values] = {name: ratios(photographs, KINDS[0], name) for name in measures(photographs)}
    lines = [
        f"## {len(photographs)} large photographs, over the floor, oblique slices: as encoded → adapted (D) → adapted (VGG)"
    ]
    lines += ["", f"| photograph | {' | '.join(values)} |", "|---" * (len(values) + 1) + "|"]
    for photograph in photographs:
        steps = [
            " → ".join(
                f"{by[column][photograph]:.2f}" for column in ("unadapted", *ADAPTED) if photograph in by.get(column, {})
            )
            for by in values.values()
        ]
        lines.append(f"| {photograph} | {' | '.join(steps)} |")
    return "\n".join([*lines, "", *contrasts(photographs)]).rstrip()


def header(title: str) -> str:
    return f"| {title} | {' | '.join(TITLES.values())} |\n{'|---' * (len(TITLES) + 1)}|"


def row(title: str, by_column: Mapping[str, str]) -> str:
    return f"| {title} | {' | '.join(by_column.get(column, '–') for column in TITLES)} |"


def pairs(by_column: Pairs, digits: int = 2) -> dict[str, str]:
    return {column: f"{found[0]:.{digits}f} ± {found[1]:.{digits}f}" for column, found in by_column.items()}


def over_photographs(values: Sequence[float], digits: int) -> str:
    return f"{np.mean(values):.{digits}f} ± {np.std(values):.{digits}f} ({np.median(values):.{digits}f})"


def least_first(found: Sequence[float]) -> float:
    return found[0]


def most_first(found: Sequence[float]) -> float:
    return -found[0]


def order(by_column: Pairs, key: Any) -> str:
    sign = " < " if key is least_first else " > "
    return sign.join(TITLES[column] for column in sorted(by_column, key=lambda column: key(by_column[column])))


def agreement(ours: Pairs, theirs: Pairs, key: Any) -> str:
    """Whether the methods that both have come in the same order; of two, one of which is the truth, that would say nothing."""
    both = [column for column in theirs if column in ours]
    same = sorted(both, key=lambda c: key(ours[c])) == sorted(both, key=lambda c: key(theirs[c]))
    return "" if len(both) < 3 else f" ({'' if same else 'not '}the paper's order of these {len(both)})"
