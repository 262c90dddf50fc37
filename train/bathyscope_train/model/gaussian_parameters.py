"""Raw channels of a Gaussian head to the parameters of Gaussians.

The channels are ``[opacity | 3 scale | 4 rotation | 3 x (L+1)^2 colour]``; the fusion confidence that follows
them is read before (:mod:`~bathyscope_train.model.voxels`). Two meanings exist, and a preset names its own:

``anysplat``
    scale is 0.001 softplus(raw), at most 0.3 world units, whatever the depth; the rotation (x, y, z, w) and the
    harmonics are given in the world's axes.
``footprint``
    scale is softplus(raw), at most 8, times the size of the pixel at its depth, z / f; the rotation, added to the
    unit quaternion (w, x, y, z), and the harmonics are given in the camera's axes; the constant colour is that of
    the pixel plus the raw value. All zeros is thus a round Gaussian of 0.69 pixels in the pixel's own colour.
"""

from dataclasses import dataclass, replace
from math import isqrt

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.model.harmonics import rotate_harmonics
from bathyscope_train.model.quaternions import multiply, quaternion_from_rotation

CONSTANT_HARMONIC = 0.28209479177387814
"""Value of the spherical harmonic of degree 0."""

LARGEST_FOOTPRINT = 8.0
"""Largest standard deviation of a ``footprint`` Gaussian, in pixels."""


@dataclass(frozen=True, slots=True)
class GaussianBatch:
    """Gaussians of b scenes of equal size n; k = (L+1)^2 harmonics."""

    means: Float[Tensor, "b n 3"]
    rotations: Float[Tensor, "b n 4"]
    """Quaternions (w, x, y, z); unit length, but for raw values near zero."""
    scales: Float[Tensor, "b n 3"]
    """Standard deviations, world units."""
    opacities: Float[Tensor, "b n"]
    harmonics: Float[Tensor, "b n k 3"]
    """Coefficients for each colour; the first is the constant term."""

    def moved(self, motion: Float[Tensor, "b 4 4"]) -> "GaussianBatch":
        """The same Gaussians seen from another world frame: means, rotations and harmonics turn together."""
        rotation, translation = motion[:, None, :3, :3], motion[:, None, :3, 3]
        turn = quaternion_from_rotation(rotation)
        return replace(
            self,
            means=(rotation @ self.means[..., None])[..., 0] + translation,
            rotations=multiply(turn, self.rotations),
            harmonics=rotate_harmonics(self.harmonics, rotation),
        )


def anysplat_gaussians(
    means: Float[Tensor, "b n 3"], raw: Float[Tensor, "b n g"], *, opacity_exponent: float = 0.0
) -> GaussianBatch:
    """Gaussians of the published AnySplat head, in the world of its cameras."""
    x, y, z, w = (raw[..., 4:8] / (raw[..., 4:8].norm(dim=-1, keepdim=True) + 1e-8)).unbind(-1)
    return GaussianBatch(
        means=means,
        rotations=torch.stack((w, x, y, z), dim=-1),
        scales=(0.001 * F.softplus(raw[..., 1:4])).clamp_max(0.3),
        opacities=map_opacity(raw[..., 0].sigmoid(), opacity_exponent),
        harmonics=_colour(raw),
    )


def footprint_gaussians(
    means: Float[Tensor, "b t p 3"],
    raw: Float[Tensor, "b t p g"],
    *,
    footprint: Float[Tensor, "b t p"],
    colours: Float[Tensor, "b t p 3"],
    rotation: Float[Tensor, "b t 3 3"],
) -> GaussianBatch:
    """Gaussians measured in pixels, p in each of t frames; the result holds the n = t p of a clip.

    Args:
        means: Centres, world units.
        raw: Raw channels.
        footprint: Size of the pixel at its depth, z / f, world units.
        colours: RGB of the pixel, in [0, 1].
        rotation: Rotation of each camera into the world.
    """
    local = F.normalize(raw[..., 4:8] + raw.new_tensor((1.0, 0.0, 0.0, 0.0)), dim=-1)
    harmonics = rotate_harmonics(_colour(raw), rotation[:, :, None])
    constant = harmonics[..., :1, :] + ((colours - 0.5) / CONSTANT_HARMONIC)[..., None, :]
    scales = footprint[..., None] * F.softplus(raw[..., 1:4]).clamp_max(LARGEST_FOOTPRINT)
    return GaussianBatch(
        means=means.flatten(1, 2),
        rotations=multiply(quaternion_from_rotation(rotation)[:, :, None], local).flatten(1, 2),
        scales=scales.flatten(1, 2),
        opacities=raw[..., 0].sigmoid().flatten(1, 2),
        harmonics=torch.cat((constant, harmonics[..., 1:, :]), dim=-2).flatten(1, 2),
    )


def map_opacity(probability: Tensor, exponent: float) -> Tensor:
    """AnySplat's opacity mapping: 0.5 (1 - (1-p)^e + p^(1/e)), e = 2^exponent; exponent 0 changes nothing."""
    power: float = 2.0**exponent
    mapped: Tensor = 0.5 * (1 - (1 - probability) ** power + probability ** (1 / power))
    return mapped


def _colour(raw: Float[Tensor, "*n g"]) -> Float[Tensor, "*n k 3"]:
    """Raw colour channels, damped by degree: 1 for the constant, 0.1 * 0.25^l above."""
    count = (raw.shape[-1] - 8) // 3
    damping = [1.0 if k == 0 else 0.1 * 0.25 ** isqrt(k) for k in range(count)]
    coefficients: Tensor = raw[..., 8:].unflatten(-1, (3, count)).transpose(-1, -2)
    return coefficients * raw.new_tensor(damping)[:, None]
