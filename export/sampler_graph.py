"""`sampler.onnx`: points in, colour out, as plain ONNX arithmetic (GramGAN Eq. 1, 2 and 5).

The graph is written here operator by operator rather than traced from torch, so that it holds what the formula holds and
nothing newer than opset 16. There is no GridSample in it (5-D needs opset 20, wraps around nowhere, and several execution
providers lack it): the trilinear lookup is Gather and arithmetic.

Conventions. P points, n octaves in four bins of q = n/4, m hidden units. `T`, `A`, `W`, `b`, `eta` are the paper's letters.
The lookup's tensors are [n, P], so that a constant of an octave is a column [n, 1].

Precision. T_i p + o_i is formed in float64, per point, and split into cell and fraction before anything becomes float32:
the fraction is right at any distance from the origin, whatever the chunk, and no TF32 mode can touch it. Texel numbers
are whole and below 2^24, exact in float32.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import onnx
import onnx.checker
import spox
import spox.opset.ai.onnx.v17 as op
from spox import Tensor, Var, argument

RESOLUTION = 64  # texels along each axis of a noise table
TEXELS = RESOLUTION**3
SLOPE = 0.2  # of the leaky ReLU (gramgan/models.py)

FloatArray = npt.NDArray[np.float32]
Triple = Sequence[Var]  # one tensor per axis, x y z


def build_sampler_graph(weights: Sequence[FloatArray], biases: Sequence[FloatArray], octaves: int) -> onnx.ModelProto:
    """The sampler S as an ONNX model: its shared weights inside, everything that a texture owns as an input.

    `weights` and `biases` are the effective ones, learning-rate gains applied. `weights[l - 1]` is [m, m], used as x W, for
    the hidden layers l = 1..4, and the last is [m, 3]. `biases[l]` is [m] for the hidden layers 0..4, and the last is [3];
    layer 0 sees nothing but the learned constant, so its whole product is in `biases[0]`.
    """
    n, width, depth = octaves, len(biases[0]), len(biases) - 1
    inputs = {
        "points": argument(Tensor(np.float64, ("P", 3))),
        "transforms": argument(Tensor(np.float64, (n, 3, 3))),
        "offsets": argument(Tensor(np.float64, (n, 3))),
        "lattice": argument(Tensor(np.float64, (n, 3, 3))),
        "gamma": argument(Tensor(np.float32, (depth, width))),
        "delta": argument(Tensor(np.float32, (depth, width))),
        "noise_weights": argument(Tensor(np.float32, (4, n // 4, width))),
        "noise": argument(Tensor(np.float32, (n, RESOLUTION, RESOLUTION, RESOLUTION))),
    }
    cells, fractions = locate(inputs["points"], inputs["transforms"], inputs["offsets"])
    eta = _look_up(inputs["noise"], cells, fractions, inputs["lattice"], n)
    rgb = _perceptron(eta, inputs["noise_weights"], inputs["gamma"], inputs["delta"], weights, biases, n)
    model = spox.build(inputs, {"rgb": rgb})
    model.producer_name = "solidgrain"
    onnx.checker.check_model(model, full_check=True)
    return model


def locate(points: Var, transforms: Var, offsets: Var) -> tuple[Triple, Triple]:
    """c_i = T_i p + o_i, split: cells (float64, integers) and fractions (float32), along each axis [n, P]."""
    cells, fractions = [], []
    for axis in range(3):
        row = op.gather(transforms, op.const(axis), axis=1)  # [n, 3]
        offset = op.gather(offsets, op.const([axis]), axis=1)  # [n, 1]
        coordinate = op.gemm(row, points, offset, transB=1)
        cell = op.floor(coordinate)
        cells.append(cell)
        fractions.append(op.cast(op.sub(coordinate, cell), to=np.float32))
    return cells, fractions


def _look_up(noise: Var, cells: Triple, fractions: Triple, lattice: Var, octaves: int) -> Var:
    """eta_i(c) of Eq. 1, [n, P]: trilinear between eight texels of the octave's table."""
    texels = corner_texels(cells, lattice, octaves)
    return interpolate(noise, texels, fractions, np.arange(octaves, dtype=np.int32))


def corner_texels(cells: Triple, lattice: Var, octaves: int) -> Var:
    """Where the eight corners of each cell, x slowest, are in their octave's table: [8n, P], whole numbers in float32."""
    (texels,) = op.if_(
        is_untiled(lattice, octaves),
        then_branch=lambda: [op.concat(_table_texels(cells), axis=0)],
        else_branch=lambda: [op.concat(_lattice_texels(cells, lattice, octaves), axis=0)],
    )
    return texels


def is_untiled(lattice: Var, octaves: int) -> Var:
    """Whether every octave repeats as its table does."""
    own_period = op.const(np.broadcast_to(RESOLUTION * np.eye(3), (octaves, 3, 3)).copy())
    return op.cast(op.reduce_min(op.cast(op.equal(lattice, own_period), to=np.float32), keepdims=0), to=np.bool_)


def interpolate(noise: Var, texels: Var, fractions: Triple, tables: npt.NDArray[np.int32]) -> Var:
    """The noise between eight texels each, [n, P]; row i of the cells reads table `tables[i]`."""
    table = op.reshape(noise, op.const([-1]))
    starts = op.const(np.tile(tables * np.int32(TEXELS), 8)[:, None])
    index = op.add(op.cast(texels, to=np.int32), starts)
    # GatherElements: the same read as Gather, five times faster for single numbers in ONNX Runtime on the CPU.
    values = op.gather_elements(table, op.reshape(index, op.const([-1])))
    corners = op.reshape(values, op.const([8, len(tables), -1]))
    for fraction in fractions:  # eight along x to four, along y to two, along z to one
        low, high = op.split(corners, outputs_count=2, axis=0)
        corners = op.add(low, op.mul(op.sub(high, low), fraction))
    return op.squeeze(corners, op.const([0]))


def _table_texels(cells: Triple) -> list[Var]:
    """Texels of the eight corners, x slowest, when every octave repeats as its table does: modulo 64 along each axis."""
    size = op.const(np.float64(RESOLUTION))
    along = []
    for axis, stride in enumerate((RESOLUTION**2, RESOLUTION, 1)):
        low = op.cast(_modulo(cells[axis], size), to=np.float32)
        high = _modulo(op.add(low, op.const(np.float32(1))), op.const(np.float32(RESOLUTION)))
        along.append([op.mul(end, op.const(np.float32(stride))) for end in (low, high)])
    return [op.add(op.add(x, y), z) for x in along[0] for y in along[1] for z in along[2]]


def _lattice_texels(cells: Triple, lattice: Var, octaves: int) -> list[Var]:
    """Texels of the eight corners, x slowest, when each octave repeats on a lattice of its own (tiling).

    A cell's canonical representative (a, b, c) counts in mixed radix: ((a L_yy) + b) L_zz + c enumerates the cells of one
    period, and that number modulo 64³ is the texel. For 64 Z³ it is the table's own index. (Taking a, b and c modulo 64
    each would not do: most lattices have pivots 1, 1, |det|, and all but 64 texels would go unused.)
    """
    basis = lattice_entries(lattice, octaves)
    cells = _canonical(cells, basis)

    def corners(cell: Triple, axis: int, count: Var | None) -> list[Var]:
        if axis == 3 and count is not None:
            return [op.cast(_modulo(count, op.const(np.float64(TEXELS))), to=np.float32)]
        found = []
        for neighbour in (cell[axis], op.add(cell[axis], op.const(np.float64(1)))):
            corner = reduce_cells([*cell[:axis], neighbour, *cell[axis + 1 :]], basis, axis)
            counted = corner[axis] if count is None else op.add(op.mul(count, basis[axis][axis]), corner[axis])
            found += corners(corner, axis + 1, counted)
        return found

    return corners(cells, 0, None)


def lattice_entries(lattice: Var, octaves: int) -> list[list[Var]]:
    """The entries [n, 1] of the octaves' bases, by row and column."""
    entries = op.reshape(lattice, op.const([octaves, 9]))
    return [[op.gather(entries, op.const([3 * row + column]), axis=1) for column in range(3)] for row in range(3)]


def _canonical(cells: Triple, basis: Sequence[Triple]) -> Triple:
    """The cells' canonical representatives, in 64-bit integers: the products outgrow float64 for tiles above 256 voxels."""
    whole = [op.cast(cell, to=np.int64) for cell in cells]
    columns = [[op.cast(entry, to=np.int64) for entry in row] for row in basis]
    for axis in range(3):
        rest = op.mod(whole[axis], columns[axis][axis])  # the sign of the divisor: a floor division's remainder
        turns = op.div(op.sub(whole[axis], rest), columns[axis][axis])
        whole = [*whole[:axis], *(op.sub(whole[row], op.mul(turns, columns[row][axis])) for row in range(axis, 3))]
    return [op.cast(cell, to=np.float64) for cell in whole]


def reduce_cells(cell: Triple, basis: Sequence[Triple], axis: int) -> Triple:
    """One step towards the canonical representative of a cell modulo its octave's lattice, for cells that are near it.

    The basis is lower triangular: column k has its pivot in row k and zeros above, so one floor division per axis, in
    order, is the whole reduction.
    """
    turns = op.floor(op.div(cell[axis], basis[axis][axis]))
    moved = [op.sub(cell[row], op.mul(turns, basis[row][axis])) for row in range(axis, 3)]
    return [*cell[:axis], *moved]


def _modulo(value: Var, divisor: Var) -> Var:
    return op.sub(value, op.mul(op.floor(op.div(value, divisor)), divisor))


def _perceptron(
    eta: Var,
    noise_weights: Var,
    gamma: Var,
    delta: Var,
    weights: Sequence[FloatArray],
    biases: Sequence[FloatArray],
    octaves: int,
) -> Var:
    """Eq. 5, y = gamma * phi(W x + A eta + b) + delta, with the style folded into the layer that follows.

    W (gamma * y + delta) + b = (W diag(gamma)) y + (W delta + b): the fold costs a few small products per run instead of
    two passes over [P, m] per layer. Bin l of the octaves enters hidden layer l;
    the last hidden layer gets none.
    """
    bins = op.split(eta, op.const([octaves // 4] * 4), outputs_count=4, axis=0)  # [q, P] each
    hidden = None
    for layer, bias_values in enumerate(biases):
        bias: Var = op.const(bias_values)
        if layer > 0:
            weight = op.const(weights[layer - 1])  # [m, m], x W
            scale = op.gather(gamma, op.const([layer - 1]), axis=0)  # [1, m]
            shift = op.gather(delta, op.const([layer - 1]), axis=0)
            bias = op.gemm(shift, weight, bias)
            weight = op.mul(op.transpose(scale, perm=[1, 0]), weight)
        if layer < 4:
            bias = op.gemm(bins[layer], op.gather(noise_weights, op.const(layer), axis=0), bias, transA=1)
        hidden = bias if hidden is None else op.gemm(hidden, weight, bias)
        if layer < len(biases) - 1:
            hidden = op.leaky_relu(hidden, alpha=SLOPE)
    assert hidden is not None
    return hidden
