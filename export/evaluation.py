"""A texture measured, through the runtime, against the photograph that it was learned from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any, NamedTuple

from solidgrain.export.card import planes_in, with_quality
from solidgrain.export.figures import Figures, make_figures
from solidgrain.runtime import Texture
from solidgrain.runtime.bundle import CARD, Bundle
from solidgrain.runtime.errors import BundleError
from solidgrain.runtime.files import replacing
from solidgrain.runtime.texture_file import TextureData
from solidgrain.train.copying import Copying, Pair, measure_copying
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.inception import Inception
from solidgrain.train.photograph import scaled
from solidgrain.train.quality import Evaluation, evaluate
from solidgrain.train.run import pixels_sha256
from solidgrain.train.slices import Planes


class Measured(NamedTuple):
    """What was found of a texture."""

    evaluation: Evaluation
    copying: Copying
    pairs: list[Pair]  # the patches nearest to the exemplar

    @property
    def figures(self) -> Figures:
        return make_figures(self.evaluation, self.copying)

    def as_json(self) -> dict[str, Any]:
        return asdict(self.evaluation) | {"copying": asdict(self.copying)}


def planes_of(bundle: Bundle) -> Planes:
    """The planes that training saw."""
    return planes_in(bundle.manifest["training"].get("settings", {}))


def exemplar_of(bundle: Bundle) -> dict[str, str]:
    """What the manifest says of the one photograph that a texture was learned from: file name, licence, credit, sha256."""
    entries = bundle.manifest["training"].get("exemplars", [])
    unknown = dict.fromkeys(("exemplar", "license", "credit", "sha256", "photograph_sha256"), "")
    return {**unknown, **(entries[0] if len(entries) == 1 else {})}


def is_exemplar(bundle: Bundle, photograph: FloatArray) -> bool:
    """Whether a texture was learned from a photograph [H, W, 3], by its pixels; True if its bundle does not say from which."""
    said = exemplar_of(bundle)
    if said["photograph_sha256"]:  # of one that was reduced, which rounds as the processor does
        return pixels_sha256(photograph) == said["photograph_sha256"]
    return said["sha256"] in ("", pixels_sha256(scaled(photograph, scale_of(bundle))))


def scale_of(bundle: Bundle) -> float:
    """How many pixels of the photograph were one of the exemplar that a texture was learned from; 1 for a space."""
    entries = bundle.manifest["training"].get("exemplars", [])
    return float(entries[0].get("scale", 1.0)) if len(entries) == 1 else 1.0


def exemplar_scale(texture: Texture) -> float:
    """How many pixels of its photograph are one of a texture's: as it was trained, or encoded."""
    data = texture.data
    return data.scale if texture.bundle.is_space and isinstance(data, TextureData) else scale_of(texture.bundle)


def measure(
    texture: Texture,
    exemplar: FloatArray,
    slices: int,
    inception: Inception | None = None,
    on_step: Callable[[str], None] = lambda line: None,
) -> Measured:
    """Measure so many axis-aligned and as many oblique slices of a texture, and whether it copies its exemplar.

    `on_step` is told when the second begins: in a photograph of 12 megapixels it takes minutes.
    """
    planes, (height, width) = planes_of(texture.bundle), exemplar.shape[:2]
    evaluation = evaluate(exemplar, texture.sample, slices, planes, inception)
    on_step(f"searching {width}x{height} pixels for what may have been copied")
    return Measured(evaluation, *measure_copying(exemplar, texture.sample, planes))


def write_quality(texture: Texture, figures: Figures) -> None:
    """Write the figures into the model card of a texture's bundle. Raises BundleError if that cannot be done."""
    card = texture.bundle.folder / CARD
    try:
        written = card.read_text("utf-8") if card.is_file() else f"# {texture.name}\n"
        with replacing(card) as file:
            file.write(with_quality(written, figures.markdown()).encode())
    except UnicodeDecodeError as error:
        raise BundleError(f"{card}: not UTF-8, so that nothing can be written into it; the figures are as printed") from error
    except OSError as error:
        raise BundleError(f"{card}: cannot write the model card ({error.strerror}); the figures are as printed") from error
