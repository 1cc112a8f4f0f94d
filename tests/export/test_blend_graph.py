"""`blend.onnx` is the formula, and its noise varies as much as either texture's."""

from dataclasses import replace

import numpy as np
import onnxruntime
import pytest

from solidgrain.export.blend_graph import build_blend_graph
from solidgrain.export.bundle import SamplerWeights, run_graph
from solidgrain.export.sampler_graph import build_sampler_graph
from solidgrain.runtime.blend_file import BlendData, blend_of
from solidgrain.runtime.lattice import Tiling, tiled, untiled
from solidgrain.runtime.mask import make_ramp
from solidgrain.runtime.noise import noise_offsets, noise_tables
from solidgrain.runtime.texture_file import TextureData
from tests.reference import blended_color
from tests.toy import toy_weights

OCTAVES, WIDTH, KNOTS = 16, 32, 5


def textures(seed: int, count: int) -> list[TextureData]:
    """Textures of the toy sampler whose transforms differ by tenths; every number of each is its own."""
    toy, draw = toy_weights(OCTAVES, WIDTH), np.random.default_rng(seed)
    scale = np.abs(toy.transforms).max((1, 2), keepdims=True)

    def near(array: np.ndarray, by: float) -> np.ndarray:
        return (array + by * draw.standard_normal(array.shape)).astype(np.float32)

    return [
        TextureData(
            "toy",
            "",
            toy.transforms + 0.1 * scale * draw.standard_normal(toy.transforms.shape),
            near(toy.gamma, 0.1),
            near(toy.delta, 0.1),
            near(toy.noise_weights, 0.1),
        )
        for _ in range(count)
    ]


def session_of(weights: SamplerWeights) -> onnxruntime.InferenceSession:
    model = build_blend_graph(weights.weights, weights.biases, OCTAVES)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def run(session, blend: BlendData, tiling: Tiling, points: np.ndarray, weight: np.ndarray, seed: int) -> np.ndarray:
    octaves = len(blend.transforms) // 2
    feed = {
        **blend.arrays(),
        "transforms": tiling.transforms,
        "lattice": tiling.lattice,
        "offsets": noise_offsets(seed, octaves),
        "noise": noise_tables(seed, octaves),
        "points": points,
        "weight": weight.astype(np.float32),
    }
    return session.run(["rgb"], feed)[0]


@pytest.fixture(scope="module")
def weights():
    return toy_weights(OCTAVES, WIDTH)


@pytest.fixture(scope="module")
def session(weights):
    return session_of(weights)


@pytest.fixture(scope="module")
def blend():
    return blend_of("ab", textures(1, KNOTS), make_ramp("x", 0, 1))


@pytest.mark.parametrize("reach", [2.0, 64.0, 1e4, 1e6])
def test_it_is_the_formula_near_and_far(weights, session, blend, reach):
    draw = np.random.default_rng(0)
    points, weight = draw.uniform(-reach, reach, (20, 3)), draw.uniform(0, 1, 20).astype(np.float32)
    weight[:6] = [0, 1, 0.25, 0.5, 1e-6, 1 - 1e-6]
    tables, offsets = noise_tables(3, OCTAVES), noise_offsets(3, OCTAVES)
    expected = [blended_color(weights, blend, tables, offsets, *one) for one in zip(points, weight.astype(float), strict=True)]
    found = run(session, blend, untiled(blend.transforms), points, weight, 3)
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize(("axes", "side"), [("xyz", 24.0), ("xyz", 128.0), ("xyz", 1024.0), ("x", 64.0), ("yz", 300.0)])
def test_it_is_the_formula_on_a_tile(weights, session, blend, axes, side):
    tiling = tiled(blend.transforms, (side, side, side), axes)
    draw = np.random.default_rng(0)
    points, weight = draw.uniform(0, side, (16, 3)), draw.uniform(0, 1, 16).astype(np.float32)
    points[:8] /= side / 2  # where both textures meet the same texels
    tables, offsets = noise_tables(3, OCTAVES), noise_offsets(3, OCTAVES)
    expected = [
        blended_color(weights, blend, tables, offsets, *one, tiling) for one in zip(points, weight.astype(float), strict=True)
    ]
    np.testing.assert_allclose(run(session, blend, tiling, points, weight, 3), expected, atol=1e-4)


def test_at_both_ends_it_is_the_sampler(weights, session, blend):
    model = build_sampler_graph(weights.weights, weights.biases, OCTAVES)
    points = np.random.default_rng(0).uniform(0, 100, (500, 3))
    for weight, texture in zip((0, 1), blend.ends, strict=True):
        found = run(session, blend, untiled(blend.transforms), points, np.full(500, weight), 3)
        np.testing.assert_allclose(found, run_graph(model, texture, points, 3), atol=1e-5)


@pytest.mark.parametrize("axes", ["", "xyz"])
def test_a_texture_blended_with_itself_is_that_texture(session, blend, axes):
    """On a tile of 24 pixels, too, whose lowest octaves meet themselves again within a cell."""
    both = blend_of("aa", [blend.ends[0]] * 3, make_ramp("x", 0, 1))
    points, tiling = np.random.default_rng(0).uniform(0, 24, (500, 3)), tiled(both.transforms, (24.0, 24.0, 24.0), axes)
    alone, along = (run(session, both, tiling, points, weight, 3) for weight in (np.zeros(500), np.linspace(0, 1, 500)))
    np.testing.assert_allclose(along, alone, atol=1e-5)


def transparent() -> SamplerWeights:
    """A sampler whose colours are the first three octaves' noise: 50 keeps every unit on the straight side of its ReLU."""
    weights, one = toy_weights(OCTAVES, 16), np.eye(16, dtype=np.float32)
    biases = [np.full(16, 50, np.float32)] + [np.zeros(16, np.float32)] * 4 + [np.full(3, -50, np.float32)]
    return replace(weights, weights=[one] * 4 + [one[:, :3]], biases=biases)


def noises(axes: str) -> tuple[BlendData, Tiling]:
    """Two textures of about a texel per pixel: a tenth of a pixel apart at the origin, unrelated from some tens on."""
    draw = np.random.default_rng(3)
    ends, plain = [], np.ones((5, 16), np.float32)
    first = np.linalg.qr(draw.standard_normal((OCTAVES, 3, 3)))[0]
    for transforms in (first, first + 0.1 * draw.standard_normal(first.shape)):
        psi = np.zeros((4, OCTAVES // 4, 16), np.float32)
        psi[0, :, : OCTAVES // 4] = np.eye(OCTAVES // 4)
        ends.append(TextureData("", "", transforms, plain, 0 * plain, psi))
    blend = blend_of("ab", ends, make_ramp("x", 0, 1))
    return blend, tiled(blend.transforms, (48.0, 48.0, 48.0), axes)


@pytest.mark.parametrize(("axes", "reach", "distance"), [("", 6, 0), ("", 32, 0), ("", 32, 1e6), ("xyz", 24, 24), ("x", 6, 6)])
def test_in_between_the_noise_varies_as_much_as_at_the_ends(axes, reach, distance):
    """Where both textures' noise is the same, related and unrelated; eight instances, 4 % to spare."""
    session, (blend, tiling) = session_of(transparent()), noises(axes)
    points = np.random.default_rng(0).uniform(-reach, reach, (1000, 3)) + distance
    weights = np.repeat([0, 0.3, 0.5, 1], 1000)
    runs = [run(session, blend, tiling, np.tile(points, (4, 1)), weights, seed) for seed in range(8)]
    first, between, halfway, second = np.square(runs).reshape(8, 4, -1).mean((0, 2))
    for found in (between, halfway):
        assert abs(found / (0.5 * (first + second)) - 1) < 0.04
    assert abs(first / (2 / 3) ** 3 - 1) < 0.08
