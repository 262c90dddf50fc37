"""Antialiased bicubic resizing as two matrix products.

Same values as Pillow and ``F.interpolate(mode="bicubic", antialias=True, align_corners=False)``. ONNX's ``Resize`` is
exported with another cubic coefficient for that call; matrix products export exactly, for sizes known only
at run time.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def resize_bicubic_antialiased(maps: Float[Tensor, "n c h w"], size: tuple[int, int]) -> Float[Tensor, "n c h2 w2"]:
    """Resize ``maps`` to ``size`` (height, width)."""
    rows = _weights(maps.shape[-2], size[0], maps)
    columns = _weights(maps.shape[-1], size[1], maps)
    return rows @ maps @ columns.transpose(0, 1)


def _weights(source: int, target: int, like: Tensor) -> Float[Tensor, "target source"]:
    centers = torch.arange(target, device=like.device, dtype=like.dtype) + 0.5
    scale = source / torch.full((), target, device=like.device, dtype=like.dtype)
    taps = torch.arange(source, device=like.device, dtype=like.dtype) + 0.5
    weights = _cubic((taps - centers[:, None] * scale) / scale.clamp_min(1.0))
    return weights / weights.sum(1, keepdim=True)


def _cubic(x: Tensor) -> Tensor:
    """Keys' kernel with a = -1/2, as Pillow and PyTorch use it when antialiasing."""
    x = x.abs()
    near = (1.5 * x - 2.5) * x * x + 1.0
    far = ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0
    return torch.where(x < 1, near, torch.where(x < 2, far, torch.zeros_like(x)))
