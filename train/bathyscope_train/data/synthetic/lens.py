r"""Radial distortion of a lens, both ways.

With undistorted normalised coordinates :math:`x_u = (X / Z, Y / Z)` and :math:`r_u = |x_u|` the picture shows the
point at :math:`x_d = x_u (1 + k_1 r_u^2 + k_2 r_u^4)`, in pixels :math:`f x_d + c`: OpenCV's first two numbers.
:math:`k_2 > 0.45\,k_1^2` keeps the map invertible for every ray in front of the camera.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bathyscope.errors import GeometryError
from bathyscope_train.data.synthetic.compiled import jit
from bathyscope_train.data.synthetic.domain import CameraRanges, draw

Array = npt.NDArray[np.float64]

_ROUNDS = 30
_CLOSE = 1e-13


class Distortion(NamedTuple):
    """Radial distortion; both 0 is a pinhole."""

    k1: float = 0.0
    k2: float = 0.0


PINHOLE = Distortion()


def draw_distortion(random: np.random.Generator, ranges: CameraRanges, reach: float) -> Distortion:
    """Draw a lens.

    Args:
        random: Source of three numbers, whatever the ranges.
        ranges: ``distorted`` lenses have ``bend`` at the corner and ``bend_ratio`` = k2 / k1^2.
        reach: Distance of the image's corner from its centre, in focal lengths.
    """
    distorted, bend, ratio = random.uniform(), draw(random, ranges.bend), draw(random, ranges.bend_ratio)
    k1 = bend / reach**2 if distorted < ranges.distorted else 0.0
    return Distortion(k1, ratio * k1 * k1)


def distort(points: Array, k: tuple[float, float]) -> Array:
    """Where the lens shows normalised points.

    Args:
        points: ``(..., 2)``: x / z, y / z.
        k: k1 and k2.

    Returns:
        ``(..., 2)``, to be multiplied by the focal length.
    """
    square = (points**2).sum(-1, keepdims=True)
    return np.asarray(points * (1.0 + square * (k[0] + k[1] * square)))


def undistort(points: Array, k: tuple[float, float]) -> Array:
    """The inverse of ``distort``, to the last digits, by Newton's iteration on the radius.

    Args:
        points: ``(..., 2)``: (pixel - principal point) / focal length.
        k: k1 and k2.

    Raises:
        GeometryError: If the lens shows a point nowhere: the map folds back before it.
    """
    radius = np.sqrt((points**2).sum(-1, keepdims=True))
    bare = radius.copy()
    for _ in range(_ROUNDS):
        square = bare * bare
        bare -= (bare * (1 + square * (k[0] + k[1] * square)) - radius) / (1 + square * (3 * k[0] + 5 * k[1] * square))
    square = bare * bare
    missed = ~(np.abs(bare * (1 + square * (k[0] + k[1] * square)) - radius) < 1e-9 * (1 + radius)) | (bare < 0)
    if missed.any():
        raise GeometryError(
            f"distortion {tuple(k)} folds back before a radius of {radius[missed].min():.3g} focal lengths; "
            "k2 > 0.45 * k1**2 keeps it invertible"
        )
    return np.asarray(points * np.where(radius > 0, bare / np.where(radius > 0, radius, 1.0), 1.0))


@jit
def unbend(a: float, b: float, k1: float, k2: float) -> tuple[float, float]:
    """``undistort`` of one point for the kernels; a pinhole passes it through untouched."""
    if k1 == 0.0 and k2 == 0.0:
        return a, b
    radius = np.sqrt(a * a + b * b)
    bare = radius
    for _ in range(_ROUNDS):
        square = bare * bare
        step = (bare * (1.0 + square * (k1 + k2 * square)) - radius) / (1.0 + square * (3.0 * k1 + 5.0 * k2 * square))
        bare -= step
        if abs(step) < _CLOSE:
            break
    share = bare / radius if radius > 1e-12 else 1.0
    return a * share, b * share
