"""Real spherical harmonics up to degree 4, and how their coefficients turn with the world.

Order k = l^2 + l + m; the signs are those of 3-D Gaussian splatting (degree 1: -y, +z, -x).
"""

from functools import lru_cache
from math import isqrt, sqrt

import torch
from jaxtyping import Float
from torch import Tensor


def evaluate_harmonics(directions: Float[Tensor, "*b 3"], degree: int) -> Float[Tensor, "*b k"]:
    """Values of the (degree + 1)^2 basis functions in unit ``directions``."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    by_degree = (
        (torch.full_like(x, 0.28209479177387814),),
        (-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x),
        (
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ),
        (
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ),
        (
            2.5033429417967046 * x * y * (xx - yy),
            -1.7701307697799304 * y * z * (3 * xx - yy),
            0.9461746957575601 * x * y * (7 * zz - 1),
            -0.6690465435572892 * y * z * (7 * zz - 3),
            0.10578554691520431 * (zz * (35 * zz - 30) + 3),
            -0.6690465435572892 * x * z * (7 * zz - 3),
            0.47308734787878004 * (xx - yy) * (7 * zz - 1),
            -1.7701307697799304 * x * z * (xx - 3 * yy),
            0.6258357354491761 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ),
    )
    return torch.stack([value for values in by_degree[: degree + 1] for value in values], dim=-1)


def rotate_harmonics(
    coefficients: Float[Tensor, "*b k c"], rotation: Float[Tensor, "*b 3 3"]
) -> Float[Tensor, "*b k c"]:
    """Coefficients of the turned function: its value in direction ``rotation @ d`` is the old value in ``d``.

    Degrees do not mix. With Y_l evaluated in fixed, well spread directions d, the matrix of one degree is
    pinv(Y_l(d)) Y_l(rotation^T d).
    """
    degree = isqrt(coefficients.shape[-2]) - 1
    if degree == 0:
        return coefficients
    directions = _directions().to(coefficients)
    source = directions @ rotation  # rows are rotation^T d
    turned, fixed = evaluate_harmonics(source, degree), evaluate_harmonics(directions, degree)
    bands = [coefficients[..., :1, :]]
    for band in range(1, degree + 1):
        span = slice(band * band, (band + 1) * (band + 1))
        matrix = torch.linalg.pinv(fixed[:, span]) @ turned[..., span]
        bands.append(matrix @ coefficients[..., span, :])
    return torch.cat(bands, dim=-2)


@lru_cache(maxsize=1)
def _directions(count: int = 48) -> Tensor:
    """A spiral of nearly even directions: many more than the 9 functions of the highest degree."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    height = 1 - 2 * index / count
    angle = index * torch.pi * (3 - sqrt(5))
    radius = (1 - height * height).sqrt()
    return torch.stack((radius * angle.cos(), radius * angle.sin(), height), dim=-1)
