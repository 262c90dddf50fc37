"""The learnt position table of the DINOv2 transformer, resized by a factor.

Depth Anything and its descendants resample the table bicubically by the *factor* ``(patches + 0.1) / grid``: the factor
itself sets the sampling positions, not the ratio of the two sizes. The two passes are matrix products, so that a graph
exports with sizes known only at run time.
"""

import torch
from jaxtyping import Float
from torch import Tensor

_OFFSET = 0.1


def resized_positions(table: Float[Tensor, "1 p c"], grid: int, size: tuple[int, int]) -> Float[Tensor, "1 p2 c"]:
    """Position embedding (class token, then patches row by row) for ``size`` (rows, columns) of patches.

    Args:
        table: Learnt table of a square grid, class token first.
        grid: Side of that grid.
        size: Patches needed; its own grid stays as it is. That is no branch here, so that a graph exports with both.
    """
    rows, columns = size
    square = table[:, 1:].float().unflatten(1, (grid, grid)).permute(0, 3, 1, 2)
    own = (torch.full((), rows, device=square.device) == grid) & (torch.full((), columns, device=square.device) == grid)
    down = torch.where(own, _unchanged(grid, rows, square), _bicubic_by_factor(grid, rows, square))
    across = torch.where(own, _unchanged(grid, columns, square), _bicubic_by_factor(grid, columns, square))
    resized = (down @ square @ across.transpose(0, 1)).flatten(2).transpose(1, 2)
    return torch.cat((table[:, :1], resized.to(table.dtype)), dim=1)


def _unchanged(source: int, target: int, like: Tensor) -> Float[Tensor, "target source"]:
    """Weights that take every sample as it is: the identity, where both sizes are the same."""
    same = torch.arange(target, device=like.device)[:, None] == torch.arange(source, device=like.device)
    return same.to(like.dtype)


def _bicubic_by_factor(source: int, target: int, like: Tensor) -> Float[Tensor, "target source"]:
    """Weights of the samples at ``(i + 0.5) / factor - 0.5``, borders repeated.

    PyTorch's kernel holds the step and the position in float32 and multiplies without rounding in between; the table's
    values change by 1e-5 where this does not.
    """
    wanted = torch.full((), target, device=like.device, dtype=torch.float64)
    step = (source / (wanted + _OFFSET)).float().double()
    places = torch.arange(target, device=like.device, dtype=torch.float64) + 0.5
    positions = (places * step - 0.5).float().double()
    first = positions.floor()
    columns = torch.arange(source, device=like.device, dtype=torch.float64)
    weights = torch.zeros(target, source, device=like.device, dtype=torch.float64)
    for tap in (-1, 0, 1, 2):
        index = (first + tap).clamp(0, source - 1)
        value = _cubic(positions - (first + tap))[:, None]
        weights = weights + torch.where(columns == index[:, None], value, torch.zeros_like(value))
    return weights.to(like.dtype)


def _cubic(x: Tensor) -> Tensor:
    """Keys' kernel with a = -3/4, as PyTorch and OpenCV use it without antialiasing."""
    x = x.abs()
    near = (1.25 * x - 2.25) * x * x + 1.0
    far = ((-0.75 * x + 3.75) * x - 6.0) * x + 3.0
    return torch.where(x <= 1, near, torch.where(x < 2, far, torch.zeros_like(x)))
