"""ZIP chunks of our own, read by the libraries that pipelines read them with."""

from __future__ import annotations

import io
import os
import struct

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from solidgrain.bake.writers.exr_zip import CHUNK, LINES, deflated, find_attributes

NOISE = np.random.default_rng(3)
SHAPES = [(1, 1), (1, 40), (15, 3), (16, 7), (17, 5), (33, 64), (64, 33)]  # chunks that end within 16 scanlines, odd widths


def uncompressed(pixels):
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage, "note": "kept"}
    file = io.BytesIO()
    OpenEXR.File(header, {"RGB": pixels}).write(file)
    return file.getvalue()


def smooth(shape, dtype):
    ramp = np.add.outer(np.arange(shape[0]), np.arange(shape[1]))[..., None] / 50
    return (ramp + np.array([0.1, 0.2, 0.3])).astype(dtype)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("compression", LINES)
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_two_readers_find_every_bit(tmp_path, shape, compression, dtype):
    for name, pixels in {"ramp": smooth(shape, dtype), "noise": NOISE.random((*shape, 3)).astype(dtype)}.items():
        path = tmp_path / f"{name}.exr"
        path.write_bytes(deflated(uncompressed(pixels), compression))
        with OpenEXR.File(os.fspath(path)) as file:
            assert file.header()["compression"] == getattr(OpenEXR, f"{compression.upper()}_COMPRESSION")
            assert file.header()["note"] == "kept"
            np.testing.assert_array_equal(file.channels()["RGB"].pixels, pixels)
        image = oiio.ImageBuf(os.fspath(path))
        assert image.spec()["compression"] == compression
        np.testing.assert_array_equal(image.get_pixels(oiio.FLOAT), pixels.astype(np.float32))


def test_a_chunk_that_would_grow_is_stored(tmp_path):
    bits = NOISE.integers(0, 0x7BFF, (32, 32, 3), np.uint16).view(np.float16)  # nothing for deflate to find
    plain = uncompressed(bits)
    packed = deflated(plain, "zip")
    _, table = find_attributes(packed)
    offset, _ = struct.unpack_from("<qq", packed, table)
    assert CHUNK.unpack_from(packed, offset) == (0, 16 * 32 * 3 * 2)
    path = tmp_path / "noise.exr"
    path.write_bytes(packed)
    with OpenEXR.File(os.fspath(path)) as file:
        np.testing.assert_array_equal(file.channels()["RGB"].pixels.view(np.uint16), bits.view(np.uint16))


def test_it_is_smaller_and_the_same_each_time():
    plain = uncompressed(smooth((256, 256), np.float16))
    packed = deflated(plain, "zip")
    assert len(packed) < 0.5 * len(plain)
    assert packed == deflated(plain, "zip")
