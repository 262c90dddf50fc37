"""Multi-head self-attention: the one place where queries meet keys.

Every block of every preset calls :func:`attend`. Eager code runs PyTorch's fused kernel; inside
:func:`fused_for_onnx` the same call becomes one ``com.microsoft.MultiHeadAttention`` node, whose memory on
stock ONNX Runtime is linear in the number of tokens (the decomposed pattern materialises it several times
over the square).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.rope import RopeTables, rotate

_fused_for_onnx: ContextVar[bool] = ContextVar("fused_for_onnx", default=False)


@contextmanager
def fused_for_onnx() -> Iterator[None]:
    """Within this context :func:`attend` traces to one fused ONNX node instead of running PyTorch's kernel."""
    token = _fused_for_onnx.set(True)
    try:
        yield
    finally:
        _fused_for_onnx.reset(token)


def attend(
    queries: Float[Tensor, "b n heads d"], keys: Float[Tensor, "b n heads d"], values: Float[Tensor, "b n heads d"]
) -> Float[Tensor, "b n c"]:
    """Softmax attention of every token to every token, scaled by 1/sqrt(d); heads are concatenated (c = heads * d).

    No mask and no bias: either would send ONNX Runtime's kernel onto its quadratic path.
    """
    b, n, heads, d = queries.shape
    if _fused_for_onnx.get():
        fused: Tensor = torch.onnx.ops.symbolic(
            "com.microsoft::MultiHeadAttention",
            (queries.reshape(b, n, heads * d), keys.reshape(b, n, heads * d), values.reshape(b, n, heads * d)),
            attrs={"num_heads": heads},
            dtype=queries.dtype,
            shape=(b, n, heads * d),
            version=1,
        )
        return fused
    mixed = F.scaled_dot_product_attention(queries.transpose(1, 2), keys.transpose(1, 2), values.transpose(1, 2))
    return mixed.transpose(1, 2).reshape(b, n, heads * d)


class SelfAttention(nn.Module):
    """Self-attention with a joint projection; optional per-head LayerNorm and rotary positions on queries and keys.

    Args:
        width: Channels of a token.
        heads: Number of heads; divides ``width``.
        normalise_heads: LayerNorm (eps 1e-5, shared by all heads) on queries and keys, before the rotation.
    """

    def __init__(self, width: int, heads: int, *, normalise_heads: bool = False) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.q_norm: nn.Module = nn.LayerNorm(width // heads, eps=1e-5) if normalise_heads else nn.Identity()
        self.k_norm: nn.Module = nn.LayerNorm(width // heads, eps=1e-5) if normalise_heads else nn.Identity()
        self.proj = nn.Linear(width, width)

    def forward(self, tokens: Float[Tensor, "b n c"], rope: RopeTables | None = None) -> Float[Tensor, "b n c"]:
        b, n, c = tokens.shape
        queries, keys, values = self.qkv(tokens).reshape(b, n, 3, self.heads, c // self.heads).unbind(2)
        queries, keys = self.q_norm(queries), self.k_norm(keys)
        if rope is not None:
            queries, keys = rotate(queries, rope), rotate(keys, rope)
        mixed: Tensor = self.proj(attend(queries, keys, values))
        return mixed
