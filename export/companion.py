"""Writing the critic beside a space's bundle, for adapting textures (its format is in `solidgrain.train.companion`)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from torch import Tensor

from solidgrain.runtime.errors import BundleError, TrainingError
from solidgrain.runtime.files import write_arrays
from solidgrain.train.companion import FORMAT, FORMAT_VERSION, SEEN
from solidgrain.train.settings import Settings


def write_companion(path: Path, critic: Mapping[str, Tensor], settings: Settings, sampler_sha256: str) -> None:
    """Write the state of a critic, whole or not at all; equal critics of equal bundles give equal bytes.

    Raises TrainingError for weights that half precision cannot hold, BundleError if the file cannot be written.
    """
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "sampler_sha256": sampler_sha256,
        "settings": {name: getattr(settings, name) for name in SEEN},
    }
    arrays = {name: tensor.half().numpy() for name, tensor in critic.items()}
    if strange := [name for name, array in arrays.items() if not np.isfinite(array).all()]:
        raise TrainingError(f"{path.name}: {strange[0]} of the critic exceeds half precision; train the space again")
    try:
        write_arrays(path, {"header": np.array(json.dumps(header)), **arrays})
    except OSError as error:
        raise BundleError(f"{path.name}: cannot write the critic ({error.strerror})") from error
