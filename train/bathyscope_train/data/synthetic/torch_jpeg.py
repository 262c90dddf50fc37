"""What JPEG does to pictures, in torch: chroma at half size, blocks of cosines, rounding to the quality's steps.

Agrees with libjpeg (4:2:0, accurate cosine transform, smooth chroma) to less than a level in the mean.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.data.synthetic.torch_filters import sampling_matrix

_LUMA_STEPS = np.array(  # ITU-T T.81, tables K.1 and K.2: steps at quality 50
    [
        [16, 11, 10, 16, 24, 40, 51, 61],
        [12, 12, 14, 19, 26, 58, 60, 55],
        [14, 13, 16, 24, 40, 57, 69, 56],
        [14, 17, 22, 29, 51, 87, 80, 62],
        [18, 22, 37, 56, 68, 109, 103, 77],
        [24, 35, 55, 64, 81, 104, 113, 92],
        [49, 64, 78, 87, 103, 121, 120, 101],
        [72, 92, 95, 98, 112, 100, 103, 99],
    ]
)
_CHROMA_STEPS = np.full((8, 8), 99)
_CHROMA_STEPS[:4, :4] = [[17, 18, 24, 47], [18, 21, 26, 66], [24, 26, 56, 99], [47, 66, 99, 99]]

_YCC = np.array([[0.299, 0.587, 0.114], [-0.168735892, -0.331264108, 0.5], [0.5, -0.418687589, -0.081312411]])
_BLOCK = 16  # two blocks of luma, one of chroma


def compress(images: Float[Tensor, "b t 3 h w"], qualities: Sequence[int]) -> Float[Tensor, "b t 3 h w"]:
    """Code and decode images of levels 0 to 255, each clip with its own quality (1 to 100).

    Returns:
        Whole levels.
    """
    height, width = images.shape[-2:]
    flat = images.flatten(0, 1)
    ycc = torch.einsum("ij,bjhw->bihw", _like(images, _YCC), flat).round()
    padded = F.pad(ycc, (0, -width % _BLOCK, 0, -height % _BLOCK), mode="replicate")
    scales = [5000 // quality if quality < 50 else 200 - 2 * quality for quality in qualities]
    luma = _quantised(padded[:, 0] - 128, _steps(images, _LUMA_STEPS, scales))
    halves = F.avg_pool2d(padded[:, 1:], 2).round()
    chroma = _quantised(halves, _steps(images, _CHROMA_STEPS, scales)[:, None])
    luma = (luma[..., :height, :width] + 128).round().clamp(0, 255)
    chroma = _doubled(chroma.round().clamp(-128, 127)[..., : (height + 1) // 2, : (width + 1) // 2], height, width)
    back = _like(images, np.linalg.inv(_YCC))
    rgb = luma[:, None] + torch.einsum("ij,bjhw->bihw", back[:, 1:], chroma.round())
    return rgb.round().clamp(0, 255).view_as(images)


def _like(images: Tensor, values: npt.NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(values).to(images)


def _steps(images: Tensor, table: npt.NDArray[np.int64], scales: Sequence[int]) -> Float[Tensor, "b 1 8 1 8"]:
    """The coder's steps for every frame."""
    steps = np.stack([np.clip((table * scale + 50) // 100, 1, 255) for scale in scales])
    return _like(images, steps.astype(np.float64)).repeat_interleave(images.shape[1], 0)[:, None, :, None, :]


def _quantised(plane: Float[Tensor, "b ... h w"], steps: Tensor) -> Tensor:
    """A plane through the cosine transform of its blocks and back."""
    k = np.arange(8)
    cosine = np.cos(np.pi * (2 * k + 1) * k[:, None] / 16) * np.where(k[:, None] == 0, np.sqrt(1 / 8), 0.5)
    transform = _like(plane, cosine)
    blocks = plane.unflatten(-1, (-1, 8)).unflatten(-3, (-1, 8))
    waves = torch.einsum("ip,...hpwq,jq->...hiwj", transform, blocks, transform)
    waves = (waves / steps).round() * steps
    blocks = torch.einsum("ip,...hiwj,jq->...hpwq", transform, waves, transform)
    return blocks.flatten(-2).flatten(-3, -2)


def _doubled(chroma: Float[Tensor, "b 2 p q"], height: int, width: int) -> Float[Tensor, "b 2 h w"]:
    """Twice the size, by weights of three quarters and one quarter."""
    rows, columns = (
        _like(chroma, sampling_matrix((np.arange(wanted) + 0.5) / 2 - 0.5, size))
        for wanted, size in zip((height, width), chroma.shape[-2:], strict=True)
    )
    return rows @ chroma @ columns.T
