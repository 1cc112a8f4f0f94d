"""The textures that come with the package, and the photographs that they were learned from."""

from __future__ import annotations

import sys
from pathlib import Path

from solidgrain.export.evaluation import exemplar_of, is_exemplar, scale_of
from solidgrain.runtime.bundle import Bundle, embedded_folder, embedded_names, open_bundle
from solidgrain.runtime.errors import ExemplarError
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.photograph import read_photograph, scaled
from solidgrain.train.quality import SMALLEST

HERE = Path(__file__).resolve().parent
EXEMPLARS = HERE.parents[1] / "shared" / "data" / "exemplars"  # photographs do not come with the project


def embedded_textures() -> dict[str, Bundle]:
    """The embedded bundles that hold one texture, by name."""
    bundles = {name: open_bundle(embedded_folder(name)) for name in embedded_names()}
    return {name: bundle for name, bundle in bundles.items() if not bundle.is_space}


def find_photograph(bundle: Bundle, folder: Path) -> FloatArray | None:
    """The photograph that a texture was learned from: searched for by file name in a folder and all folders in it.

    None, with a line, if there is none. Raises ExemplarError if there is one of that name, but with other pixels.
    """
    said = exemplar_of(bundle)
    paths = sorted(path for path in folder.rglob("*") if path.name == said["exemplar"])
    for path in paths:
        photograph = read_photograph(path, SMALLEST).pixels
        if is_exemplar(bundle, photograph):
            return scaled(photograph, scale_of(bundle))
    if paths:
        raise ExemplarError(
            f"{paths[0]}: not the photograph that {bundle.name} was learned from (sha256 of its pixels differs from "
            f"{(said['photograph_sha256'] or said['sha256'])[:12]}…, which the manifest expects); name the right folder with "
            "--exemplars"
        )
    say(f"{bundle.name}: no {said['exemplar'] or 'photograph'} in {folder}; left out")
    return None


def say(text: str) -> None:
    """Progress: to stderr, at once."""
    print(text, file=sys.stderr, flush=True)
