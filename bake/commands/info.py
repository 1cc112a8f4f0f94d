"""`solidgrain info`: what a texture is, and whether it still says what its manifest promises."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from solidgrain.runtime import Texture

TOLERANCE = 1e-4  # in colour, against the manifest's probe


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", nargs="?", default="granite", metavar="SOURCE", help="embedded name, bundle or texture file")
    parser.add_argument("--bundle", metavar="FOLDER", help="the bundle that a texture file belongs to")
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout")


def run(arguments: argparse.Namespace) -> int:
    from solidgrain.runtime import load_texture

    texture = load_texture(arguments.source, bundle=arguments.bundle)
    error = probe_error(texture)
    report = {**texture.bundle.manifest, "texture": texture.name, "folder": str(texture.bundle.folder), "probe_error": error}
    print(json.dumps(report, indent=2) if arguments.json else summary(texture, error))
    return 0 if error <= TOLERANCE else 3


def probe_error(texture: Texture) -> float:
    """The largest difference in colour between the manifest's probe and this machine (the bundle's own texture's)."""
    import numpy as np

    from solidgrain.runtime import load_texture

    probe = texture.bundle.manifest["probe"]
    rgb = load_texture(texture.bundle.folder).sample(probe["points"], probe["seed"])
    return float(np.abs(rgb - np.clip(probe["rgb"], 0, 1)).max())


def summary(texture: Texture, error: float) -> str:
    manifest: dict[str, Any] = texture.bundle.manifest
    training = manifest["training"]
    exemplars = ", ".join(
        f"{entry['exemplar']} ({entry['license']}; {entry['credit']})" for entry in training.get("exemplars", [])
    )
    verdict = "reproduced" if error <= TOLERANCE else "NOT REPRODUCED"
    lines = [
        f"texture    {texture.name}",
        f"bundle     {texture.bundle.folder}, format {manifest['format_version']}, {manifest['producer']}",
        f"sampler    {manifest['octaves']} octaves, {manifest['hidden_layers']} layers of {manifest['width']} units",
        f"colour     {manifest['color_encoding']}",
        f"probe      {verdict} on {texture.provider}, largest difference {error:.1g}",
    ]
    if texture.provider_note:
        lines.append(f"note       {texture.provider_note}")
    if training:
        lines.append(f"trained    {training['iterations']} iterations, {training['minutes']:g} minutes, on {exemplars}")
    return "\n".join(lines)
