"""Gaussians into one camera, in plain torch: differentiable in everything, also in the camera."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bathyscope.splat import SplatSettings
from bathyscope_train.model.gaussian_parameters import GaussianBatch
from bathyscope_train.model.harmonics import evaluate_harmonics

CLAMP_MARGIN = 0.15
"""How far outside the image, in image sizes, the slope of a ray may lie before the Jacobian sees it clamped."""
REACH_CAP = 3.33
"""Standard deviations; where even an opacity of 1 has fallen to 1/255."""


@dataclass(frozen=True, slots=True)
class Footprints:
    """The m visible Gaussians of a scene as one image sees them, nearest first."""

    index: Int[Tensor, " m"]
    """Their places in the scene."""
    means: Float[Tensor, "m 2"]
    """Centres (u, v), px."""
    conics: Float[Tensor, "m 3"]
    """Inverse covariances (a, b, c) of [[a, b], [b, c]], 1 / px^2."""
    depths: Float[Tensor, " m"]
    opacities: Float[Tensor, " m"]
    """With the compensation of antialiasing in them."""
    colours: Float[Tensor, "m 3"]
    """RGB towards the camera, not below 0."""
    reaches: Float[Tensor, "m 2"]
    """How far from the centre, along u and v, alpha can be at the threshold, px; without gradient."""

    def near(self, lower: Float[Tensor, " 2"], upper: Float[Tensor, " 2"]) -> Footprints:
        """Those that can be seen in the box from ``lower`` to ``upper`` (u, v), in the same order."""
        meets = (self.means + self.reaches >= lower) & (self.means - self.reaches <= upper)
        kept = torch.nonzero(meets.all(-1))[:, 0]
        return Footprints(*(getattr(self, part.name)[kept] for part in fields(self)))


def project(
    scene: GaussianBatch,
    clip: int,
    *,
    camera_from_world: Float[Tensor, "4 4"],
    intrinsics: Float[Tensor, "3 3"],
    size: tuple[int, int],
    settings: SplatSettings,
) -> Footprints:
    """Project the Gaussians of one clip by the formulas of ``bathyscope.splat``.

    What is visible is decided without gradient, and clamped slopes and colours pass none to the Gaussians; but the
    bounds of the slopes are made of the intrinsics, and pass it to them.
    """
    rotation, translation = camera_from_world[:3, :3], camera_from_world[:3, 3]
    points = scene.means[clip] @ rotation.T + translation
    ahead = (points[:, 2] >= settings.near_plane) & (points[:, 2] <= settings.far_plane)
    index = torch.nonzero(ahead & (scene.opacities[clip] >= settings.alpha_threshold))[:, 0]
    points, z = points[index], points[index, 2:]

    focal, principal = intrinsics.diagonal()[:2], intrinsics[:2, 2]
    slopes = points[:, :2] / z
    means = focal * slopes + principal
    seen = _clamped(slopes, focal, principal, size)
    # The rows of J R: how u and v move with a step in the world.
    steps = (focal / z)[..., None] * (rotation[:2] - seen[..., None] * rotation[2])
    spans = steps @ principal_axes(scene.rotations[clip, index], scene.scales[clip, index])
    variances = spans.square().sum(-1) + settings.eps2d
    covariance = (spans[:, 0] * spans[:, 1]).sum(-1)
    # Determinants as sums of squares (Cauchy-Binet): a difference would lose thin Gaussians to rounding.
    before = torch.linalg.cross(spans[:, 0], spans[:, 1]).square().sum(-1)
    determinant = before + settings.eps2d * (variances.sum(-1) - settings.eps2d)
    conics = torch.stack((variances[:, 1], -covariance, variances[:, 0]), -1) / determinant[:, None]
    opacities = scene.opacities[clip, index]
    if settings.antialiased:
        opacities = opacities * (before / determinant).sqrt()

    visible = _visible(means.detach(), variances.detach(), opacities.detach(), size, settings)
    kept = torch.nonzero(visible & (determinant > 0))[:, 0]
    kept = kept[torch.argsort(z[kept, 0].detach(), stable=True)]
    centre = -rotation.T @ translation
    return Footprints(
        index[kept],
        means[kept],
        conics[kept],
        z[kept, 0],
        opacities[kept],
        _colours(scene.means[clip, index[kept]] - centre, scene.harmonics[clip, index[kept]], settings.degree),
        _reaches(variances.detach()[kept], opacities.detach()[kept], settings),
    )


def principal_axes(rotations: Float[Tensor, "*n 4"], scales: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """The axes of Gaussians as columns, each as long as its standard deviation: R(q) diag(s)."""
    w, x, y, z = (rotations / rotations.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), -1),
        torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), -1),
        torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), -1),
    )
    return torch.stack(rows, -2) * scales[..., None, :]


def _clamped(slopes: Tensor, focal: Tensor, principal: Tensor, size: tuple[int, int]) -> Float[Tensor, "n 2"]:
    sides = slopes.new_tensor((size[1], size[0]))
    margin = CLAMP_MARGIN * sides / focal
    return slopes.clamp(-principal / focal - margin, (sides - principal) / focal + margin)


def _visible(
    means: Tensor, variances: Tensor, opacities: Tensor, size: tuple[int, int], settings: SplatSettings
) -> Bool[Tensor, " n"]:
    """Opaque enough, larger than the clip, and with a box of whole radii that meets the image."""
    ratio = (opacities / settings.alpha_threshold).clamp_min(1)
    sigmas = (2 * ratio.log()).sqrt().clamp_max(REACH_CAP)
    radii = (sigmas[:, None] * variances.sqrt()).ceil()
    sides = means.new_tensor((size[1], size[0]))
    meets = ((means + radii > 0) & (means - radii < sides)).all(-1)
    return meets & (radii > settings.radius_clip).any(-1) & (opacities >= settings.alpha_threshold)


def _reaches(variances: Tensor, opacities: Tensor, settings: SplatSettings) -> Float[Tensor, "m 2"]:
    sigmas = (2 * (opacities / settings.alpha_threshold).clamp_min(1).log()).sqrt()
    # A thousandth more, for rounding.
    return 1.001 * sigmas[:, None] * variances.sqrt() + 1e-3


def _colours(away: Tensor, harmonics: Tensor, degree: int | None) -> Float[Tensor, "m 3"]:
    count = harmonics.shape[-2] if degree is None else (degree + 1) ** 2
    directions = torch.nn.functional.normalize(away, dim=-1)
    terms = evaluate_harmonics(directions, round(count**0.5) - 1)
    return ((terms[..., None] * harmonics[:, :count]).sum(-2) + 0.5).clamp_min(0)
