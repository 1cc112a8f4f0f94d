"""Checkpoints without their slack: lossless, and quick, since a training waits for it.

A packed file is 8 bytes `SGTRAIN1`, the length of what was packed as a little-endian uint64, and its bytes in another order:
every fourth byte from the first on, from the second, from the third, and, as a zlib stream, from the fourth. These are sign and
exponent of float32 numbers, which take few values and shrink to a third; mantissas are noise, which would not shrink at all.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

MAGIC = b"SGTRAIN1"
HEADER = struct.Struct("<8sQ")
PLANES = 4  # bytes of a float32


def pack(content: bytes | memoryview) -> bytes:
    length = len(content)
    whole = np.zeros(-(-length // PLANES) * PLANES, np.uint8)
    whole[:length] = np.frombuffer(content, np.uint8)
    planes = np.ascontiguousarray(whole.reshape(-1, PLANES).T)
    packer = zlib.compressobj(1, strategy=zlib.Z_RLE)  # no search for repeats but of one byte
    return b"".join([HEADER.pack(MAGIC, length), planes[:-1].data, packer.compress(planes[-1].data), packer.flush()])


def unpack(content: bytes) -> bytes:
    """What was packed, or the content itself if it never was. Raises ValueError or zlib.error if it is damaged."""
    if not content.startswith(MAGIC):
        return content
    if len(content) < HEADER.size:
        raise ValueError("cut short")
    _, length = HEADER.unpack_from(content)
    each = -(-length // PLANES)
    plain = np.frombuffer(content, np.uint8, (PLANES - 1) * each, HEADER.size)
    last = np.frombuffer(zlib.decompress(memoryview(content)[HEADER.size + plain.size :]), np.uint8)
    return np.concatenate([plain, last]).reshape(PLANES, each).T.tobytes()[:length]
