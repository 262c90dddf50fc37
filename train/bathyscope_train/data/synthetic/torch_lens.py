"""Radial distortion in torch; see ``lens`` for the model and its limits."""

from jaxtyping import Float
from torch import Tensor

_ROUNDS = 10  # Newton's iteration doubles the digits: 10 rounds are enough for every lens that can be inverted


def distort(points: Float[Tensor, "2 s n"], k: Float[Tensor, "2 s 1"]) -> Float[Tensor, "2 s n"]:
    """Where lenses show normalised points x / z and y / z, to be multiplied by the focal length."""
    square = points.square().sum(0)
    return points * (1 + square * (k[0] + k[1] * square))


def undistort(points: Float[Tensor, "2 s n"], k: Float[Tensor, "2 s 1"]) -> Float[Tensor, "2 s n"]:
    """The inverse of :func:`distort`."""
    radius = points.square().sum(0).sqrt()
    bare = radius
    for _ in range(_ROUNDS):
        square = bare.square()
        excess = bare * (1 + square * (k[0] + k[1] * square)) - radius
        bare = bare - excess / (1 + square * (3 * k[0] + 5 * k[1] * square))
    return points * bare / radius.clamp_min(1e-12)
