"""Reading an ONNX file with nothing but numpy: as much of the format as it takes to recognise a sampler and its weights.

The format is Protocol Buffers (https://protobuf.dev/programming-guides/encoding); field numbers are those of onnx.proto.
ONNX Runtime runs graphs but does not show what is in them, and the onnx package is too much for a runtime.
"""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5  # wire types
DTYPES = {1: "<f4", 6: "<i4", 7: "<i8", 9: "?", 11: "<f8"}  # TensorProto.DataType

DAMAGED = (IndexError, TypeError, AttributeError, OverflowError, MemoryError, RecursionError, UnicodeDecodeError, struct.error)

Array = npt.NDArray[Any]
Attribute = Any  # float, int, bytes, a tuple of int, Array or Graph


@dataclass(frozen=True)
class Node:
    """One operator: its type, the values that it reads and makes, and its attributes."""

    operator: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: dict[str, Attribute]


@dataclass(frozen=True)
class Graph:
    """Operators in order, and the names of the values that go in and come out."""

    nodes: tuple[Node, ...]
    initializers: dict[str, Array]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def parse_model(data: bytes) -> Graph:
    """The graph of a serialised ModelProto. Raises ValueError if it is damaged or holds what this reader does not know."""
    try:
        model = _fields(data)
        if 25 in model:
            raise ValueError("model has functions of its own")
        return _graph(model[7][0])
    except DAMAGED as error:
        raise ValueError(f"not an ONNX model, or damaged ({error})") from error


def _graph(data: bytes) -> Graph:
    graph = _fields(data)
    named = [_tensor(tensor) for tensor in graph[5]]
    return Graph(
        nodes=tuple(_node(node) for node in graph[1]),
        initializers=dict(named),
        inputs=tuple(_text(_fields(value)[1][0]) for value in graph[11]),
        outputs=tuple(_text(_fields(value)[1][0]) for value in graph[12]),
    )


def _node(data: bytes) -> Node:
    node = _fields(data)
    attributes = dict(_attribute(attribute) for attribute in node[5])
    domain = _text(node[7][0]) if node[7] else ""
    operator = f"{domain}.{_text(node[4][0])}" if domain else _text(node[4][0])
    return Node(operator, tuple(map(_text, node[1])), tuple(map(_text, node[2])), attributes)


def _attribute(data: bytes) -> tuple[str, Attribute]:
    attribute = _fields(data)
    name, kind = _text(attribute[1][0]), attribute[20][0]
    if kind == 1:
        return name, float(struct.unpack("<f", attribute[2][0])[0])
    if kind == 2:
        return name, _signed(attribute[3][0] if attribute[3] else 0)
    if kind == 3:
        return name, bytes(attribute[4][0])
    if kind == 4:
        return name, _tensor(attribute[5][0])[1]
    if kind == 5:
        return name, _graph(attribute[6][0])
    if kind == 7:
        return name, tuple(_integers(attribute[8]))
    raise ValueError(f"attribute {name} is of type {kind}")


def _tensor(data: bytes) -> tuple[str, Array]:
    tensor = _fields(data)
    kind = tensor[2][0]
    if kind not in DTYPES or not tensor[9]:
        raise ValueError(f"tensor of type {kind} is not stored as raw data")
    name = _text(tensor[8][0]) if tensor[8] else ""
    return name, np.frombuffer(tensor[9][0], DTYPES[kind]).reshape(tuple(_integers(tensor[1])))


def _integers(values: list[Any]) -> Iterator[int]:
    """A repeated integer field, packed into bytes or not."""
    for value in values:
        if isinstance(value, int):
            yield _signed(value)
        else:
            position = 0
            while position < len(value):
                number, position = _varint(value, position)
                yield _signed(number)


def _fields(data: bytes) -> defaultdict[int, list[Any]]:
    """The fields of one message by number, each in order: integers for varints, bytes for everything else."""
    fields: defaultdict[int, list[Any]] = defaultdict(list)
    position = 0
    while position < len(data):
        key, position = _varint(data, position)
        wire = key & 7
        if wire == VARINT:
            value, position = _varint(data, position)
            fields[key >> 3].append(value)
            continue
        if wire == BYTES:
            length, position = _varint(data, position)
        elif wire in (FIXED64, FIXED32):
            length = 8 if wire == FIXED64 else 4
        else:
            raise ValueError(f"unknown wire type {wire}")
        if position + length > len(data):
            raise ValueError("cut short")
        fields[key >> 3].append(data[position : position + length])
        position += length
    return fields


def _varint(data: bytes, position: int) -> tuple[int, int]:
    """A base-128 number and the position after it."""
    number = shift = 0
    while True:
        byte = data[position]
        number |= (byte & 0x7F) << shift
        position, shift = position + 1, shift + 7
        if byte < 0x80:
            return number, position


def _signed(number: int) -> int:
    return number - 2**64 if number >= 2**63 else number


def _text(data: bytes) -> str:
    return data.decode("utf-8")
