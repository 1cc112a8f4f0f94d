"""The model card: what a bundle was trained on and how, as a page of Markdown beside its graphs."""

from __future__ import annotations

from typing import Any

from solidgrain.train.slices import Planes

QUALITY = "## Quality"
MANY = 8  # exemplars that get a line each


def write_card(name: str, training: dict[str, Any]) -> str:
    """The card of a bundle, from its manifest's training record."""
    settings = training["settings"]
    start = settings.get("warm_start") or settings.get("sampler_start")
    rows = [
        ("settings", f"preset `{settings['preset']}`{_variant(settings)}, seed {settings['seed']}"),
        ("patches", f"{settings['batch']} of {_sides(training)} pixels per iteration"),
        ("octaves", f"{settings['octaves']}" + (f", span {settings['octave_span']:g}" if not start else "")),
        *_beginning(start, settings.get("critic_start")),
        ("slices", turned(planes_in(settings))),
        ("iterations", f"{training['iterations']:,}"),
        ("minutes", f"{training['minutes']:g}"),
        ("trained by", f"solidgrain {training['revision']}"),
    ]
    exemplars = (
        _grouped(training["exemplars"])
        if len(training["exemplars"]) > MANY
        else [
            f"- `{entry['exemplar']}`, licence: {entry['license'] or 'not stated'}, credit: {entry['credit'] or 'not stated'}\n"
            f"  (read as {entry.get('colorspace') or 'not stated'}{_reduced(entry)}, sha256 of its pixels "
            f"`{entry['sha256'][:16]}…`)"
            for entry in training["exemplars"]
        ]
    )
    if held_out := training.get("held_out"):
        exemplars.append(f"- never trained on, for its evaluation: {_names(held_out)}")
    kind = "A space of solid textures" if settings.get("latent") else "A solid texture"
    lines = [f"# {name}", "", f"{kind}, trained on:", "", *exemplars, "", "| | |", "|---|---|"]
    return "\n".join([*lines, *(f"| {label} | {value} |" for label, value in rows), ""])


def planes_in(settings: dict[str, Any]) -> Planes:
    """The planes that a training sliced, by the settings of any version, or of none."""
    return Planes(settings.get("grain", "none"), settings.get("upright", False))


def turned(planes: Planes) -> str:
    """How training turned its slices, in words."""
    if planes.grain == "none":
        return "turned freely"
    across = "xz" if planes.grain == "x" else "zy (z to the left)"
    return f"turned about the {planes.grain} axis only" + f", upright, from xy to {across}" * planes.upright


def _variant(settings: dict[str, Any]) -> str:
    """Which of the paper's comparisons it was, if not the method itself."""
    variant = settings.get("variant", "paper")
    return "" if variant == "paper" else f", variant `{variant}`"


def _beginning(start: str | None, critic: str | None) -> list[tuple[str, str]]:
    """What the sampler's weights began as, or at least the critic's."""
    if start:
        return [("began as", f"`{start}`, whose iterations are not counted here")]
    return [("critic began as", f"that of `{critic}`")] if critic else []


def _sides(training: dict[str, Any]) -> str:
    """How large patches were at first, and later if they grew."""
    settings = training["settings"]
    first = settings["patch"]
    last = training.get("last_patch", first)  # which earlier versions and spaces do not say
    return f"{first}²" if last == first else f"{first}², {last}² from iteration {settings['later_from']} on,"


def _reduced(entry: dict[str, Any]) -> str:
    scale = entry.get("scale", 1)
    return "" if scale == 1 else f", reduced to one pixel for every {scale:g}"


def _grouped(exemplars: list[dict[str, Any]]) -> list[str]:
    """Many exemplars, a line for each licence and credit; the manifest has every sha256."""
    groups: dict[tuple[str, str], list[str]] = {}
    for entry in exemplars:
        groups.setdefault((entry["license"], entry["credit"]), []).append(entry["exemplar"])
    return [
        f"- licence: {license or 'not stated'}, credit: {credit or 'not stated'}: {_names(names)}"
        for (license, credit), names in groups.items()
    ]


def _names(names: list[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def with_quality(card: str, table: str) -> str:
    """The card with its quality section written anew, in its place, or at the end."""
    before, _, rest = card.partition(f"\n{QUALITY}\n")
    _, heading, after = rest.partition("\n## ")
    return f"{before.rstrip()}\n\n{QUALITY}\n\n{table.rstrip()}\n{heading}{after}"
