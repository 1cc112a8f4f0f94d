"""`solidgrain info`: what a texture is, and whether it still says what its manifest promises."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

from solidgrain.runtime.bundle import CARD

if TYPE_CHECKING:
    from solidgrain.runtime import Space, Texture
    from solidgrain.runtime.blend_file import BlendData

MANY = 3  # exemplars that are named


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", nargs="?", default="granite", metavar="SOURCE", help="embedded name, bundle or texture file")
    parser.add_argument("--bundle", metavar="FOLDER", help="the bundle that a texture file belongs to")
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout")


def run(arguments: argparse.Namespace) -> int:
    from solidgrain.runtime import Texture, load
    from solidgrain.runtime.blend_file import BlendData
    from solidgrain.runtime.probe import TOLERANCE, probe_error

    loaded = load(arguments.source, bundle=arguments.bundle)
    error = probe_error(loaded.bundle)
    kind = "texture" if isinstance(loaded, Texture) else "space"
    report = {**loaded.bundle.manifest, kind: loaded.name, "folder": str(loaded.bundle.folder), "probe_error": error}
    if isinstance(loaded, Texture):
        report |= {"texture_sha256": loaded.data.sha256, "provider": loaded.provider, "provider_note": loaded.provider_note}
        report |= {"blend": _blend(loaded.data)} if isinstance(loaded.data, BlendData) else {}
    print(json.dumps(report, indent=2) if arguments.json else summary(loaded, error, error <= TOLERANCE))
    return 0 if error <= TOLERANCE else 3


def summary(loaded: Texture | Space, error: float, reproduced: bool) -> str:
    from solidgrain.runtime import Space
    from solidgrain.runtime.blend_file import BlendData

    manifest: dict[str, Any] = loaded.bundle.manifest
    training = manifest["training"]
    verdict = "reproduced" if reproduced else "NOT REPRODUCED"
    lines = [
        f"{'space' if isinstance(loaded, Space) else 'texture':<11}{loaded.name}",
        f"bundle     {loaded.bundle.folder}, format {manifest['format_version']}, {manifest['producer']}",
        f"sampler    {manifest['octaves']} octaves, {manifest['hidden_layers']} layers of {manifest['width']} units",
        f"colour     {manifest['color_encoding']}",
        f"probe      {verdict}, largest difference {error:.1g}",
    ]
    if isinstance(loaded, Space):
        lines.insert(3, f"encoder    {loaded.patch}² pixels to {manifest['latent']} numbers")
    else:
        if isinstance(loaded.data, BlendData):
            lines.insert(1, f"blend      {_blend(loaded.data)}")
        lines.append(f"runs on    {loaded.provider}" + (f" ({loaded.provider_note})" if loaded.provider_note else ""))
    if training:
        minutes, exemplars = f"{training['minutes']:g} minutes", _exemplars(training.get("exemplars", []))
        lines.append(f"trained    {training['iterations']} iterations, {minutes}, on {exemplars}")
    return "\n".join(lines)


def _blend(data: BlendData) -> str:
    """From which texture to which, and where the mask lies."""
    mask = data.mask
    size = "x".join(str(count) for count in mask.count)
    low, high = (
        (*(round(start + k * length, 6) for start, length in zip(mask.origin, mask.extent, strict=True)),) for k in (0, 1)
    )
    return f"{data.names[0]} to {data.names[1]} by a mask of {size} voxels (x, y, z), from {low} to {high}"


def _exemplars(entries: list[dict[str, Any]]) -> str:
    if len(entries) > MANY:
        return f"{len(entries)} photographs (licences and credits are in {CARD} and, one by one, in --json)"
    stated = (
        (entry["exemplar"], entry["license"] or "licence not stated", entry["credit"] or "credit not stated")
        for entry in entries
    )
    return ", ".join(f"{exemplar} ({license}; {credit})" for exemplar, license, credit in stated)
