"""Rendered clips in memory, as tensors."""

from pathlib import Path

import numpy as np
import torch

from bathyscope_train.data.synthetic.clip import SyntheticClip
from bathyscope_train.data.synthetic.shards import clip_paths, read_clip
from bathyscope_train.data.windows import TruthClip


def truth_clip(clip: SyntheticClip) -> TruthClip:
    """A rendered clip as tensors; depth keeps its unit. Where the tissue itself moves, all of it counts as moving."""
    moving = np.ones_like(clip.moving) if clip.swell is not None else clip.moving
    return TruthClip(
        frames=torch.from_numpy(clip.frames).permute(0, 3, 1, 2).contiguous(),
        depth=torch.from_numpy(clip.depth * clip.valid).float(),
        world_from_camera=torch.from_numpy(clip.world_from_camera).float(),
        focal=float(clip.intrinsics[0, 0]),
        name=clip.name,
        moving=torch.from_numpy(moving) if moving.any() else None,
        distortion=(clip.distortion.k1, clip.distortion.k2),
    )


def read_truth_clips(folder: Path, *, limit: int | None = None) -> list[TruthClip]:
    """The clips of a folder, the first ``limit`` of them.

    Raises:
        DatasetError: If there are none, or one cannot be read.
    """
    return [truth_clip(read_clip(path)) for path in clip_paths(folder)[:limit]]
