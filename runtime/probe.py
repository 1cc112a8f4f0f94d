"""Whether an installation reproduces a bundle: colours, and for a space a latent code, that its manifest promises."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.bundle import Bundle
from solidgrain.runtime.space import load_space
from solidgrain.runtime.texture import load_texture

TOLERANCE = 1e-4  # in colour, and in latent codes over their largest number


def probe_error(bundle: Bundle) -> float:
    """The largest difference between what the manifest's probe holds and what this machine finds."""
    probe = bundle.manifest["probe"]
    wanted = np.clip(probe["rgb"], 0, 1)
    if not bundle.is_space:
        return float(np.abs(load_texture(bundle.folder).sample(probe["points"], probe["seed"]) - wanted).max())
    space, z = load_space(bundle.folder), np.asarray(probe["z"])
    of_code = float(np.abs(space.code(probe_patch(space.patch)) - z).max() / np.abs(z).max())
    return max(of_code, float(np.abs(space.texture(z).sample(probe["points"], probe["seed"]) - wanted).max()))


def probe_patch(size: int) -> npt.NDArray[np.float32]:
    """A fixed picture [size, size, 3] in [0, 1] that a space's probe encodes."""
    rows, columns, channels = np.meshgrid(np.arange(size), np.arange(size), np.arange(3), indexing="ij")
    return np.asarray((7 * rows + 3 * columns * (channels + 1) + rows * columns // 16) % 64 / 63, np.float32)
