"""What an evaluation found, as a table for people: for the terminal, the model card and the sheet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from solidgrain.train.exemplar import MIRRORED, NONSTATIONARY

if TYPE_CHECKING:
    from solidgrain.train.copying import Copying
    from solidgrain.train.quality import Evaluation


DIRECTED = 2.0  # times the floor, by VGG-Fréchet: where an exemplar is as far from itself turned, and slices from it


@dataclass(frozen=True)
class Figures:
    """A table with a sentence before it and one after it."""

    before: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    after: str

    def markdown(self) -> str:
        lines = [self.header, ("---",) * len(self.header), *self.rows]
        table = "\n".join(f"| {' | '.join(cells)} |" for cells in lines).replace(" --- ", "---")
        return f"{self.before}\n\n{table}\n\n{self.after}"


def make_figures(evaluation: Evaluation, copying: Copying) -> Figures:
    rows = []
    among = ("slices from each other",) if evaluation.among else ()  # a single slice has none
    for name, floor in evaluation.floor.items():
        spreads = (evaluation.axis[name], evaluation.oblique[name])
        rows.append(
            (
                name,
                f"{floor:.4g}",
                f"{evaluation.turned[name]:.2f}",
                *(f"{mean:.2f} ± {deviation:.2f}" for mean, deviation in spreads),
                *(f"{evaluation.among[name]:.2f}" for _ in among),
            )
        )
    after = [about(copying), *directed(evaluation)]
    if evaluation.nonstationarity > NONSTATIONARY:
        figure = f"{evaluation.nonstationarity:.2f}, above {NONSTATIONARY}"
        after.append(f"The exemplar changes across itself (nonstationarity {figure}).")
    if evaluation.symmetry > MIRRORED:
        figure = f"{evaluation.symmetry:.2f}, above {MIRRORED}"
        said = (
            "one side of it was compared" if evaluation.one_side else "its floor is between mirror images; use one side of it"
        )
        after.append(f"The exemplar is its own mirror image (symmetry about its middle {figure}): {said}.")
    return Figures(
        f"Distances to the exemplar over its own floor, mean ± standard deviation over {evaluation.slices} slices of "
        f"{evaluation.crop}² pixels, through the runtime:",
        ("measure", "floor", f"exemplar {evaluation.turn}", "axis-aligned slices", "oblique slices", *among),
        rows,
        " ".join(after),
    )


def directed(evaluation: Evaluation) -> list[str]:
    """What to do about slices that are far from their exemplar since they turn and it has a direction; nothing about others."""
    turned, slices = evaluation.turned["vgg_frechet"], evaluation.oblique["vgg_frechet"][0]
    if evaluation.upright or min(turned, slices) <= DIRECTED:
        return []
    flags = "--upright" if evaluation.grain != "none" else "--anisotropic, and --upright if light falls from one side,"
    return [
        f"The exemplar has a direction ({turned:.1f} times its floor when {evaluation.turn}) that slices do not keep: "
        f"train with {flags} for slices that do."
    ]


def about(copying: Copying) -> str:
    """Whether the exemplar was copied, in a sentence."""
    if copying.ratio is None or copying.closer is None:
        return "Copying: cannot be told of an exemplar whose halves hold the same; evaluate with one period of it."
    return (
        f"Copying: patches are {copying.ratio:.2f} times as far from the exemplar as its halves are from each other, and "
        f"{100 * copying.closer:.1f} % of {copying.patches} come nearer than 99 % of those do "
        "(near 1 and 1 %: nothing is copied; smooth patches come near to anything, too)."
    )
