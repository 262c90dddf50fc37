"""Weights stored with half the bits: bfloat16 in the file, float32 in the computation.

A runtime casts them once, when it loads the graph. The network is rounded before it is traced, so the graphs still
agree with PyTorch to float32's precision; what the rounding itself costs is for the evaluation to say.
"""

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from bathyscope_export.weights import INLINE_BYTES

_SUFFIX = ".bfloat16"


def halve_weights(model: onnx.ModelProto) -> None:
    """Store every large float32 tensor of a graph that bfloat16 holds exactly as such, with a cast behind it."""
    casts = []
    for tensor in model.graph.initializer:
        if tensor.data_type != TensorProto.FLOAT:
            continue
        values = numpy_helper.to_array(tensor)
        if values.nbytes < INLINE_BYTES or not _is_exact(values):
            continue
        name = tensor.name
        tensor.CopyFrom(_half(values, name + _SUFFIX))
        casts.append(helper.make_node("Cast", [name + _SUFFIX], [name], to=TensorProto.FLOAT))
    for cast in reversed(casts):
        model.graph.node.insert(0, cast)


def _bits(values: NDArray[np.float32]) -> NDArray[np.uint32]:
    return np.ascontiguousarray(values, "<f4").view("<u4")


def _is_exact(values: NDArray[np.float32]) -> bool:
    """Whether bfloat16, which is float32 without its lower 16 bits, loses nothing."""
    return not bool((_bits(values) & 0xFFFF).any())


def _half(values: NDArray[np.float32], name: str) -> TensorProto:
    upper = (_bits(values) >> 16).astype("<u2")
    return TensorProto(name=name, data_type=TensorProto.BFLOAT16, dims=values.shape, raw_data=upper.tobytes())
