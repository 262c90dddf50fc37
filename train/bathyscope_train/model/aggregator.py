"""Alternating attention: every frame by itself, then the whole clip, again and again."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.blocks import Block
from bathyscope_train.model.presets import ConvStemSettings, NetworkPreset
from bathyscope_train.model.rope import grid_positions, rope_tables
from bathyscope_train.model.stem import ConvStem, EncodedStem
from bathyscope_train.model.vit import VisionTransformer

_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)


class Aggregation(NamedTuple):
    """What leaves the aggregator."""

    layers: Mapping[int, Float[Tensor, "b t p c2"]]
    """Tokens after the wanted pairs: frame and global output side by side; camera token, registers, patches."""
    stem_maps: tuple[Float[Tensor, "b t c h w"], ...]
    """Maps of an image stem that keeps some for the heads; none for the ViT."""


class Aggregator(nn.Module):
    """Image encoder, special tokens and pairs of a frame block and a global block.

    Slot 0 of the special tokens belongs to the first frame of a clip, slot 1 to all others: the only thing
    that tells frames apart. Keeps the layers in ``wanted`` and no others.
    """

    def __init__(self, preset: NetworkPreset) -> None:
        super().__init__()
        settings = preset.aggregator
        self.patch_size = preset.patch_size
        self.head_dim = settings.width // settings.heads
        self.rope_base = settings.rope_base
        self.special = 1 + settings.registers
        self.wanted = frozenset((*settings.taps, settings.depth - 1))
        self.patch_embed = build_stem(preset)
        self.camera_token = nn.Parameter(torch.randn(1, 2, 1, settings.width) * 1e-6)
        self.register_token = nn.Parameter(torch.randn(1, 2, settings.registers, settings.width) * 1e-6)
        self.frame_blocks = nn.ModuleList(_block(preset) for _ in range(settings.depth))
        self.global_blocks = nn.ModuleList(_block(preset) for _ in range(settings.depth))

    def special_tokens(self, clips: int, frames: int) -> Float[Tensor, "b t s c"]:
        """Camera token and registers of every frame."""
        slots = torch.cat((self.camera_token, self.register_token), dim=2)
        slot = (torch.arange(frames, device=slots.device) > 0).long()
        return slots[:, slot].expand(clips, -1, -1, -1)

    def forward(self, images: Float[Tensor, "b t 3 h w"]) -> Aggregation:
        """Tokens of the wanted layers for clips of images in [0, 1] whose sides are multiples of the patch size."""
        b, t, _, height, width = images.shape
        patches, maps = self._encode(images)
        tokens = torch.cat((self.special_tokens(b, t).to(patches.dtype), patches), dim=2)
        p, c = tokens.shape[2:]

        positions = grid_positions(
            height // self.patch_size, width // self.patch_size, self.special, device=images.device
        )
        within_frame = rope_tables(positions, self.head_dim, base=self.rope_base)
        across_frames = within_frame.repeat(t)

        layers: dict[int, Tensor] = {}
        for index, (frame_block, global_block) in enumerate(zip(self.frame_blocks, self.global_blocks, strict=True)):
            by_frame = frame_block(tokens.reshape(b * t, p, c), within_frame).reshape(b, t, p, c)
            tokens = global_block(by_frame.reshape(b, t * p, c), across_frames).reshape(b, t, p, c)
            if index in self.wanted:
                layers[index] = torch.cat((by_frame, tokens), dim=-1)
        return Aggregation(layers, maps)

    def _encode(self, images: Float[Tensor, "b t 3 h w"]) -> tuple[Tensor, tuple[Tensor, ...]]:
        b, t = images.shape[:2]
        mean = images.new_tensor(_MEAN)[:, None, None]
        std = images.new_tensor(_STD)[:, None, None]
        encoded = self.patch_embed(((images - mean) / std).flatten(0, 1))
        patches, maps = (encoded, ()) if isinstance(encoded, Tensor) else encoded
        return patches.unflatten(0, (b, t)), tuple(each.unflatten(0, (b, t)) for each in maps)


def build_stem(preset: NetworkPreset) -> nn.Module:
    """The image encoder that ``preset.stem`` asks for.

    It maps normalised images (n, 3, h, w) to patch tokens (n, hw, c), or to those and a tuple of maps (n, k, h', w')
    that the heads may read.
    """
    stem, settings = preset.stem, preset.aggregator
    if isinstance(stem, ConvStemSettings):
        kind = ConvStem if stem.encoder is None else EncodedStem
        return kind(settings.width, channels=stem.channels, patch_size=preset.patch_size)
    return VisionTransformer(
        width=settings.width,
        depth=stem.depth,
        heads=stem.heads,
        patch_size=preset.patch_size,
        grid=stem.grid,
        registers=stem.registers,
        mlp_ratio=settings.mlp_ratio,
        layer_scale=stem.layer_scale,
    )


def _block(preset: NetworkPreset) -> Block:
    settings = preset.aggregator
    return Block(
        settings.width,
        settings.heads,
        mlp_ratio=settings.mlp_ratio,
        normalise_heads=True,
        layer_scale=settings.layer_scale,
    )
