"""`encoder.onnx` and `mapping.onnx`: from a patch to its latent code, and from a code to a texture (GramGAN Sec. 3.2, Eq. 5).

Written operator by operator, as the sampler is. Convolutions are nine tenths of a space's weights: the encoder's are stored in
half precision and cast when the graph is loaded; the mapping's are float32, for octaves multiply what is lost there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import onnx
import onnx.checker
import spox
import spox.opset.ai.onnx.v17 as op
from spox import Tensor, Var, argument

from solidgrain.export.sampler_graph import SLOPE

FloatArray = npt.NDArray[np.float32]
Layer = tuple[FloatArray, FloatArray]  # weight and bias, learning-rate gains applied


@dataclass(frozen=True)
class EncoderWeights:
    """E as plain arrays: convolutions [out, in, k, k], dense layers [in, out] for x W."""

    convolutions: Sequence[Layer]
    dense: Sequence[Layer]
    patch: int = 128  # pixels along each side of what it sees
    color_moments: bool = False  # z ends with the patch's mean colour and contrast


@dataclass(frozen=True)
class MappingWeights:
    """Q, f, g_l and what every texture of a space starts from; dense layers [in, out] for x W."""

    octaves: Sequence[Layer]  # Q; its output, [n, 3, 3] flattened, is in noise texels per exemplar pixel
    style: Sequence[Layer]  # f
    affine: Sequence[Layer]  # g_l, gamma and delta side by side; the one of gamma is in the bias
    noise_weights: FloatArray  # A [4, n/4, m], which an encoded texture shares with the others
    output: Layer | None = None  # of the sampler, where z ends with colour moments: what turns them into gamma and delta


def build_encoder_graph(weights: EncoderWeights) -> onnx.ModelProto:
    """exemplar [B, 3, patch, patch] float32 in [0, 1] -> z [B, latent]."""
    exemplar = argument(Tensor(np.float32, ("B", 3, weights.patch, weights.patch)))
    x: Var = exemplar
    for kernel, bias in weights.convolutions:
        size = kernel.shape[-1]
        low, high = (size - 1) // 2, size // 2  # of an even kernel, one more zero right and below
        x = op.conv(x, _half(kernel), _half(bias), kernel_shape=(size, size), pads=(low, low, high, high))
        x = op.average_pool(op.leaky_relu(x, alpha=SLOPE), kernel_shape=(2, 2), strides=(2, 2))
    x = op.flatten(x, axis=1)
    *hidden, (code, bias) = weights.dense
    for weight, offset in hidden:
        x = op.leaky_relu(op.gemm(x, _half(weight), _half(offset)), alpha=SLOPE)
    z = op.gemm(x, _half(code), _half(bias))
    if weights.color_moments:
        z = op.concat([z, *_moments(exemplar)], axis=1)
    return _model({"exemplar": exemplar}, {"z": z})


def _moments(exemplar: Var) -> tuple[Var, Var]:
    """Mean colour [B, 3] and contrast [B, 1], the root mean square deviation of all channels."""
    mean = op.reduce_mean(exemplar, axes=(2, 3), keepdims=1)
    deviation = op.sub(exemplar, mean)
    variance = op.reduce_mean(op.mul(deviation, deviation), axes=(1, 2, 3), keepdims=1)
    return op.flatten(mean, axis=1), op.flatten(op.sqrt(variance), axis=1)


def build_mapping_graph(weights: MappingWeights) -> onnx.ModelProto:
    """z [B, latent] -> everything that a texture owns.

    transforms [B, n, 3, 3] in noise texels per exemplar pixel, gamma and delta [B, hidden layers, m], noise_weights
    [B, 4, n/4, m], the same for every z: a texture may depart from them when it is adapted (Sec. 3.3).
    """
    z = argument(Tensor(np.float32, ("B", len(weights.octaves[0][0]))))
    width, octaves = weights.noise_weights.shape[2], weights.noise_weights.shape[1] * 4
    transforms = op.reshape(_perceptron(z, weights.octaves), op.const([-1, octaves, 3, 3]))
    w = _perceptron(z, weights.style)
    styles = [op.gemm(w, op.const(weight), op.const(bias)) for weight, bias in weights.affine]
    halves = [op.split(style, op.const([width, width]), outputs_count=2, axis=1) for style in styles]
    if weights.output is not None:
        last_gamma, last_delta = halves[-1]
        halves[-1] = _with_colors(z, last_gamma, last_delta, *weights.output)
    gamma, delta = (op.concat([op.unsqueeze(half[k], op.const([1])) for half in halves], axis=1) for k in (0, 1))
    count = op.concat([op.shape(z, start=0, end=1), op.const([1, 1, 1])], axis=0)
    noise_weights = op.expand(op.const(weights.noise_weights[None]), count)
    return _model({"z": z}, {"transforms": transforms, "gamma": gamma, "delta": delta, "noise_weights": noise_weights})


def _with_colors(z: Var, gamma: Var, delta: Var, weight: FloatArray, bias: FloatArray) -> tuple[Var, Var]:
    """The last layer's style, such that colours become mean + contrast * rgb (`_with_colors` of `solidgrain.train.space`)."""
    mean = op.slice(z, op.const([-4]), op.const([-1]), op.const([1]))
    contrast = op.slice(z, op.const([-1]), op.const([np.iinfo(np.int64).max]), op.const([1]))
    exact = weight.astype(np.float64)
    inverse = (np.linalg.inv(exact.T @ exact) @ exact.T).astype(np.float32)  # V transposed, [3, m]
    offset = op.add(mean, op.mul(op.sub(contrast, op.const(np.float32(1))), op.const(bias)))
    return op.mul(contrast, gamma), op.add(op.mul(contrast, delta), op.matmul(offset, op.const(inverse)))


def _perceptron(x: Var, layers: Sequence[Layer]) -> Var:
    *hidden, (weight, bias) = layers
    for inner, offset in hidden:
        x = op.leaky_relu(op.gemm(x, op.const(inner), op.const(offset)), alpha=SLOPE)
    return op.gemm(x, op.const(weight), op.const(bias))


def _half(array: FloatArray) -> Var:
    """A constant that takes two bytes a number in the file."""
    return op.cast(op.const(array.astype(np.float16)), to=np.float32)


def _model(inputs: dict[str, Var], outputs: dict[str, Var]) -> onnx.ModelProto:
    model = spox.build(inputs, outputs)
    model.producer_name = "solidgrain"
    onnx.checker.check_model(model, full_check=True)
    return model
