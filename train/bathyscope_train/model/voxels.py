"""Voxel fusion: Gaussians that share a cell of space become one, weighted by their confidence."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

PADDED_POSITION = -1e4
"""Coordinates of the filling of a shorter scene of a batch."""
PADDED_FEATURE = -1e10
"""Raw features of the filling: they activate to opacity 0 and scale 0."""


@dataclass(frozen=True, slots=True)
class Fused:
    """Occupied voxels of one scene, sorted by (x, y, z) index."""

    points: Float[Tensor, "v 3"]
    features: Float[Tensor, "v g"]
    index: Int[Tensor, "v 3"]
    """Cell of each voxel: round(point / voxel_size), halves to even."""
    counts: Int[Tensor, " v"]
    """Points that fell into each voxel."""


def fuse_voxels(
    points: Float[Tensor, "n 3"],
    features: Float[Tensor, "n g"],
    confidence: Float[Tensor, " n"],
    *,
    voxel_size: float,
) -> Fused:
    """Average points and raw features (before any activation) within each cell.

    The weights are a softmax of ``confidence`` within the cell, with 1e-6 added to its denominator as published.
    """
    cells = (points / voxel_size).round().long()
    index, owner, counts = torch.unique(cells, dim=0, return_inverse=True, return_counts=True)
    voxels = index.shape[0]
    highest = confidence.new_full((voxels,), -torch.inf).scatter_reduce(0, owner, confidence, reduce="amax")
    weights = (confidence - highest[owner]).exp()
    totals = weights.new_zeros(voxels).index_add(0, owner, weights)
    weights = weights / (totals[owner] + 1e-6)
    return Fused(
        points=points.new_zeros(voxels, 3).index_add(0, owner, points * weights[:, None]),
        features=features.new_zeros(voxels, features.shape[1]).index_add(0, owner, features * weights[:, None]),
        index=index,
        counts=counts,
    )


def fuse_batch(
    points: Float[Tensor, "b n 3"],
    features: Float[Tensor, "b n g"],
    confidence: Float[Tensor, "b n"],
    *,
    voxel_size: float,
) -> tuple[Float[Tensor, "b v 3"], Float[Tensor, "b v g"]]:
    """Fuse every scene of a batch; shorter ones are filled up with Gaussians that show nothing."""
    scenes = [fuse_voxels(*scene, voxel_size=voxel_size) for scene in zip(points, features, confidence, strict=True)]
    return (
        torch.nn.utils.rnn.pad_sequence([scene.points for scene in scenes], True, PADDED_POSITION),
        torch.nn.utils.rnn.pad_sequence([scene.features for scene in scenes], True, PADDED_FEATURE),
    )
