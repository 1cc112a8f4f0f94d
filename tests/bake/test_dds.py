"""DDS volumes: the header field by field, the voxels by numpy, OpenImageIO and texture2ddecoder."""

from __future__ import annotations

import os
import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import texture2ddecoder

from solidgrain.bake.baker import bake
from solidgrain.bake.color import LINEAR, to_linear
from solidgrain.bake.store import Store
from solidgrain.bake.writers import Volume, check_output, make_output, open_writer
from solidgrain.runtime import UsageError
from solidgrain.runtime.workers import Workers
from tests.bake.test_writers import SIZE, VOXELS, expected, plan_for

FIELDS = ["size", "flags", "height", "width", "pitch", "depth", "mips"]
DECODERS = {"bc1": (texture2ddecoder.decode_bc1, 8), "bc7": (texture2ddecoder.decode_bc7, 16)}


def header_of(content: bytes) -> dict[str, int]:
    """The header as the Direct3D documentation lays it out, at its absolute offsets."""
    values = dict(zip(FIELDS, struct.unpack_from("<7I", content, 4), strict=True))
    assert content[:4] == b"DDS "
    assert content[84:88] == b"DX10"
    assert struct.unpack_from("<2I", content, 76) == (32, 4)  # size and flags of the pixel format
    caps, caps2 = struct.unpack_from("<2I", content, 108)
    dxgi, dimension, flags, array, alpha = struct.unpack_from("<5I", content, 128)
    assert (dimension, flags, array, alpha) == (4, 0, 1, 3)
    return {**values, "caps": caps, "caps2": caps2, "dxgi": dxgi}


def volume_of(*shape: int, level: int = 0) -> Volume:
    depth, height, width = shape
    return Volume((depth, height, width), (0, 0, 0), (1, 1, 1), "toy", "", 7, "", level=level)


def encoded(folder: Path, slab: np.ndarray, level: int = 0, **options: str | int) -> tuple[Store, object]:
    """A store with what the writer makes of a whole volume, in two slabs."""
    output = make_output(folder / "a.dds", **options)
    writer = open_writer(output, volume_of(*slab.shape[:3], level=level), Workers(2))
    store = Store(folder / f"level{level}", len(slab), writer.reserved)
    store.folder.mkdir()
    half = max(1, len(slab) // 2)
    for z in range(0, len(slab), half):
        store.append(z, len(slab[z : z + half]), writer.encode(z, slab[z : z + half]))
    return store, writer


def smooth(*shape: int) -> np.ndarray:
    """Waves without symmetry, [z, y, x, 3] in [0, 1]."""
    z, y, x = np.meshgrid(*(np.arange(extent) for extent in shape), indexing="ij")
    waves = [np.sin(x / 9 + y / 17 + z / 5), np.cos(x / 13 - y / 8), np.sin(y / 11 + z / 3)]
    return (0.5 + 0.4 * np.stack(waves, -1)).astype(np.float32)


@pytest.fixture(scope="module")
def baked(toy, tmp_path_factory):
    folder = tmp_path_factory.mktemp("dds")
    outputs = [
        make_output(folder / "byte.dds"),
        make_output(folder / "half.dds", type="rgba16f"),  # linear: no header could say sRGB
        make_output(folder / "linear.dds", colorspace=LINEAR),
        make_output(folder / "dithered.dds", dither=1),
    ]
    bake(plan_for(toy, *outputs), toy)
    return folder


def test_the_header_is_that_of_a_volume_texture(baked):
    content = (baked / "byte.dds").read_bytes()
    header = header_of(content)
    assert (header["width"], header["height"], header["depth"]) == SIZE
    assert header["size"] == 124
    assert header["flags"] == 0x1 | 0x2 | 0x4 | 0x8 | 0x1000 | 0x800000
    assert header["pitch"] == SIZE[0] * 4
    assert header["mips"] == 1
    assert (header["caps"], header["caps2"]) == (0x1000 | 0x8, 0x200000)
    assert len(content) == 148 + SIZE[0] * SIZE[1] * SIZE[2] * 4


@pytest.mark.parametrize(("name", "dxgi"), [("byte.dds", 29), ("linear.dds", 28), ("half.dds", 10)])
def test_the_pixel_format_says_whether_colours_are_srgb(baked, name, dxgi):
    assert header_of((baked / name).read_bytes())["dxgi"] == dxgi


@pytest.mark.parametrize(("x", "y", "z"), VOXELS)
def test_voxels_lie_x_fastest_then_y_then_z_with_alpha_one(baked, toy, x, y, z):
    start = x + SIZE[0] * (y + SIZE[1] * z)
    color = expected(toy, x, y, z)
    byte = np.fromfile(baked / "byte.dds", "u1", offset=148).reshape(-1, 4)[start]
    half = np.fromfile(baked / "half.dds", "<f2", offset=148).reshape(-1, 4)[start]
    np.testing.assert_allclose(byte[:3] / 255, color, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(half[:3], to_linear(color), rtol=1e-3)
    assert (byte[3], half[3]) == (255, 1)


def test_openimageio_reads_the_first_slice(baked, toy):
    image = oiio.ImageInput.open(os.fspath(baked / "byte.dds"))
    assert image.spec().get_string_attribute("textureformat") == "Volume Texture"
    assert (image.spec().width, image.spec().height, image.spec().depth) == SIZE
    pixels = image.read_image(0, 0, 0, 4, oiio.UINT8).reshape(-1, 4)
    for x, y in [(0, 0), (6, 0), (0, 4), (3, 1)]:
        np.testing.assert_allclose(pixels[x + SIZE[0] * y, :3] / 255, expected(toy, x, y, 0), atol=0.5 / 255 + 1e-6)


@pytest.mark.parametrize(("kind", "dxgi", "floor"), [("bc1", 72, 30), ("bc7", 99, 38)])
def test_blocks_decode_to_the_colours(tmp_path, kind, dxgi, floor):
    """A swap of red and blue or of two axes would leave a few decibels."""
    slab = smooth(3, 24, 40)
    store, writer = encoded(tmp_path, slab, type=kind)
    content = writer.assemble(store)[0].staged.read_bytes()
    header = header_of(content)
    decode, block_bytes = DECODERS[kind]
    slice_bytes = 40 * 24 // 16 * block_bytes
    assert (header["dxgi"], header["pitch"], header["flags"] & 0x80008) == (dxgi, slice_bytes, 0x80000)
    assert len(content) == 148 + 3 * slice_bytes
    for z in range(3):
        pixels = decode(content[148 + z * slice_bytes :][:slice_bytes], 40, 24)
        bgra = np.frombuffer(pixels, np.uint8).reshape(24, 40, 4)
        assert bgra[..., 3].min() == 255
        error = bgra[..., 2::-1] / 255 - slab[z]
        assert -10 * np.log10(np.mean(error**2)) > floor


def test_levels_follow_the_volume_in_one_file(tmp_path):
    """Assembled twice, as after a kill: nothing is appended twice."""
    levels = [smooth(6, 4, 8), smooth(3, 2, 4) / 2, smooth(1, 1, 2) / 4]
    stores = [encoded(tmp_path, slab, level)[0] for level, slab in enumerate(levels)]
    writer = open_writer(make_output(tmp_path / "a.dds"), volume_of(6, 4, 8), Workers(2))
    first = writer.assemble_levels(stores[0], stores[1:])[0].staged.read_bytes()
    content = writer.assemble_levels(stores[0], stores[1:])[0].staged.read_bytes()
    assert content == first
    header = header_of(content)
    assert (header["width"], header["height"], header["depth"], header["mips"]) == (8, 4, 6, 3)
    assert header["flags"] & 0x20000
    assert header["caps"] == 0x1000 | 0x8 | 0x400000
    values = np.frombuffer(content, np.uint8, offset=148).reshape(-1, 4)
    for slab in levels:
        count = slab.size // 3
        np.testing.assert_allclose(values[:count, :3] / 255, slab.reshape(-1, 3), atol=0.51 / 255)
        values = values[count:]
    assert not values.size


def test_small_levels_of_blocks_repeat_their_edge(tmp_path):
    slabs = [smooth(4, 12, 12), smooth(2, 6, 6), smooth(1, 3, 3)]
    stores = [encoded(tmp_path, slab, level, type="bc7")[0] for level, slab in enumerate(slabs)]
    writer = open_writer(make_output(tmp_path / "a.dds", type="bc7"), volume_of(4, 12, 12), Workers(1))
    content = writer.assemble_levels(stores[0], stores[1:])[0].staged.read_bytes()
    assert len(content) == 148 + 16 * (4 * 9 + 2 * 4 + 1)
    last = np.frombuffer(texture2ddecoder.decode_bc7(content[-16:], 4, 4), np.uint8).reshape(4, 4, 4)[..., 2::-1] / 255
    np.testing.assert_allclose(last[:3, :3], slabs[2][0], atol=0.03)
    np.testing.assert_allclose(last[3, 3], slabs[2][0, 2, 2], atol=0.03)


@pytest.mark.parametrize("options", [{}, {"type": "rgba16f"}, {"type": "bc1"}, {"type": "bc7"}])
def test_bytes_do_not_depend_on_the_slabs(tmp_path, options):
    slab = smooth(5, 4, 8)
    store, writer = encoded(tmp_path, slab, **options)
    whole = writer.encode(0, slab).streams["data"]
    assert writer.assemble(store)[0].staged.read_bytes()[148:] == b"".join(bytes(memoryview(part).cast("B")) for part in whole)


@pytest.mark.parametrize("name", ["byte.dds", "half.dds", "linear.dds", "dithered.dds"])
def test_a_probe_finds_the_colours_within_its_bound(baked, toy, name):
    options = {"byte.dds": {}, "dithered.dds": {"dither": 1}}.get(name, {"colorspace": LINEAR})
    output = make_output(baked / name, type="rgba16f" if name == "half.dds" else "rgba8", **options)
    colors, bound = open_writer(output, plan_for(toy).volume, Workers(1)).probe(np.array(VOXELS))
    wanted = np.array([expected(toy, *voxel) for voxel in VOXELS])
    assert np.abs(colors - (to_linear(wanted) if output.colorspace == LINEAR else wanted)).max() <= bound < 0.01


def test_blocks_are_not_probed(tmp_path):
    output = make_output(tmp_path / "a.dds", type="bc1")
    assert open_writer(output, volume_of(4, 4, 4), Workers(1)).probe(np.array([[0, 0, 0]])) is None


def test_what_direct3d_cannot_hold_is_refused(tmp_path):
    output = make_output(tmp_path / "a.dds")
    with pytest.raises(UsageError, match=r"a\.dds: 4x4x2049 voxels, a DDS volume has at most 2048 along each axis$"):
        check_output(output, volume_of(2049, 4, 4))
    check_output(output, volume_of(2048, 3, 5))


def test_blocks_of_other_than_whole_slices_are_refused(tmp_path):
    output = make_output(tmp_path / "a.dds", type="bc7")
    with pytest.raises(UsageError, match=r"a\.dds: 8x6 voxels in a slice, bc7 needs multiples of 4.*rgba8$"):
        check_output(output, volume_of(5, 6, 8))
    check_output(output, volume_of(5, 4, 8))


def test_blocks_without_the_encoder_are_refused_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "etcpak", None)
    with pytest.raises(ModuleNotFoundError) as caught:
        check_output(make_output(tmp_path / "a.dds", type="bc1"), volume_of(4, 4, 4))
    assert caught.value.name == "etcpak"
    check_output(make_output(tmp_path / "a.dds"), volume_of(4, 4, 4))


def test_a_bake_without_the_encoder_names_the_extra(solidgrain, toy_folder, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "etcpak", None)
    outcome = solidgrain("bake", toy_folder, "--size", 8, "--out", tmp_path / "a.dds", "--dds-type", "bc7")
    assert outcome.code == 1
    assert "pip install 'solidgrain[dds]'" in outcome.error
    assert not list(tmp_path.iterdir())


def test_a_baked_block_volume_is_the_texture(toy, tmp_path):
    """Through the whole baker: 8x8 slices, whose colours the decoder gives back roughly."""
    plan = replace(plan_for(toy, make_output(tmp_path / "a.dds", type="bc7")), size=(8, 8, 19))
    bake(plan, toy)
    content = (tmp_path / "a.dds").read_bytes()
    bgra = np.frombuffer(texture2ddecoder.decode_bc7(content[148 + 18 * 64 :], 8, 8), np.uint8).reshape(8, 8, 4)
    np.testing.assert_allclose(bgra[5, 2, 2::-1] / 255, expected(toy, 2, 5, 18), atol=0.1)
