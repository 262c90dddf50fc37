"""Which external files an ONNX graph refers to, without loading it.

The serving side must know this before a runtime opens the graph, and it does not depend on the onnx package; so
this walks the few protobuf fields that lead to tensors.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from bathyscope.errors import BundleError

# Message -> {field number: message of that field}, for every path from a model to a tensor (onnx.proto).
_CHILDREN: dict[str, dict[int, str]] = {
    "Model": {7: "Graph", 20: "TrainingInfo", 25: "Function"},
    "TrainingInfo": {1: "Graph", 2: "Graph"},
    "Function": {7: "Node", 11: "Attribute"},
    "Graph": {1: "Node", 5: "Tensor", 15: "SparseTensor"},
    "Node": {5: "Attribute"},
    "Attribute": {5: "Tensor", 6: "Graph", 10: "Tensor", 11: "Graph", 22: "SparseTensor", 23: "SparseTensor"},
    "SparseTensor": {1: "Tensor", 2: "Tensor"},
    "Tensor": {13: "Entry"},
}
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MAX_DEPTH = 64


def external_locations(path: Path) -> set[str]:
    """Every ``location`` of external tensor data named anywhere in the graph.

    Raises:
        BundleError: If the file is not an ONNX protobuf.
    """
    data = memoryview(path.read_bytes())
    try:
        return set(_locations(data, "Model", 0))
    except (IndexError, ValueError, UnicodeDecodeError) as error:
        raise BundleError(f"{path.name}: not an ONNX graph ({error})") from error


def _locations(data: memoryview, message: str, depth: int) -> Iterator[str]:
    if depth > _MAX_DEPTH:
        raise ValueError(f"nested deeper than {_MAX_DEPTH}")
    children = _CHILDREN[message]
    for number, value in _fields(data):
        child = children.get(number)
        if child is None or value is None:
            continue
        if child == "Entry":
            entry = {key: bytes(text or b"").decode() for key, text in _fields(value)}
            if entry.get(1) == "location":
                yield entry.get(2, "")
        else:
            yield from _locations(value, child, depth + 1)


def _fields(data: memoryview) -> Iterator[tuple[int, memoryview | None]]:
    """(number, bytes) of each field; numbers and fixed-size fields have None."""
    position = 0
    while position < len(data):
        tag, position = _varint(data, position)
        number, kind = tag >> 3, tag & 7
        if kind == _VARINT:
            _, position = _varint(data, position)
            yield number, None
        elif kind == _BYTES:
            length, position = _varint(data, position)
            if position + length > len(data):
                raise ValueError("a field reaches past the end of the file")
            yield number, data[position : position + length]
            position += length
        elif kind in (_FIXED64, _FIXED32):
            position += 8 if kind == _FIXED64 else 4
            yield number, None
        else:
            raise ValueError(f"unknown wire type {kind}")


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7
        if shift > 63:
            raise ValueError("a number is longer than 64 bits")
