"""The sampler's graph as weights of a folded perceptron, for the fused kernel. The graph stays the one truth.

A graph is recognised by its structure: the operators, how they are connected, their attributes and every constant but the
weights. Weights are the float32 constants that are not scalars; the structure says which is which.
"""

from __future__ import annotations

import hashlib

import numpy as np
import numpy.typing as npt

from solidgrain.runtime.onnx_file import Array, Graph, parse_model
from solidgrain.runtime.texture_file import TextureData

# Of the graphs that `solidgrain.export.sampler_graph` writes, by octaves (five hidden layers, any width).
FINGERPRINTS = {
    16: "161535b4449fc79e96f3172e7cdc1af20590e4aa6324239f3ce6d85938a270e9",
    32: "e3556e8fa76c771ec35876368410c0b7285d171be0d41d4e88c56b849a575f39",
}

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]


def read_weights(model: bytes, texture: TextureData) -> list[FloatArray]:
    """Bias of layer 0, then weight and bias of each layer that follows, of a serialised `sampler.onnx`.

    Raises ValueError, with the reason, if the graph is not one that the fused kernel stands for, or not of this texture.
    """
    octaves, width = len(texture.transforms), texture.gamma.shape[1]
    if octaves not in FINGERPRINTS:
        raise ValueError(f"the texture has {octaves} octaves, expected {' or '.join(map(str, FINGERPRINTS))}")
    lines: list[str] = []
    weights: list[FloatArray] = []
    _describe(parse_model(model), {}, lines, weights)
    if hashlib.sha256("\n".join(lines).encode()).hexdigest() != FINGERPRINTS[octaves]:
        raise ValueError("the graph has a structure of its own")
    hidden = [(width,)] + [(width, width), (width,)] * (len(texture.gamma) - 1)
    if [weight.shape for weight in weights] != [*hidden, (width, 3), (3,)]:
        raise ValueError(f"the graph's layers are not {width} units wide as the texture is")
    return weights


def fold(weights: list[FloatArray], texture: TextureData) -> FloatArray:
    """One texture's perceptron as the kernel takes it (`native/kernel.h`), style folded into the layer that follows."""
    parts = [weights[0], texture.noise_weights[0]]
    for layer, (weight, bias) in enumerate(unstyled(weights, texture), start=1):
        parts += [bias, weight]
        if layer < len(texture.noise_weights):
            parts.append(texture.noise_weights[layer])
    return np.concatenate([np.ravel(part) for part in parts]).astype(np.float32)


def unstyled(weights: list[FloatArray], texture: TextureData) -> list[tuple[DoubleArray, DoubleArray]]:
    """Weight and bias of each layer after layer 0, without a style before it, in float64.

    W (gamma * y + delta) + b = (W diag(gamma)) y + (W delta + b).
    """
    layers = []
    for gamma, delta, weight, bias in zip(texture.gamma, texture.delta, weights[1::2], weights[2::2], strict=True):
        exact = weight.astype(np.float64)
        layers.append((gamma[:, None] * exact, bias + delta @ exact))
    return layers


def _describe(graph: Graph, names: dict[str, int], lines: list[str], weights: list[FloatArray]) -> None:
    """One line per operator, values numbered in order of appearance; weights are collected instead of described."""
    names = dict(names)

    def number(name: str) -> int:
        return names.setdefault(name, len(names))

    for name in graph.inputs:
        lines.append(f"input {number(name)} {name}")
    for name, array in graph.initializers.items():
        lines.append(f"{number(name)} = {_constant(array, weights)}")
    for node in graph.nodes:
        inputs = [number(name) for name in node.inputs]
        lines.append(f"{[number(name) for name in node.outputs]} = {node.operator} {inputs}")
        for key, value in sorted(node.attributes.items()):
            if isinstance(value, Graph):
                lines.append(f"  {key}:")
                _describe(value, names, lines, weights)
            else:
                lines.append(f"  {key} {_constant(value, weights) if isinstance(value, np.ndarray) else value}")
    lines.append(f"output {[number(name) for name in graph.outputs]}")


def _constant(array: Array, weights: list[FloatArray]) -> str:
    if array.dtype == np.float32 and array.ndim:
        weights.append(array)
        return f"weights of rank {array.ndim}"
    return f"{array.dtype} {array.shape} {array.tolist()}"
