"""VGG-16 (Simonyan and Zisserman 2014), pretrained: a yardstick for `quality`, and F of L_style in two of the comparisons.

The weights are those that the package stlpips-pytorch carries (BSD-2-Clause). Nothing is downloaded.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from solidgrain.runtime.errors import SolidgrainError

LAYERS = ("1.0", "1.2", "pool", "2.6", "2.8", "pool", "3.12", "3.14", "3.16", "pool", "4.20")  # up to conv4_1
STYLE_LAYERS = (0, 2, 4, 7)  # conv1_1, conv2_1, conv3_1, conv4_1 of what `features` returns (Gatys et al. 2015)


class Vgg:
    """Activations of VGG-16's first eight convolutions, average pools between its blocks (Gatys et al. 2015)."""

    def __init__(self, device: torch.device | None = None) -> None:
        self.weights = {name: tensor.to(device) for name, tensor in _read_weights().items()}

    def style(self, images: Tensor) -> list[Tensor]:
        """What L_style compares in the paper's comparisons: images [B, 3, H, W] in [0, 1] -> activations of `STYLE_LAYERS`."""
        activations = self.features(images, padding=1)
        return [activations[layer] for layer in STYLE_LAYERS]

    def features(self, images: Tensor, padding: int = 0) -> list[Tensor]:
        """Images [B, 3, H, W] in [0, 1] -> activations [B, C, h, w] after each convolution, as many as the size allows.

        Without padding no activation sees beyond the border; with a padding of 1, as VGG was trained, small patches keep
        more than one pixel at conv4_1.
        """
        x = (images * 2 - 1 - self.weights["scaling_layer.shift"]) / self.weights["scaling_layer.scale"]
        found = []
        for layer in LAYERS:
            if min(x.shape[2:]) < (2 if layer == "pool" else 3 - 2 * padding):
                break
            if layer == "pool":
                x = F.avg_pool2d(x, 2)
            else:
                kernel, bias = (self.weights[f"net.slice{layer}.{part}"] for part in ("weight", "bias"))
                x = F.relu(F.conv2d(x, kernel, bias, padding=padding))
                found.append(x)
        return found


def find_weights() -> Path:
    """Where the weights are. Raises SolidgrainError if the package that carries them is not installed."""
    spec = importlib.util.find_spec("stlpips_pytorch")
    if spec is None or spec.origin is None:
        raise SolidgrainError("the VGG-16 weights are missing; pip install 'solidgrain[evaluate]'")
    return Path(spec.origin).parent / "weights" / "vST0.0" / "vgg_shift_tolerant.pth"


def _read_weights() -> dict[str, Tensor]:
    weights: dict[str, Tensor] = torch.load(find_weights(), map_location="cpu", weights_only=True)
    return weights
