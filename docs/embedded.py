"""The textures that come with the package, and the photographs that they were learned from."""

from __future__ import annotations

import sys
from pathlib import Path

from solidgrain.export.evaluation import scale_of
from solidgrain.runtime.bundle import Bundle, embedded_folder, embedded_names, open_bundle
from solidgrain.runtime.errors import ExemplarError
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.photograph import read_photograph, scaled
from solidgrain.train.quality import SMALLEST
from solidgrain.train.run import pixels_sha256

HERE = Path(__file__).resolve().parent
EXEMPLARS = HERE.parents[1] / "shared" / "data" / "exemplars"  # photographs do not come with the project


def embedded_textures() -> dict[str, Bundle]:
    """The embedded bundles that hold one texture, by name."""
    bundles = {name: open_bundle(embedded_folder(name)) for name in embedded_names()}
    return {name: bundle for name, bundle in bundles.items() if not bundle.is_space}


def exemplar_of(bundle: Bundle) -> dict[str, str]:
    """What the manifest says of the one photograph that a texture was learned from: file name, licence, credit, sha256."""
    entries = bundle.manifest["training"].get("exemplars", [])
    unknown = dict.fromkeys(("exemplar", "license", "credit", "sha256", "photograph_sha256"), "")
    return {**unknown, **(entries[0] if len(entries) == 1 else {})}


def find_photograph(bundle: Bundle, folder: Path) -> FloatArray | None:
    """The photograph that a texture was learned from: searched for by file name in a folder and all folders in it.

    None, with a line, if there is none. Raises ExemplarError if there is one of that name, but with other pixels.
    """
    said = exemplar_of(bundle)
    whole = said["photograph_sha256"]  # of one that was reduced, which rounds as the processor does
    paths = sorted(path for path in folder.rglob("*") if path.name == said["exemplar"])
    for path in paths:
        photograph = read_photograph(path, SMALLEST).pixels
        exemplar = scaled(photograph, scale_of(bundle))
        if (pixels_sha256(photograph) == whole) if whole else (pixels_sha256(exemplar) == said["sha256"]):
            return exemplar
    if paths:
        raise ExemplarError(
            f"{paths[0]}: not the photograph that {bundle.name} was learned from (sha256 of its pixels differs from "
            f"{(whole or said['sha256'])[:12]}…, which the manifest expects); name the right folder with --exemplars"
        )
    say(f"{bundle.name}: no {said['exemplar'] or 'photograph'} in {folder}; left out")
    return None


def say(text: str) -> None:
    """Progress: to stderr, at once."""
    print(text, file=sys.stderr, flush=True)
