"""Which pixels count: inside the picture, and neither burnt out nor a highlight; and where there is a depth to trust.

What counts for the photometric term follows from the frames alone, so that no prediction can change it. Holes are
decided from what was rendered, without gradient; give the losses a set from geometry that is not trained where
leaving the set must not pay (``meets`` of :func:`~bathyscope_train.losses.world.world_consistency_loss`).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

BURNT_OUT = 0.98
"""From here on a channel is clipped: 250 of 255. Tissue's red alone often is, with the others still telling."""
LEAST_OPACITY = 0.3
"""Opacity below which a rendered depth is a hole; the share that the service trusts too."""

_WHITE_ABOVE_LOCAL = 1.5
_WHITE_ABOVE_FLOOR = 0.1
_WHITE_LEAST = 0.35
_GROWTH_SHARE = 0.01
_SURROUNDINGS_SHARE = 0.15


@torch.no_grad()
def photometric_pixels(frames: Float[Tensor, "b t 3 h w"], inside: Bool[Tensor, "b h w"]) -> Bool[Tensor, "b t h w"]:
    """Pixels whose colour a static, matt scene can explain.

    Args:
        frames: RGB in [0, 1].
        inside: Field of view of each clip, see :mod:`bathyscope.vision.field_of_view`.

    Returns:
        Inside the field of view, not over-exposed (two channels clipped), not in a highlight, and not within 1 % of
        the shorter side of either.
    """
    burnt = (frames >= BURNT_OUT).sum(2) >= 2
    radius = max(1, round(_GROWTH_SHARE * min(frames.shape[-2:])))
    return inside[:, None] & ~_grown(burnt | highlights(frames, inside), radius)


@torch.no_grad()
def highlights(frames: Float[Tensor, "b t 3 h w"], inside: Bool[Tensor, "b h w"]) -> Bool[Tensor, "b t h w"]:
    """Specular highlights: whiter than their surroundings.

    The light's own colour shows in the *darkest* channel, which tissue keeps low. A highlight is where that channel
    is at least 0.35, half as much again as its mean over the surroundings (15 % of the shorter side, field of view
    only), and 0.1 above it. A pale surface under even light is none.
    """
    white = frames.amin(2)
    weight = inside[:, None].to(frames.dtype).expand_as(white)
    radius = max(2, round(_SURROUNDINGS_SHARE * min(frames.shape[-2:])))
    local = _box_mean(white * weight, radius) / _box_mean(weight, radius).clamp_min(1e-6)
    above = (white > _WHITE_ABOVE_LOCAL * local) & (white > local + _WHITE_ABOVE_FLOOR)
    return inside[:, None] & above & (white >= _WHITE_LEAST)


@torch.no_grad()
def solid_pixels(
    opacity: Float[Tensor, "b t h w"], inside: Bool[Tensor, "b h w"], *, least: float = LEAST_OPACITY
) -> Bool[Tensor, "b t h w"]:
    """Pixels inside the field of view where Gaussians stop at least a share ``least`` of the light."""
    return inside[:, None] & (opacity >= least)


def _grown(mask: Bool[Tensor, "b t h w"], radius: int) -> Bool[Tensor, "b t h w"]:
    return F.max_pool2d(mask.float(), 2 * radius + 1, stride=1, padding=radius) > 0


def _box_mean(maps: Float[Tensor, "b t h w"], radius: int) -> Float[Tensor, "b t h w"]:
    """Mean over the box around each pixel; beyond the frame counts as 0, the same for every map."""
    for axis in (-1, -2):
        size = maps.shape[axis]
        padding = (1, 0) if axis == -1 else (0, 0, 1, 0)
        total = F.pad(maps.cumsum(axis), padding)
        centre = torch.arange(size, device=maps.device)
        low, high = (centre - radius).clamp_min(0), (centre + radius + 1).clamp_max(size)
        maps = (total.index_select(axis, high) - total.index_select(axis, low)) / (2 * radius + 1)
    return maps
