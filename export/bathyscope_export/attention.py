"""Static check that attention stays linear in memory: fused nodes only, and no tensor of shape (..., S, S).

Stock ONNX Runtime runs ``com.microsoft.MultiHeadAttention`` as flash attention only when it is given queries, keys
and values alone; a mask or a bias, and any decomposed softmax, bring back the square of the number of tokens.
"""

import onnx

from bathyscope.bundle import Role
from bathyscope.errors import BundleError

FUSED = "MultiHeadAttention"
FUSED_DOMAIN = "com.microsoft"

MOST_UNKNOWN = 0.05
"""Share of values that may lack a shape."""


def check_linear_attention(model: onnx.ModelProto, role: Role) -> None:
    """Refuse a graph that materialises attention weights.

    Args:
        model: A traced graph, with the shapes of its values (symbolic where dynamic).
        role: Named in the error.

    Raises:
        BundleError: If a fused node has more than queries, keys and values, a value has two equal dynamic last axes,
            or too few shapes are known to tell.
    """
    for node in model.graph.node:
        if node.op_type == FUSED and len([name for name in node.input if name]) != 3:
            raise BundleError(f"{role}: {FUSED} reads {list(node.input)}; a mask or bias makes it quadratic")
    unknown = unknown_share(model)
    if unknown > MOST_UNKNOWN:
        raise BundleError(f"{role}: {unknown:.0%} of the values have no known shape; the check needs shape inference")
    squares = square_values(model)
    if squares:
        raise BundleError(f"{role}: {squares[0]} has shape (..., S, S); attention must go through one fused node")


def unknown_share(model: onnx.ModelProto) -> float:
    """Share of the nodes' outputs whose shape the graph does not tell."""
    values = (*model.graph.value_info, *model.graph.output)
    told = {value.name for value in values if value.type.tensor_type.HasField("shape")}
    made = [name for node in model.graph.node for name in node.output if name]
    return sum(name not in told for name in made) / max(len(made), 1)


def square_values(model: onnx.ModelProto) -> list[str]:
    """Names of values whose last two axes are dynamic and equal."""
    values = [*model.graph.value_info, *model.graph.input, *model.graph.output]
    return [value.name for value in values if _is_square(value)]


def fused_count(model: onnx.ModelProto) -> int:
    """Number of fused attention nodes."""
    return sum(node.op_type == FUSED and node.domain == FUSED_DOMAIN for node in model.graph.node)


def _is_square(value: onnx.ValueInfoProto) -> bool:
    last = [dimension.dim_param for dimension in value.type.tensor_type.shape.dim][-2:]
    return len(last) == 2 and last[0] != "" and last[0] == last[1]
