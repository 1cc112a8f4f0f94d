"""What is said of photographs before they are learned: what a texture should not have, and who has seen them before."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from solidgrain.runtime.bundle import embedded_folder, open_bundle
from solidgrain.train.collection import in_levels
from solidgrain.train.exemplar import FRAMED, MIRRORED, NONSTATIONARY, FloatArray, edge_step, mirror_symmetry, nonstationarity
from solidgrain.train.run import Run, pixels_sha256
from solidgrain.train.space_run import SpaceRun, open_any

MOST_NAMES = 5  # of photographs, in a line


class Misgiving(NamedTuple):
    """A figure that photographs should not have, and what is said of one or many that do."""

    measure: Callable[[FloatArray], float]
    limit: float
    of_one: str
    of_many: str
    figure: str
    advice: str


MISGIVINGS = (
    Misgiving(
        nonstationarity,
        NONSTATIONARY,
        "changes across itself",
        "change across themselves",
        "nonstationarity",
        "crop to an even part for better results",
    ),
    Misgiving(
        edge_step,
        FRAMED,
        "seems to have a frame",
        "seem to have a frame",
        "edge step",
        "crop it off, or it is learned, too",
    ),
    Misgiving(
        mirror_symmetry,
        MIRRORED,
        "is its own mirror image",
        "are their own mirror images",
        "symmetry about its middle",
        "crop to one side of it, or the folds are learned, too",
    ),
)


def of_photograph(path: Path, exemplar: FloatArray) -> list[str]:
    """What a photograph has that a texture should not have."""
    figures = [(misgiving, misgiving.measure(exemplar)) for misgiving in MISGIVINGS]
    return [
        f"{path} {of.of_one} ({of.figure} {found:.2f}, above {of.limit:g}); {of.advice}"
        for of, found in figures
        if found > of.limit
    ]


def of_space(run: SpaceRun, warm_start: Path | None) -> list[str]:
    """The same of a new space's photographs, and which of those that are held out its weights have seen."""
    found = {one.name: [misgiving.measure(one.exemplar) for misgiving in MISGIVINGS] for one in run.trained_on}
    lines = []
    for number, of in enumerate(MISGIVINGS):
        above = [f"{name} ({figures[number]:.2f})" for name, figures in found.items() if figures[number] > of.limit]
        if above:
            count = f"{len(above)} of {len(found)} photographs"
            lines.append(f"{count} {of.of_many} ({of.figure} above {of.limit:g}): {some(above)}; {of.advice}")
    return lines + of_held_out(run, warm_start)


def of_held_out(run: SpaceRun, warm_start: Path | None) -> list[str]:
    """Which held-out photographs the weights that a run begins with were trained on, as far as is known."""
    held_out = [member for member in run.members if member.name in run.held_out]
    if not held_out:
        return []
    seen, all_known = seen_by(warm_start) if warm_start else (seen_by_embedded(run.settings.critic_start), True)
    teacher, lines = warm_start or f"the critic of {run.settings.critic_start}", []
    if names := sorted(member.name for member in held_out if pixels_sha256(member.pixels) in seen):
        lines.append(f"{len(names)} held-out photographs were trained on by {teacher}: {some(names)}; hold out others")
    if not all_known:
        unknown = "what it was trained on is not known" if not seen else "what it began with was trained on is not known"
        lines.append(f"--warm-start {warm_start}: {unknown}; held-out photographs may be among it")
    return lines


def seen_by(start: Path) -> tuple[set[str], bool]:
    """Hashes of the photographs that a run's weights were trained on, and whether these are all. Of a file nothing is known."""
    if start.is_file():
        return set(), False
    other = open_any(start)
    seen = seen_by_embedded(other.settings.critic_start)  # what that run began with has come along
    if isinstance(other, SpaceRun):
        seen |= {pixels_sha256(member.pixels) for member in other.trained_on}
    elif isinstance(other, Run):
        seen.add(pixels_sha256(in_levels(other.exemplar)))
    return seen, not other.settings.warm_start


def seen_by_embedded(name: str) -> set[str]:
    """The same of an embedded space; of none, if it has no name."""
    if not name:
        return set()
    manifest = open_bundle(embedded_folder(name)).manifest
    return {entry["sha256"] for entry in manifest["training"].get("exemplars", [])}


def some(names: Sequence[str]) -> str:
    """The first of many names."""
    return ", ".join(names[:MOST_NAMES]) + ", ..." * (len(names) > MOST_NAMES)
