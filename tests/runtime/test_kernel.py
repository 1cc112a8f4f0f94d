"""The fused kernel gives the colours of the formula, on every path that this machine has, and steps aside where it must."""

import base64
import hashlib
import os
import shutil
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import onnx
import pytest

from solidgrain.export.bundle import Details, SamplerWeights, write_bundle
from solidgrain.export.sampler_graph import build_sampler_graph
from solidgrain.runtime import EvaluationError, ProviderError, Texture, embedded_names, kernel, load
from solidgrain.runtime.fold import read_weights
from solidgrain.runtime.noise import noise_offsets, noise_tables
from tests.reference import color
from tests.toy import toy_weights

try:
    PATHS = kernel.kernel_paths()
except ProviderError as error:
    PATHS, REASON = (), str(error)
    if shutil.which("c++") or shutil.which("g++"):
        raise
needs_kernel = pytest.mark.skipif(not PATHS, reason="no fused kernel, and no C++ compiler to build it with")
every_path = pytest.mark.parametrize("path", PATHS or [pytest.param("none", marks=needs_kernel)])
BFLOAT16_PATHS = [path for path in PATHS if path in kernel.BFLOAT16_PATHS]
no_bfloat16 = pytest.mark.skip(reason="this processor multiplies no bfloat16: neither AMX nor AVX-512 BF16")
every_bfloat16_path = pytest.mark.parametrize("path", BFLOAT16_PATHS or [pytest.param("none", marks=no_bfloat16)])
FLOAT32 = 1e-4  # what is promised; AMX, which sums split bfloat16, comes to a third of it


@pytest.fixture
def loaded(tmp_path, monkeypatch):
    """A sampler as a bundle, loaded on one path of the kernel."""

    def load_on(path: str, weights: SamplerWeights, **options: object) -> Texture:
        folder = tmp_path / f"{len(list(tmp_path.iterdir()))}"
        write_bundle(folder, weights, Details(name="toy", patch=64))
        monkeypatch.setenv("SOLIDGRAIN_KERNEL", path)
        return load(folder, provider="kernel", **options)

    return load_on


def random_case(number: int) -> tuple[SamplerWeights, np.random.Generator]:
    """A random sampler: 16 or 32 octaves, any width that is a multiple of 16, transforms of any slant and scale."""
    draw = np.random.default_rng(number)
    octaves, width = int(draw.choice([16, 32])), 16 * int(draw.integers(1, 11))
    weights = toy_weights(octaves, width, seed=number)
    weights.transforms[:] = draw.standard_normal((octaves, 3, 3)) * 2.0 ** draw.uniform(-8, 2, (octaves, 1, 1))
    return weights, draw


def expected_colors(weights, points, seed, tiling=None):
    octaves = len(weights.transforms)
    tables, offsets = noise_tables(seed, octaves), noise_offsets(seed, octaves)
    return np.clip([color(weights, tables, offsets, tuple(point), tiling) for point in points], 0, 1)


@every_path
@pytest.mark.parametrize("number", range(6))
def test_random_samplers_at_random_points_are_the_formula(loaded, path, number):
    weights, draw = random_case(number)
    texture = loaded(path, weights)
    assert texture.provider == f"kernel:{path}"
    points = draw.uniform(-1, 1, (24, 3)) * 10.0 ** draw.uniform(0, 9, (24, 1))
    np.testing.assert_allclose(texture.sample(points, number), expected_colors(weights, points, number), atol=FLOAT32)


@every_path
def test_points_just_below_a_cell_are_the_formula(loaded, path):
    """A coordinate of -1e-17 texels, modulo 64, is rounded up to 64: one texel past the end of its table."""
    weights, seed = toy_weights(), 3
    texture = loaded(path, weights)
    offsets = noise_offsets(seed, 16)
    points = np.zeros((16 * 9, 3))
    for number, (octave, row, column) in enumerate(np.ndindex(16, 3, 3)):
        points[number, column] = -offsets[octave, row] / weights.transforms[octave, row, column]
    near = np.concatenate([np.nextafter(points, side) for side in (-np.inf, np.inf)] + [points])
    np.testing.assert_allclose(texture.sample(near, seed), expected_colors(weights, near, seed), atol=FLOAT32)


def test_octaves_too_steep_for_the_kernel_run_in_onnx_runtime(tmp_path):
    weights = toy_weights()
    weights.transforms[15] *= 1e9
    texture = load(write_bundle(tmp_path / "steep", weights, Details(name="steep", patch=64)))
    assert texture.provider == "CPUExecutionProvider"
    assert "texels per pixel" in texture.provider_note


@every_path
@pytest.mark.parametrize("number", range(8))
def test_random_tilings_are_the_formula(loaded, path, number):
    """Periods from 2 to 20 000 voxels: lattices whose entries fit 32 bits, fit 53, and whose products do not."""
    weights, draw = random_case(100 + number)
    texture = loaded(path, weights)
    axes = "".join(sorted(draw.permutation(list("xyz"))[: draw.integers(1, 4)]))
    period = [int(extent) for extent in 2 ** draw.uniform(1, 14.3, 3)]
    origin = draw.uniform(-1, 1, 3) * 10.0 ** draw.uniform(0, 7)
    volume = texture.grid((2, 3, 4), 5, origin=origin, tile=axes, period=period)
    tiling = texture.tiling((2, 3, 4), tile=axes, period=period)
    at = [
        [tiling.wrap(np.array([origin[a] + k + 0.5]), a)[0] for a, k in enumerate((x, y, z))] for z, y, x in np.ndindex(2, 3, 4)
    ]
    np.testing.assert_allclose(volume.reshape(-1, 3), expected_colors(weights, at, 5, tiling), atol=FLOAT32)


@every_path
@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 5000), (1, 200, 7), (40, 1, 1), (17, 18, 33), (3, 70, 65), (33, 5, 16)])
def test_a_grid_of_any_shape_has_the_colours_of_its_points(loaded, path, shape):
    texture = loaded(path, toy_weights())
    volume = texture.grid(shape, 3, origin=(5.5, 1e6, -7), spacing=(0.5, 1, 2))
    z, y, x = np.indices(shape).reshape(3, -1)
    points = np.stack([5.5 + (x + 0.5) * 0.5, 1e6 + (y + 0.5), -7 + (z + 0.5) * 2], axis=1)
    assert np.array_equal(volume.reshape(-1, 3), texture.sample(points, 3))


@every_path
@pytest.mark.parametrize("tile", ["", "xz"])
def test_neither_threads_nor_order_nor_cuts_change_a_bit(loaded, path, tile):
    weights = toy_weights()
    one, four = loaded(path, weights, threads=1), loaded(path, weights, threads=4)
    options = {"seed": 1, "tile": tile, "period": (30, 40, 50)}
    whole = one.grid((20, 60, 70), **options)
    assert np.array_equal(four.grid((20, 60, 70), **options), whole)
    slabs = [slab for _, slab in four.slabs((20, 60, 70), slab=7, **options)]
    assert np.array_equal(np.concatenate(slabs), whole)
    points = np.random.default_rng(0).uniform(-50, 50, (20_000, 3))
    order = np.random.default_rng(1).permutation(len(points))
    assert np.array_equal(four.sample(points)[order], one.sample(points[order]))


@every_path
def test_it_agrees_with_the_graph(loaded, path):
    for octaves in (16, 32):
        texture = loaded(path, toy_weights(octaves, 128))
        graph = load(texture.bundle.folder, provider="cpu")
        points = np.random.default_rng(2).uniform(-1e4, 1e4, (5000, 3))
        np.testing.assert_allclose(texture.sample(points), graph.sample(points), atol=FLOAT32)
        options = {"origin": (1e9, 0.25, -3), "tile": "xy"}
        np.testing.assert_allclose(texture.grid((3, 40, 50), **options), graph.grid((3, 40, 50), **options), atol=FLOAT32)


@every_bfloat16_path
@pytest.mark.parametrize("tile", ["", "xyz"])
def test_bfloat16_is_close_to_float32(loaded, path, tile):
    for octaves in (16, 32):
        weights = toy_weights(octaves, 128)
        exact, fast = (loaded(path, weights, precision=precision) for precision in ("float32", "bfloat16"))
        assert fast.precision == "bfloat16"
        difference = fast.grid((16, 64, 64), tile=tile) - exact.grid((16, 64, 64), tile=tile)
        assert -10 * np.log10((difference.astype(float) ** 2).mean()) >= 45
        assert np.abs(difference).max() < 0.05
        assert np.abs(difference).max() > 0


@every_bfloat16_path
@pytest.mark.parametrize("tile", ["", "xz"])
@pytest.mark.parametrize("width", [16, 48, 112, 160])
def test_bfloat16_is_the_formula_in_points_and_in_grids_of_any_width(loaded, path, width, tile):
    for octaves in (16, 32):
        weights = toy_weights(octaves, width, seed=width)
        texture = loaded(path, weights, precision="bfloat16")
        volume = texture.grid((2, 3, 37), 7, origin=(1e6, -3, 0.25), tile=tile)
        z, y, x = np.indices(volume.shape[:3]).reshape(3, -1)
        points = np.stack([1e6 + (x + 0.5), -3 + (y + 0.5), 0.25 + (z + 0.5)], axis=1)
        if not tile:
            assert np.array_equal(texture.sample(points, 7), volume.reshape(-1, 3))
        tiling = texture.tiling(volume.shape[:3], tile=tile)
        some = [[tiling.wrap(point[axis : axis + 1], axis)[0] for axis in range(3)] for point in points[::5]]
        np.testing.assert_allclose(volume.reshape(-1, 3)[::5], expected_colors(weights, some, 7, tiling), atol=0.02)


@every_bfloat16_path
@pytest.mark.parametrize("name", embedded_names())
def test_embedded_textures_in_bfloat16_are_above_45_decibels(path, name, monkeypatch):
    monkeypatch.setenv("SOLIDGRAIN_KERNEL", path)
    exact, fast = load(name), load(name, precision="bfloat16")
    difference = (fast.grid((32, 96, 96)) - exact.grid((32, 96, 96))).astype(float)
    assert -10 * np.log10((difference**2).mean()) >= 45


@every_bfloat16_path
def test_bfloat16_neither_depends_on_cuts_and_threads(loaded, path):
    texture = loaded(path, toy_weights(), precision="bfloat16", threads=3)
    whole = texture.grid((20, 33, 50), tile="x")
    assert np.array_equal(np.concatenate([slab for _, slab in texture.slabs((20, 33, 50), tile="x", slab=3)]), whole)


@pytest.mark.skipif("avx512bf16" not in PATHS, reason="this processor has no AVX-512 BF16")
def test_avx512_gives_the_same_bits_with_bf16_and_without(loaded):
    with_it, without = (loaded(path, toy_weights()).grid((3, 40, 50), 7) for path in ("avx512bf16", "avx512"))
    assert np.array_equal(with_it, without)


@pytest.mark.parametrize("provider", ["auto", "cpu"])
def test_points_that_are_nowhere_have_no_colour_and_are_counted(toy_folder, provider):
    texture = load(toy_folder, provider=provider)
    points = np.random.default_rng(0).uniform(-9, 9, (5000, 3))
    wrong = {7: (np.nan, 0, 0), 8: (0, np.inf, 0), 4999: (1e13, 0, -np.inf)}
    holed = points.copy()
    for index, point in wrong.items():
        holed[index] = point
    with pytest.warns(RuntimeWarning, match="3 of 5000 points"):
        rgb = texture.sample(holed)
    assert np.isnan(rgb[list(wrong)]).all()
    others = np.setdiff1d(np.arange(5000), list(wrong))
    assert np.array_equal(rgb[others], texture.sample(points)[others])
    assert np.isnan(holed[7, 0]), "the caller's points are left as they were"


@pytest.mark.parametrize("provider", ["auto", "cpu"])
def test_points_in_any_memory_layout_are_taken(toy_folder, provider):
    texture = load(toy_folder, provider=provider)
    points = np.random.default_rng(0).uniform(-9, 9, (3000, 3)).astype(np.float32)
    expected = texture.sample(points.astype(np.float64))
    strided = np.zeros((3000, 6), np.float32)
    strided[:, ::2] = points
    for same in (points, np.asfortranarray(points), strided[:, ::2], points[::-1][::-1], points.tolist()):
        assert np.array_equal(texture.sample(same), expected)
    assert texture.sample(np.empty((0, 3))).shape == (0, 3)


def test_a_width_that_the_kernel_does_not_take_runs_in_onnx_runtime(tmp_path):
    folder = write_bundle(tmp_path / "odd", toy_weights(width=24), Details(name="odd", patch=64))
    texture = load(folder)
    assert texture.provider == "CPUExecutionProvider"
    assert texture.provider_note
    assert texture.grid((2, 3, 4)).shape == (2, 3, 4, 3)
    with pytest.raises(ProviderError):
        load(folder, provider="kernel")


@pytest.mark.parametrize("change", ["slope", "extra", "octaves", "constant"])
def test_an_unfamiliar_graph_is_not_mistaken_for_the_sampler(toy, change):
    weights = toy_weights(octaves=24 if change == "octaves" else 16)
    model = build_sampler_graph(weights.weights, weights.biases, len(weights.transforms))
    nodes = model.graph.node
    if change == "slope":
        next(node for node in nodes if node.op_type == "LeakyRelu").attribute[0].f = 0.3
    elif change == "extra":
        nodes[-1].op_type = "Sigmoid"
    elif change == "constant":
        whole = [
            node for node in nodes if node.op_type == "Constant" and node.attribute[0].t.data_type == onnx.TensorProto.INT32
        ]
        whole[0].attribute[0].t.raw_data = bytes(len(whole[0].attribute[0].t.raw_data))
    with pytest.raises(ValueError):
        read_weights(model.SerializeToString(), toy.data if change != "octaves" else other_octaves(toy.data))


def other_octaves(data):
    return type(data)(data.name, data.sampler_sha256, np.zeros((24, 3, 3)), data.gamma, data.delta, np.zeros((4, 6, 32)))


def test_a_damaged_graph_is_not_mistaken_for_the_sampler(toy):
    model = (toy.bundle.folder / "sampler.onnx").read_bytes()
    draw = np.random.default_rng(0)
    damaged = [model[: int(cut)] for cut in draw.integers(0, len(model), 40)]
    for position in draw.integers(0, 2000, 100):  # among the operators: weights may have any value
        flipped = bytearray(model)
        flipped[position] ^= 255
        damaged.append(bytes(flipped))
    for data in damaged:
        try:
            read_weights(data, toy.data)
        except ValueError:
            continue
        assert build_is_same(data, model), "a changed structure was accepted"


def build_is_same(data: bytes, model: bytes) -> bool:
    """Whether two models differ in nothing but names, or weights."""
    first, second = onnx.load_from_string(data), onnx.load_from_string(model)
    return [node.op_type for node in first.graph.node] == [node.op_type for node in second.graph.node]


@needs_kernel
def test_the_environment_chooses_the_path(toy_folder, monkeypatch):
    for path in PATHS:
        monkeypatch.setenv("SOLIDGRAIN_KERNEL", path)
        assert load(toy_folder).provider == f"kernel:{path}"
    monkeypatch.setenv("SOLIDGRAIN_KERNEL", "off")
    assert load(toy_folder).provider == "CPUExecutionProvider"
    assert "switched off" in load(toy_folder).provider_note
    monkeypatch.setenv("SOLIDGRAIN_KERNEL", "mmx")
    with pytest.raises(ProviderError, match="expected off or one of amx"):
        load(toy_folder)


@needs_kernel
def test_bfloat16_is_an_error_where_nothing_multiplies_it(toy_folder, monkeypatch):
    monkeypatch.setenv("SOLIDGRAIN_KERNEL", "portable")
    with pytest.raises(ProviderError, match="needs AMX or AVX-512 BF16"):
        load(toy_folder, precision="bfloat16")
    with pytest.raises(ProviderError, match="ONNX Runtime has float32 only"):
        load(toy_folder, precision="bfloat16", provider="cpu")
    with pytest.raises(ProviderError, match="expected float32 or bfloat16"):
        load(toy_folder, precision="float16")


@pytest.mark.parametrize("damage", ["missing", "empty", "text", "cut", "half", "foreign"])
def test_a_damaged_library_is_stepped_around(toy_folder, monkeypatch, tmp_path, damage):
    library = tmp_path / "_kernel.so"
    if damage == "empty":
        library.write_bytes(b"")
    elif damage == "text":
        library.write_text("not a library")
    elif damage in ("cut", "half"):
        if not PATHS:
            pytest.skip("no fused kernel to damage")
        whole = next(Path(kernel.__file__).parent.glob("_kernel*")).read_bytes()
        library.write_bytes(whole[: -1 if damage == "cut" else len(whole) // 2])
    elif damage == "foreign":
        import _ctypes

        shutil.copy(_ctypes.__file__, library)
    monkeypatch.setenv("SOLIDGRAIN_KERNEL_LIBRARY", str(library))
    texture = load(toy_folder)
    assert texture.provider == "CPUExecutionProvider"
    assert str(library) in texture.provider_note or "solidgrain_abi" in texture.provider_note
    with pytest.raises(ProviderError):
        load(toy_folder, provider="kernel")


@needs_kernel
def test_a_library_that_is_not_what_was_installed_is_not_called(toy_folder, monkeypatch, tmp_path):
    """A page of zeros in the middle of it loads, and ends the process when it is called."""
    whole = next(Path(kernel.__file__).parent.glob("_kernel*")).read_bytes()
    library, record = tmp_path / "solidgrain/runtime/_kernel.so", tmp_path / "solidgrain-1.0.dist-info/RECORD"
    library.parent.mkdir(parents=True), record.parent.mkdir()
    digest = base64.urlsafe_b64encode(hashlib.sha256(whole).digest()).rstrip(b"=").decode()
    record.write_text(f"solidgrain/runtime/_kernel.so,sha256={digest},{len(whole)}\nsolidgrain-1.0.dist-info/RECORD,,\n")
    library.write_bytes(whole[:8192] + bytes(4096) + whole[12288:])
    monkeypatch.setenv("SOLIDGRAIN_KERNEL_LIBRARY", str(library))
    texture = load(toy_folder)
    assert texture.provider == "CPUExecutionProvider"
    assert "is not the file that was installed (sha256 differs)" in texture.provider_note
    library.unlink()
    library.write_bytes(whole)
    assert load(toy_folder).provider.startswith("kernel:")


@needs_kernel
def test_wide_samplers_have_small_tasks(loaded):
    """Ctrl-C waits for the tasks that have begun."""
    texture = loaded(PATHS[-1], toy_weights(16, 256))
    instance = texture._instance(texture.tiling((1, 1, 1)), 0)
    assert len(instance.point_tasks(np.zeros((16384, 3)), np.empty((16384, 3), np.float32))) == 4


@needs_kernel
def test_damaged_weights_are_an_error_that_names_the_place(loaded):
    weights = toy_weights()
    weights.weights[2][0, 0] = np.inf
    for path in PATHS:
        texture = loaded(path, weights)
        with pytest.raises(EvaluationError, match=r"returned NaN at \(10\.5, 20\.5, 30\.5\)"):
            texture.grid((2, 3, 4), origin=(10, 20, 30))
        with pytest.raises(EvaluationError, match=r"returned NaN at \(1, 2, 3\)"):
            texture.sample([[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("provider", ["auto", "cpu"])
def test_a_texture_may_be_used_from_several_threads(toy_folder, provider):
    texture = load(toy_folder, provider=provider, threads=2)
    points = np.random.default_rng(0).uniform(-9, 9, (50, 3))
    expected = [texture.sample(points, seed) for seed in range(4)]
    wrong: list[int] = []

    def use(seed: int) -> None:
        wrong.extend(seed for _ in range(15) if not np.array_equal(texture.sample(points, seed), expected[seed]))

    threads = [threading.Thread(target=use, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


@needs_kernel
def test_instances_may_come_and_go(toy_folder):
    """Memory is given back: many instances, one after the other, take what one takes."""
    import resource

    texture = load(toy_folder, provider="kernel")
    for seed in range(5):
        texture.grid((1, 8, 8), seed)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for seed in range(5, 45):
        texture.grid((1, 8, 8), seed)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000, "KiB"


def test_a_forked_process_evaluates_as_well(toy_folder):
    texture = load(toy_folder, threads=2)
    expected = texture.grid((16, 64, 64))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that forking with threads is a risk: it is what is tested
        child = os.fork()
    if child == 0:
        os._exit(0 if np.array_equal(texture.grid((16, 64, 64)), expected) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.parametrize("provider", ["auto", "cpu"])
def test_an_interrupt_is_answered_at_once(toy_folder, provider):
    program = f"""
import signal, time
from solidgrain.runtime import load
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it, and so would its children
texture = load({str(toy_folder)!r}, provider={provider!r})
texture.grid((1, 8, 8))
print("ready", flush=True)
try:
    for k in range(1000):
        texture.grid((64, 512, 512))
except KeyboardInterrupt:
    print(time.time(), flush=True)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        time.sleep(0.4)
        sent = time.time()
        process.send_signal(2)
        assert float(process.stdout.readline()) - sent < 0.5
        assert process.wait(10) == 0


def test_a_library_may_be_named_from_the_working_folder(tmp_path, monkeypatch):
    shutil.copy(kernel._library_file(), tmp_path / "mine.so")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SOLIDGRAIN_KERNEL_LIBRARY", "mine.so")
    assert kernel.kernel_paths()[-1] == "portable"
