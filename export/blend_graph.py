"""`blend.onnx`: points and how far they are from one texture to another in, colour out, on the noise of both.

The transition between two textures of a space at a point p with weight w, written as plainly as the sampler is (its noise
lookup is shared). Interpolating T_i would shear the noise far from the origin, mixing colours would show two stones at once
and lose contrast; so the noise is mixed, octave by octave, and the style follows the straight line between both codes:

    eta_i = ((1 - w) eta_A,i + w eta_B,i) / s_i         eta_X,i = table i at T_X,i p + o_i, the same table and offset for both
    s_i^2 = variance of the sum over all seeds, divided by that of the noise: 1 at both ends, less in between
    psi(eta) = ((1 - w) A_A + w A_B) eta                (Eq. 5; they differ only if a texture was adapted, Sec. 3.3)
    gamma(w), delta(w) = linear between the styles at knots w = k / K, which the mapping gave for z_A + (z_B - z_A) k / K

Both textures read the same tables, so they are the same noise at the origin and unrelated where T_A,i p and T_B,i p are
some texels apart. The correlation rho_i in between is that of two trilinear reads of white noise at distance d, over all
places in their cells: a product of cubic B-splines b(d_x) b(d_y) b(d_z) / b(0)^3.

    s_i^2 = (1 - w)^2 + w^2 + 2 w (1 - w) rho_i

With tiling, cells are numbered along the lattice of each texture, and which texels both share follows no distance. Then the
corners of both cells are compared: c = sum of share_a share_b over corners a of A's cell and b of B's that are one texel,
and v_A, v_B the same of a cell with itself (the lowest octaves of a small tile meet themselves again within a cell).

    s_i^2 = ((1 - w)^2 v_A + w^2 v_B + 2 w (1 - w) c) / ((1 - w) v_A + w v_B)

Conventions as in `solidgrain.export.sampler_graph`; K + 1 knots, any number of them; both textures' octaves are 2n rows, those
of A first.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import numpy.typing as npt
import onnx
import onnx.checker
import spox
import spox.opset.ai.onnx.v17 as op
from spox import Tensor, Var, argument

from solidgrain.export.sampler_graph import (
    RESOLUTION,
    SLOPE,
    Triple,
    corner_texels,
    interpolate,
    is_untiled,
    lattice_entries,
    locate,
    reduce_cells,
)

FloatArray = npt.NDArray[np.float32]


def build_blend_graph(weights: Sequence[FloatArray], biases: Sequence[FloatArray], octaves: int) -> onnx.ModelProto:
    """The transition between two textures of one sampler, whose `weights` and `biases` are as in `build_sampler_graph`."""
    n, width, depth = octaves, len(biases[0]), len(biases) - 1
    inputs = {
        "points": argument(Tensor(np.float64, ("P", 3))),
        "weight": argument(Tensor(np.float32, ("P",))),
        "transforms": argument(Tensor(np.float64, (2 * n, 3, 3))),
        "offsets": argument(Tensor(np.float64, (n, 3))),
        "lattice": argument(Tensor(np.float64, (2 * n, 3, 3))),
        "gamma": argument(Tensor(np.float32, ("knots", depth, width))),
        "delta": argument(Tensor(np.float32, ("knots", depth, width))),
        "noise_weights": argument(Tensor(np.float32, (2, 4, n // 4, width))),
        "noise": argument(Tensor(np.float32, (n, RESOLUTION, RESOLUTION, RESOLUTION))),
    }
    offsets = op.concat([inputs["offsets"], inputs["offsets"]], axis=0)
    cells, fractions = locate(inputs["points"], inputs["transforms"], offsets)
    texels = corner_texels(cells, inputs["lattice"], 2 * n)
    both = interpolate(inputs["noise"], texels, fractions, np.tile(np.arange(n, dtype=np.int32), 2))
    first, second = op.sub(op.const(np.float32(1)), inputs["weight"]), inputs["weight"]  # along the rows of [n, P]
    (spread,) = op.if_(
        is_untiled(inputs["lattice"], 2 * n),
        then_branch=lambda: [_spread_by_distance(cells, fractions, first, second)],
        else_branch=lambda: [_spread_by_texels(texels, fractions, inputs["lattice"], first, second, n)],
    )
    eta = op.div(_mixed(both, first, second), op.sqrt(spread))
    styles = (inputs["gamma"], inputs["delta"])
    rgb = _perceptron(eta, inputs["weight"], styles, inputs["noise_weights"], weights, biases)
    model = spox.build(inputs, {"rgb": rgb})
    model.producer_name = "solidgrain"
    onnx.checker.check_model(model, full_check=True)
    return model


def _halves(rows: Var, axis: int = 0) -> tuple[Var, Var]:
    """[2n, P] as A's rows and B's."""
    first, second = op.split(rows, outputs_count=2, axis=axis)
    return first, second


def _mixed(rows: Var, first: Var, second: Var) -> Var:
    """[2n, P], both textures' rows by their weights [P] -> [n, P]."""
    of_a, of_b = _halves(rows)
    return op.add(op.mul(first, of_a), op.mul(second, of_b))


def _spread_by_distance(cells: Triple, fractions: Triple, first: Var, second: Var) -> Var:
    """s^2 [n, P] where octaves repeat as their tables do: by the distance of both reads, modulo 64 texels."""
    size, half = op.const(np.float64(RESOLUTION)), op.const(np.float64(RESOLUTION // 2))
    correlation = None
    for cell, fraction in zip(cells, fractions, strict=True):
        whole, part = op.sub(*_halves(cell)), op.sub(*_halves(fraction))
        turns = op.floor(op.div(op.add(whole, half), size))
        whole = op.sub(whole, op.mul(turns, size))  # exact: whole numbers
        along = _spline(op.abs(op.add(op.cast(whole, to=np.float32), part)))
        correlation = along if correlation is None else op.mul(correlation, along)
    assert correlation is not None
    return _variance(op.const(np.float32(1)), op.const(np.float32(1)), correlation, first, second)


def _spline(distance: Var) -> Var:
    """The cubic B-spline over its value at zero: ((2 - a)^3 - 4 (1 - a)^3) / 4, each cube only where it is positive."""
    near, far = (op.relu(op.sub(op.const(np.float32(reach)), distance)) for reach in (1, 2))
    cube = [op.mul(op.mul(side, side), side) for side in (near, far)]
    return op.sub(op.mul(cube[1], op.const(np.float32(0.25))), cube[0])


def _spread_by_texels(texels: Var, fractions: Triple, lattice: Var, first: Var, second: Var, octaves: int) -> Var:
    """s^2 [n, P] where octaves repeat on lattices: by the texels that the corners of both cells have in common."""
    along = [(op.sub(op.const(np.float32(1)), fraction), fraction) for fraction in fractions]
    shares = op.concat([op.unsqueeze(corner, op.const([0])) for corner in _products(along)], axis=0)  # [8, 2n, P]
    places = _halves(op.reshape(texels, op.const([8, 2 * octaves, -1])), axis=1)
    common = _common(places, _halves(shares, axis=1))
    own = _halves(_own_variance(fractions, lattice, 2 * octaves))
    variance = _variance(*own, common, first, second)
    return op.div(variance, op.add(op.mul(first, own[0]), op.mul(second, own[1])))


def _common(places: tuple[Var, Var], shares: tuple[Var, Var]) -> Var:
    """The sum of share_a share_b [n, P] over corners a of A's cells and b of B's [8, n, P] that are the same texel."""
    total, nothing = None, op.const(np.float32(0))
    for corner in range(8):
        place, share = (op.gather(part, op.const(corner), axis=0) for part in (places[0], shares[0]))  # [n, P]
        met = op.where(op.equal(places[1], place), shares[1], nothing)
        part = op.mul(op.reduce_sum(met, op.const([0]), keepdims=0), share)
        total = part if total is None else op.add(total, part)
    assert total is not None
    return total


def _own_variance(fractions: Triple, lattice: Var, octaves: int) -> Var:
    """The variance of a trilinear read [2n, P]: the sum of share_a share_b over corners a and b that the lattice joins.

    Along an axis, both shares give 1 - 2 t if a and b do not differ there, and t = f (1 - f) if they do, either way.
    """
    steps = np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))  # from one corner to another
    cell: Triple = [op.const(steps[:, axis][None]) for axis in range(3)]
    basis = lattice_entries(lattice, octaves)
    for axis in range(3):
        cell = reduce_cells(cell, basis, axis)  # [2n, 27]
    left = op.add(op.add(op.abs(cell[0]), op.abs(cell[1])), op.abs(cell[2]))
    joined = op.cast(op.equal(left, op.const(np.float64(0))), to=np.float32)
    differing = np.abs(steps) @ (4, 2, 1)  # which axes, as the number of a product below
    count = op.matmul(joined, op.const((differing[:, None] == np.arange(8)).astype(np.float32)))  # [2n, 8]
    change = [op.mul(fraction, op.sub(op.const(np.float32(1)), fraction)) for fraction in fractions]
    along = [(op.sub(op.const(np.float32(1)), op.add(t, t)), t) for t in change]
    terms = [op.mul(op.gather(count, op.const([k]), axis=1), term) for k, term in enumerate(_products(along))]
    return op.sum(terms)


def _products(along: Sequence[tuple[Var, Var]]) -> list[Var]:
    """One of each axis' two, multiplied: eight, x slowest."""
    return [op.mul(op.mul(x, y), z) for x in along[0] for y in along[1] for z in along[2]]


def _variance(of_a: Var, of_b: Var, common: Var, first: Var, second: Var) -> Var:
    """(1 - w)^2 v_A + w^2 v_B + 2 w (1 - w) c."""
    squares = op.add(op.mul(op.mul(first, first), of_a), op.mul(op.mul(second, second), of_b))
    return op.add(squares, op.mul(op.mul(op.mul(op.const(np.float32(2)), first), second), common))


def _perceptron(
    eta: Var,
    weight: Var,
    styles: tuple[Var, Var],
    noise_weights: Var,
    weights: Sequence[FloatArray],
    biases: Sequence[FloatArray],
) -> Var:
    """Eq. 5, y = gamma(w) * phi(W x + psi(eta) + b) + delta(w): a style per point, so nothing folds into W."""
    knots, width = _hats(weight, styles[0]), len(biases[0])
    bins = [
        op.split(op.mul(share, eta), outputs_count=4, axis=0) for share in (op.sub(op.const(np.float32(1)), weight), weight)
    ]
    hidden = None
    for layer, bias_values in enumerate(biases):
        bias: Var = op.const(bias_values)
        if layer < 4:
            psi = op.reshape(op.gather(noise_weights, op.const(layer), axis=1), op.const([-1, width]))  # A_A over A_B
            bias = op.gemm(op.concat([of_one[layer] for of_one in bins], axis=0), psi, bias, transA=1)
        hidden = bias if hidden is None else op.gemm(hidden, op.const(weights[layer - 1]), bias)
        if layer < len(biases) - 1:
            scale, shift = (op.matmul(knots, op.gather(style, op.const(layer), axis=1)) for style in styles)
            hidden = op.add(op.mul(op.leaky_relu(hidden, alpha=SLOPE), scale), shift)
    assert hidden is not None
    return hidden


def _hats(weight: Var, style: Var) -> Var:
    """How much of each knot [P, K + 1] there is at each weight [P]: hat functions, 1 at their knot and 0 at the next."""
    count = op.shape(style, start=0, end=1)
    numbers = op.range(op.const(0), op.squeeze(count, op.const([0])), op.const(1))
    last = op.cast(op.sub(count, op.const([1])), to=np.float32)
    position = op.unsqueeze(op.mul(weight, last), op.const([1]))  # [P, 1]
    distance = op.abs(op.sub(position, op.cast(numbers, to=np.float32)))
    return op.relu(op.sub(op.const(np.float32(1)), distance))
