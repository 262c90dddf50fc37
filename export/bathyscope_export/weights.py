"""One weights file for all graphs of a bundle: equal tensors are stored once."""

import hashlib
from collections.abc import Iterable
from pathlib import Path

import onnx
from onnx import numpy_helper

ALIGNMENT = 64
"""Bytes; vector loads of a mapped file want it."""

INLINE_BYTES = 1024
"""Smaller tensors stay in the graph, where shape inference can see them."""


def externalise(models: Iterable[onnx.ModelProto], path: Path) -> None:
    """Move the tensors of ``models`` into the file at ``path``, to which they then refer by its bare name."""
    offsets: dict[bytes, int] = {}
    with path.open("wb") as file:
        for model in models:
            for tensor in model.graph.initializer:
                data = tensor.raw_data or numpy_helper.to_array(tensor).tobytes()
                if len(data) < INLINE_BYTES:
                    continue
                digest = hashlib.sha256(data).digest()
                if digest not in offsets:
                    file.write(bytes(-file.tell() % ALIGNMENT))
                    offsets[digest] = file.tell()
                    file.write(data)
                _refer(tensor, path.name, offsets[digest], len(data))


def _refer(tensor: onnx.TensorProto, location: str, offset: int, length: int) -> None:
    for field in ("raw_data", "float_data", "int32_data", "int64_data", "double_data", "uint64_data"):
        tensor.ClearField(field)
    tensor.data_location = onnx.TensorProto.EXTERNAL
    del tensor.external_data[:]
    for key, value in (("location", location), ("offset", str(offset)), ("length", str(length))):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value
