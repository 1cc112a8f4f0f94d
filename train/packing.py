"""Checkpoints without their slack: lossless, and quick, since a training waits for it.

A packed file is 8 bytes `SGTRAIN2`, the length of what was packed as a little-endian uint64, its CRC-32 as a uint32, and its
bytes in another order: every fourth byte from the first on, from the second, from the third, and, as a zlib stream, from the
fourth. These are sign and exponent of float32 numbers, which take few values and shrink to a third; mantissas are noise, which
would not shrink at all.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

MAGIC, UNCHECKED = b"SGTRAIN2", b"SGTRAIN1"  # earlier versions wrote no checksum
HEADER, CHECKSUM = struct.Struct("<8sQ"), struct.Struct("<I")
PLANES = 4  # bytes of a float32


def pack(content: bytes | memoryview) -> bytes:
    length = len(content)
    whole = np.zeros(-(-length // PLANES) * PLANES, np.uint8)
    whole[:length] = np.frombuffer(content, np.uint8)
    planes = np.ascontiguousarray(whole.reshape(-1, PLANES).T)
    packer = zlib.compressobj(1, strategy=zlib.Z_RLE)  # no search for repeats but of one byte
    head = HEADER.pack(MAGIC, length) + CHECKSUM.pack(zlib.crc32(content))
    return b"".join([head, planes[:-1].data, packer.compress(planes[-1].data), packer.flush()])


def unpack(content: bytes) -> bytes:
    """What was packed, or the content itself if it never was. Raises ValueError or zlib.error if it is damaged."""
    if not content.startswith((MAGIC, UNCHECKED)):
        return content
    start = HEADER.size + CHECKSUM.size * content.startswith(MAGIC)
    length = HEADER.unpack_from(content)[1] if len(content) >= start else len(content)
    each = -(-length // PLANES)
    if len(content) < start + (PLANES - 1) * each:
        raise ValueError("cut short")
    plain = np.frombuffer(content, np.uint8, (PLANES - 1) * each, start)
    last = np.frombuffer(zlib.decompress(memoryview(content)[start + plain.size :]), np.uint8)
    unpacked = np.concatenate([plain, last]).reshape(PLANES, each).T.tobytes()[:length]
    if content.startswith(MAGIC) and zlib.crc32(unpacked) != CHECKSUM.unpack_from(content, HEADER.size)[0]:
        raise ValueError("its checksum is another one")
    return unpacked
