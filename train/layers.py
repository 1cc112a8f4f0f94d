"""Layers with an equalized learning rate (Karras et al. 2018, used by Sec. 4; gramgan/models.py).

Weights are N(0,1) and scaled by gain / sqrt(fan in) at run time, so that Adam moves all layers at the same pace. The gain
is sqrt(2) before a leaky ReLU and 1 for an output layer; biases start at zero.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

SLOPE = 0.2  # of the leaky ReLU
HIDDEN_GAIN = math.sqrt(2)


class Linear(nn.Module):
    """y = gain / sqrt(inputs) W x + b."""

    def __init__(self, inputs: int, outputs: int, generator: torch.Generator, gain: float = HIDDEN_GAIN) -> None:
        super().__init__()
        self.weight = nn.Parameter(_normal((outputs, inputs), generator))
        self.bias = nn.Parameter(torch.zeros(outputs, device=generator.device))
        self.gain = gain / math.sqrt(inputs)

    def effective_weight(self) -> Tensor:
        return self.weight * self.gain

    def forward(self, x: Tensor) -> Tensor:
        return F.linear(x, self.effective_weight(), self.bias)


class Conv(nn.Module):
    """A convolution that keeps the size of its input."""

    def __init__(self, inputs: int, outputs: int, kernel: int, generator: torch.Generator) -> None:
        super().__init__()
        self.weight = nn.Parameter(_normal((outputs, inputs, kernel, kernel), generator))
        self.bias = nn.Parameter(torch.zeros(outputs, device=generator.device))
        self.gain = HIDDEN_GAIN / math.sqrt(inputs * kernel * kernel)
        self.even = kernel % 2 == 0

    def forward(self, x: Tensor) -> Tensor:
        if self.even:  # as TensorFlow's SAME: one more zero right and below than left and above
            x = F.pad(x, (0, 1, 0, 1))
        return F.conv2d(x, self.weight * self.gain, self.bias, padding=(self.weight.shape[-1] - 1) // 2)


def activate(x: Tensor) -> Tensor:
    return F.leaky_relu(x, SLOPE)


def _normal(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return torch.randn(shape, generator=generator, device=generator.device)
