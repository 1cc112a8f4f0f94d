"""Bundles on disk: a folder with ONNX graphs, a texture and the manifest that vouches for them.

    manifest.json      format and version, octaves and widths, sha256 of every file, a probe, training provenance
    sampler.onnx       points -> colour; everything that a texture owns is an input
    texture.sgt.npz    the texture of a single-exemplar bundle
    encoder.onnx       photograph -> latent code, of a texture space
    mapping.onnx       latent code -> texture, of a texture space
    blend.onnx         points between two textures -> colour, of a texture space
    critic.npz         what adapting a texture to a photograph needs besides (optional, in training's own format)
    card.md            the model card (optional)

Everything is checked on load, and an error says which file is wrong, what was expected and what was found.
"""

from __future__ import annotations

import difflib
import hashlib
import json
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from solidgrain.runtime.errors import BundleError

MANIFEST, SAMPLER, TEXTURE, CARD = "manifest.json", "sampler.onnx", "texture.sgt.npz", "card.md"
ENCODER, MAPPING, BLEND, CRITIC = "encoder.onnx", "mapping.onnx", "blend.onnx", "critic.npz"
FORMAT, FORMAT_VERSION, COLOR_ENCODING = "solidgrain-bundle", 1, "srgb_rec709_scene"
KEYS: dict[str, type] = {
    "name": str,
    "producer": str,
    "opset": int,
    "octaves": int,
    "width": int,
    "hidden_layers": int,
    "patch": int,
    "color_encoding": str,
    "files": dict,
    "probe": dict,
    "training": dict,
}


@dataclass(frozen=True)
class Bundle:
    """A bundle whose files are all present and are the ones that its manifest lists."""

    folder: Path
    manifest: dict[str, Any]

    @property
    def name(self) -> str:
        return str(self.manifest["name"])

    @property
    def is_space(self) -> bool:
        """Whether it turns photographs into textures, and holds none of its own."""
        return ENCODER in self.manifest["files"]

    @property
    def size(self) -> int:
        """Bytes on disk, of all that lies in the folder."""
        return sum(path.stat().st_size for path in self.folder.iterdir())

    @property
    def sampler_sha256(self) -> str:
        return str(self.manifest["files"][SAMPLER])


def open_bundle(folder: Path) -> Bundle:
    """Read and verify a bundle folder. Raises BundleError naming the file that is wrong."""
    manifest = _read_manifest(folder / MANIFEST)
    for name, expected in manifest["files"].items():
        path = folder / name
        if not path.is_file():
            raise BundleError(f"{path}: missing; the manifest lists it. Export the bundle again")
        try:
            found = file_sha256(path)
        except OSError as error:
            raise BundleError(f"{path}: cannot read ({error.strerror})") from error
        if found != expected:
            raise BundleError(
                f"{path}: sha256 is {found[:12]}…, the manifest expects {expected[:12]}…; "
                "the file is damaged or belongs to another bundle"
            )
    return Bundle(folder.absolute(), manifest)  # wherever the process works later


def _read_manifest(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise BundleError(f"{path.parent}: not a bundle (no {MANIFEST}); expected a folder made by solidgrain export")
    try:
        manifest = json.loads(path.read_bytes())
        is_bundle = manifest["format"] == FORMAT
        version = manifest["format_version"]
    except OSError as error:
        raise BundleError(f"{path}: cannot read ({error.strerror})") from error
    except (ValueError, KeyError, TypeError) as error:
        raise BundleError(f"{path}: not a bundle manifest ({error}); export the bundle again") from error
    if not is_bundle:
        raise BundleError(f"{path}: format is {manifest['format']!r}, expected {FORMAT!r}")
    if version != FORMAT_VERSION:
        raise BundleError(
            f"{path}: format version {version}, this solidgrain reads {FORMAT_VERSION}; export again or update solidgrain"
        )
    wrong = [key for key, kind in KEYS.items() if not isinstance(manifest.get(key), kind)]
    if not wrong and manifest["color_encoding"] != COLOR_ENCODING:
        raise BundleError(f"{path}: colours are {manifest['color_encoding']!r}, this solidgrain reads {COLOR_ENCODING!r}")
    if not wrong and not all(isinstance(digest, str) for digest in manifest["files"].values()):
        wrong = ["files"]
    if not wrong and not {"seed", "points", "rgb"} <= manifest["probe"].keys():
        wrong = ["probe"]
    if not wrong and ENCODER in manifest["files"]:
        wrong = [key for key in ("latent", "encoded_patch") if not isinstance(manifest.get(key), int)]
        wrong += [] if "z" in manifest["probe"] and MAPPING in manifest["files"] else ["probe"]
    if wrong or SAMPLER not in manifest["files"]:
        raise BundleError(f"{path}: incomplete manifest (check {', '.join(wrong) or SAMPLER}); export the bundle again")
    return dict(manifest)


def file_sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def embedded_bundles() -> list[str]:
    """The names of the bundles that come with the package, textures and spaces."""
    return sorted(folder.name for folder in _embedded_root().iterdir() if (folder / MANIFEST).is_file())


def embedded_names() -> list[str]:
    """The names of the textures that come with the package."""
    return [name for name in embedded_bundles() if (_embedded_root() / name / TEXTURE).is_file()]


def bundle_folder(source: str) -> Path:
    """The folder of a bundle that is named by its path, or of an embedded one. Raises BundleError if there is none."""
    path = Path(source)
    with suppress(OSError):  # a name that is too long for a folder
        if path.is_dir() and ((path / MANIFEST).is_file() or source not in embedded_bundles()):
            return path
    return embedded_folder(source)


def is_texture_file(source: str) -> bool:
    """Whether a source is a file: neither a bundle's folder nor an embedded name, which counts before a file of that name."""
    with suppress(OSError):
        return source not in embedded_bundles() and Path(source).is_file()
    return False


def embedded_folder(name: str) -> Path:
    """The folder of an embedded bundle. Raises BundleError, with close names, when there is none of that name."""
    names = embedded_bundles()
    if name not in names:
        close = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(close)}?" if close else f"embedded textures are {', '.join(names)}"
        raise BundleError(f"{name}: no such texture, bundle folder or texture file; {hint}")
    return _embedded_root() / name


def find_bundle(sampler_sha256: str, near: Path) -> Path | None:
    """The bundle that a texture file belongs to: the folder that it lies in, or an embedded one."""
    for folder in (near, *(_embedded_root() / name for name in embedded_bundles())):
        path = folder / SAMPLER
        if (folder / MANIFEST).is_file() and path.is_file() and file_sha256(path) == sampler_sha256:
            return folder
    return None


def open_again(sampler_sha256: str, folder: Path) -> Bundle:
    """The bundle that was opened in a folder, or the embedded one that it is. Raises BundleError if it is no longer there."""
    found = find_bundle(sampler_sha256, folder)
    if found is None:
        raise BundleError(f"{folder}: the bundle whose sampler.onnx has sha256 {sampler_sha256[:12]}… is no longer there")
    return open_bundle(found)


def _embedded_root() -> Path:
    return Path(str(resources.files("solidgrain.runtime"))) / "embedded"
