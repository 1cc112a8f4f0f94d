"""The first layers of InceptionV3, for SIFID (Shaham et al. 2019), from a weights file that the user has.

Szegedy et al. 2016 give the layers; the names of the weights are those of torchvision and of pytorch-fid's
`pt_inception-2015-12-05-6726825d.pth`. Only what lies before the first max-pooling layer is read, and that layer applied:
64 channels, at a quarter of the image's resolution.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from solidgrain.runtime.errors import SolidgrainError

# name, (outputs, inputs), stride, padding; 3x3 convolutions without a bias, each followed by batch norm and ReLU
LAYERS = (
    ("Conv2d_1a_3x3", (32, 3), 2, 0),
    ("Conv2d_2a_3x3", (32, 32), 1, 0),
    ("Conv2d_2b_3x3", (64, 32), 1, 1),
)
NORMS = ("running_mean", "running_var", "weight", "bias")  # of a batch norm, in the order that `F.batch_norm` takes
EPSILON = 0.001  # of the batch norms, as InceptionV3 was trained


class Inception:
    """Features after InceptionV3's first max-pooling layer."""

    def __init__(self, path: Path) -> None:
        """Raises SolidgrainError if the file is missing, no state dict, or of another network."""
        self.weights = _checked(path, _read(path))

    @torch.no_grad()
    def features(self, image: Tensor) -> Tensor:
        """Image [1, 3, H, W] in [0, 1], at least 15 pixels along each side -> [1, 64, about H / 4, about W / 4]."""
        x = 2 * image - 1
        for name, _, stride, padding in LAYERS:
            x = F.conv2d(x, self.weights[f"{name}.conv.weight"], stride=stride, padding=padding)
            mean, variance, scale, shift = (self.weights[f"{name}.bn.{part}"] for part in NORMS)
            x = F.relu(F.batch_norm(x, mean, variance, scale, shift, eps=EPSILON))
        return F.max_pool2d(x, 3, stride=2)


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise SolidgrainError(f"--inception {path}: no such file; expected InceptionV3 weights (pt_inception-*.pth)")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises a dozen unrelated types for files that it cannot read
        raise SolidgrainError(
            f"--inception {path}: not a weights file that torch reads ({type(error).__name__}); "
            "expected the state dict of pytorch-fid or torchvision"
        ) from error
    if not isinstance(state, dict):
        raise SolidgrainError(f"--inception {path}: holds a {type(state).__name__}, expected a state dict of InceptionV3")
    return state


def _checked(path: Path, state: dict[str, Any]) -> dict[str, Tensor]:
    """The weights that are needed, if all are there and of the right shape."""
    expected: dict[str, tuple[int, ...]] = {}
    for name, (outputs, inputs), _, _ in LAYERS:
        expected[f"{name}.conv.weight"] = (outputs, inputs, 3, 3)
        expected |= {f"{name}.bn.{part}": (outputs,) for part in NORMS}
    for name, shape in expected.items():
        if name not in state:
            raise SolidgrainError(f"--inception {path}: no {name}; expected InceptionV3 weights of pytorch-fid or torchvision")
        found = tuple(getattr(state[name], "shape", ()))
        if found != shape:
            raise SolidgrainError(f"--inception {path}: {name} has shape {found}, expected {shape}; not InceptionV3 weights")
    return {name: state[name].float() for name in expected}
