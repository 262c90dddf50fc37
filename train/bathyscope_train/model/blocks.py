"""The pre-norm transformer block that the image encoder, the aggregator and the camera head share."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.attention import SelfAttention
from bathyscope_train.model.rope import RopeTables


class LayerScale(nn.Module):
    """A learnt factor for each channel of a residual branch."""

    def __init__(self, width: int, initial: float) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.full((width,), initial))

    def forward(self, tokens: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
        return tokens * self.gamma


class Mlp(nn.Module):
    """Two linear layers with an exact (erf) GELU between them."""

    def __init__(self, width: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.act = nn.GELU()
        self.fc2 = nn.Linear(hidden, outputs)

    def forward(self, tokens: Float[Tensor, "*n c"]) -> Float[Tensor, "*n o"]:
        mapped: Tensor = self.fc2(self.act(self.fc1(tokens)))
        return mapped


class Block(nn.Module):
    """x + scale1 * attention(norm1(x)), then x + scale2 * mlp(norm2(x)).

    Args:
        width: Channels of a token.
        heads: Attention heads.
        mlp_ratio: Hidden width of the MLP over ``width``.
        epsilon: Of both LayerNorms: 1e-6 in the DINOv2 encoder, 1e-5 everywhere else.
        normalise_heads: LayerNorm on queries and keys (aggregator only).
        layer_scale: Initial factor of the residual branches.
    """

    def __init__(
        self,
        width: int,
        heads: int,
        *,
        mlp_ratio: int = 4,
        epsilon: float = 1e-5,
        normalise_heads: bool = False,
        layer_scale: float = 0.01,
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=epsilon)
        self.attn = SelfAttention(width, heads, normalise_heads=normalise_heads)
        self.ls1 = LayerScale(width, layer_scale)
        self.norm2 = nn.LayerNorm(width, eps=epsilon)
        self.mlp = Mlp(width, mlp_ratio * width, width)
        self.ls2 = LayerScale(width, layer_scale)

    def forward(self, tokens: Float[Tensor, "b n c"], rope: RopeTables | None = None) -> Float[Tensor, "b n c"]:
        tokens = tokens + self.ls1(self.attn(self.norm1(tokens), rope))
        result: Tensor = tokens + self.ls2(self.mlp(self.norm2(tokens)))
        return result
