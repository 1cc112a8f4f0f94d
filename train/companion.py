"""The critic that a texture space was trained against, in a file of its own: `critic.npz`, which adapting needs (Sec. 3.3).

A NumPy archive: D's parameters by their names in `train/critic.py`, float16, and `header`, a JSON object with the format
version, the sha256 of the sampler that D judged, and the settings of the patches and slices that it saw. A bundle works
without it: it is as large as the rest of the bundle, and evaluating a texture never needs it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from solidgrain.runtime.bundle import CRITIC, Bundle, embedded_folder, open_bundle
from solidgrain.runtime.errors import BundleError
from solidgrain.runtime.files import DAMAGED_ARCHIVE
from solidgrain.train.critic import Critic
from solidgrain.train.settings import Settings

FORMAT, FORMAT_VERSION = "solidgrain-critic", 1
SEEN = (
    "patch",
    "batch",
    "transposed",
    "rotations",
    "grain",
    "upright",
    "relative_gram",
    "critic_contrast",
)  # the settings of what D sees and L_style asks


@dataclass(frozen=True)
class Companion:
    """A trained critic, and how it was shown slices and photographs."""

    critic: Critic
    settings: Settings


def find_companion(bundle: Bundle, named: Path | None) -> Path:
    """The critic of a bundle: the file that is named, or the one in its folder. Raises BundleError if there is none."""
    path = named or bundle.folder / CRITIC
    if not path.is_file():
        ways = "choose another --critic" if named else "export its run with --companion, or name the file with --critic"
        raise BundleError(f"{path}: missing; adapting needs the critic of the space: {ways}, or adapt with --features vgg")
    return path


def first_critic(settings: Settings, generator: torch.Generator) -> Critic:
    """D when a training begins: random, or what it has learned beside an embedded space. Raises BundleError if that is gone."""
    if not settings.critic_start:
        return Critic(generator)
    return embedded_critic(settings.critic_start, generator.device).requires_grad_(True)


def embedded_critic(name: str, device: torch.device) -> Critic:
    """What D has learned beside an embedded space; it learns no more. Raises BundleError if it is gone."""
    bundle = open_bundle(embedded_folder(name))
    path = bundle.folder / CRITIC
    if not path.is_file():
        raise BundleError(f"{path}: missing; training begins with this critic, a part of the package: install solidgrain again")
    return read_companion(path, bundle).critic.to(device)


def read_companion(path: Path, bundle: Bundle) -> Companion:
    """Read the critic of a bundle. Raises BundleError if it is damaged, of another version or of another bundle."""
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            header = dict(json.loads(str(archive["header"])))
            arrays = {name: archive[name] for name in archive.files if name != "header"}
    except OSError as error:
        raise BundleError(f"{path}: cannot read the critic ({error})") from error
    except DAMAGED_ARCHIVE as error:
        raise BundleError(f"{path}: not a critic's file, or damaged ({type(error).__name__}); export it again") from error
    if header.get("format") != FORMAT or header.get("format_version") != FORMAT_VERSION:
        found = f"{header.get('format')} version {header.get('format_version')}"
        raise BundleError(f"{path}: {found}, expected {FORMAT} version {FORMAT_VERSION}; export it again or update solidgrain")
    wanted = str(header.get("sampler_sha256", ""))
    if wanted != bundle.sampler_sha256:
        raise BundleError(
            f"{path}: is the critic of the bundle whose sampler.onnx has sha256 {wanted[:12]}…, "
            f"{bundle.folder} has {bundle.sampler_sha256[:12]}…; adapt with the bundle that it was exported with"
        )
    return Companion(_critic(path, arrays), seen_settings(header.get("settings")))


def seen_settings(values: Any) -> Settings:
    """Settings with those values that shape what D sees; the defaults where there are none."""
    known = values if isinstance(values, Mapping) else {}
    return replace(Settings(), **{name: known[name] for name in SEEN if name in known})


def _critic(path: Path, arrays: dict[str, npt.NDArray[Any]]) -> Critic:
    critic = Critic(torch.Generator())
    wanted = critic.state_dict()
    state: dict[str, Tensor] = {}
    for name, tensor in wanted.items():
        array = arrays.get(name)
        if array is None or array.shape != tensor.shape or array.dtype != np.float16 or not np.isfinite(array).all():
            raise BundleError(f"{path}: {name} is not finite float16 of shape {tuple(tensor.shape)}; damaged, export it again")
        state[name] = torch.from_numpy(array.astype(np.float32))
    critic.load_state_dict(state)
    return critic.requires_grad_(False)
