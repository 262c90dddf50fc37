"""The temporal module: every spatial position attends along time, and to nothing else."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope.errors import GeometryError
from bathyscope_train.model.attention import attend

_ATTENTION_LAYERS = 2


class FramePositions(nn.Module):
    """Adds the sinusoidal table of a frame's place in the window; the table is part of the published checkpoints."""

    pe: Tensor

    def __init__(self, channels: int, frames: int) -> None:
        super().__init__()
        self.register_buffer("pe", sinusoids(frames, channels)[None])

    def forward(self, tokens: Float[Tensor, "n t c"]) -> Float[Tensor, "n t c"]:
        return tokens + self.pe[:, : tokens.shape[1]]


class TimeAttention(nn.Module):
    """Attention along time; the positions enter queries, keys and values alike."""

    def __init__(self, channels: int, heads: int, frames: int) -> None:
        super().__init__()
        self.heads = heads
        self.pos_encoder = FramePositions(channels, frames)
        self.to_q = nn.Linear(channels, channels, bias=False)
        self.to_k = nn.Linear(channels, channels, bias=False)
        self.to_v = nn.Linear(channels, channels, bias=False)
        self.to_out = nn.ModuleList((nn.Linear(channels, channels),))

    def forward(self, tokens: Float[Tensor, "n t c"]) -> Float[Tensor, "n t c"]:
        placed = self.pos_encoder(tokens)
        queries, keys, values = (
            project(placed).unflatten(2, (self.heads, -1)) for project in (self.to_q, self.to_k, self.to_v)
        )
        mixed: Tensor = self.to_out[0](attend(queries, keys, values))
        return mixed


class GatedLinear(nn.Module):
    """GEGLU: one half of the channels times the GELU of the other."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.proj = nn.Linear(channels, 2 * hidden)

    def forward(self, tokens: Float[Tensor, "*n c"]) -> Float[Tensor, "*n d"]:
        values, gates = self.proj(tokens).chunk(2, dim=-1)
        gated: Tensor = values * F.gelu(gates)
        return gated


class FeedForward(nn.Module):
    """Gated linear layer and a linear layer back; ``net.1`` is the place of a dropout that is never active."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.net = nn.Sequential(GatedLinear(channels, 4 * channels), nn.Identity(), nn.Linear(4 * channels, channels))

    def forward(self, tokens: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
        mapped: Tensor = self.net(tokens)
        return mapped


class TimeBlock(nn.Module):
    """Two attentions along time and a feed-forward, each on normed tokens and added to them."""

    def __init__(self, channels: int, heads: int, frames: int) -> None:
        super().__init__()
        self.attention_blocks = nn.ModuleList(TimeAttention(channels, heads, frames) for _ in range(_ATTENTION_LAYERS))
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(_ATTENTION_LAYERS))
        self.ff = FeedForward(channels)
        self.ff_norm = nn.LayerNorm(channels)

    def forward(self, tokens: Float[Tensor, "n t c"]) -> Float[Tensor, "n t c"]:
        for attention, norm in zip(self.attention_blocks, self.norms, strict=True):
            tokens = tokens + attention(norm(tokens))
        result: Tensor = tokens + self.ff(self.ff_norm(tokens))
        return result


class TemporalTransformer(nn.Module):
    """Maps of a window's frames to maps that have seen each other, pixel by pixel.

    The norm's statistics are those of one frame, not of the window.
    """

    def __init__(self, channels: int, *, heads: int, groups: int, frames: int) -> None:
        super().__init__()
        self.frames = frames
        self.norm = nn.GroupNorm(groups, channels, eps=1e-6)
        self.proj_in = nn.Linear(channels, channels)
        self.transformer_blocks = nn.ModuleList((TimeBlock(channels, heads, frames),))
        self.proj_out = nn.Linear(channels, channels)
        nn.init.zeros_(self.proj_out.weight)
        nn.init.zeros_(self.proj_out.bias)

    def forward(self, maps: Float[Tensor, "b t c h w"]) -> Float[Tensor, "b t c h w"]:
        b, t, c, h, w = maps.shape
        normed = self.norm(maps.flatten(0, 1)).unflatten(0, (b, t))
        tokens = normed.permute(0, 3, 4, 1, 2).reshape(b * h * w, t, c)
        tokens = self.proj_in(tokens)
        for block in self.transformer_blocks:
            tokens = block(tokens)
        seen: Tensor = self.proj_out(tokens).reshape(b, h, w, t, c).permute(0, 3, 4, 1, 2)
        return maps + seen


class TemporalModule(nn.Module):
    """One of the head's four; a fresh one is the identity.

    Args:
        channels: Of the maps; a multiple of ``heads`` and of ``groups``.
        heads: Attention heads.
        groups: Groups of the norm.
        frames: Length of the position table.
    """

    def __init__(self, channels: int, *, heads: int = 8, groups: int = 32, frames: int = 32) -> None:
        super().__init__()
        self.temporal_transformer = TemporalTransformer(channels, heads=heads, groups=groups, frames=frames)

    def forward(self, maps: Float[Tensor, "b t c h w"]) -> Float[Tensor, "b t c h w"]:
        """Maps of windows of frames.

        Raises:
            GeometryError: If there are more frames than the position table has rows.
        """
        longest = self.temporal_transformer.frames
        if maps.shape[1] > longest:
            raise GeometryError(f"a window of {maps.shape[1]} frames is longer than the {longest} that were learnt")
        seen: Tensor = self.temporal_transformer(maps)
        return seen


def sinusoids(length: int, channels: int) -> Float[Tensor, "t c"]:
    """table[t, 2k] = sin(t * 10000^(-2k / c)), table[t, 2k + 1] = cos(the same)."""
    places = torch.arange(length, dtype=torch.float64)[:, None]
    rates = 10000.0 ** (-torch.arange(0, channels, 2, dtype=torch.float64) / channels)
    table = torch.zeros(length, channels, dtype=torch.float64)
    table[:, 0::2] = torch.sin(places * rates)
    table[:, 1::2] = torch.cos(places * rates)[:, : channels // 2]
    return table.float()
