"""Supervised Gaussians: shape from the true surface, opacity from how right the predicted depth is.

What is served is the depth *rendered* from the Gaussians of all frames, so a Gaussian in the wrong place
does harm to every frame that sees it. Its opacity is therefore trained to say whether the predicted depth of
its pixel is right there; edges and pixels outside the field of view get none.

Even a Gaussian that is right is kept nearly transparent. The frames of a clip see one surface many times, at
slightly different depths; opaque Gaussians would show the nearest of them, which is biased, and transparent ones
show their mean. (Measured half-way through the first training: AbsRel .088 of the depth head became .085 rendered
from opaque Gaussians and .080 from these, on scenes like the training's; .173, .187 and .174 on broader ones.)
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from bathyscope_train.losses.depth import masked_mean, safe_log
from bathyscope_train.model.gaussian_parameters import LARGEST_FOOTPRINT
from bathyscope_train.model.pose_encoding import quaternion_to_matrix

ERROR_SCALE = 0.05
"""Difference of log depths at which the opacity wanted has fallen to a half."""

OPAQUE = 0.15
"""Opacity of a Gaussian that is exactly right; neighbours overlap, so one frame alone covers about 0.4 of its view."""

_EDGE = 0.1
_ALONG = 0.5
_ACROSS = 0.2
_GRAZING = 0.2
_CONFIDENCE_FLOOR = 0.02
_OPACITY_WEIGHT = 5.0


def depth_error(
    depth: Float[Tensor, "b t h w"], true: Float[Tensor, "b t h w"], valid: Bool[Tensor, "b t h w"]
) -> Float[Tensor, "b t h w"]:
    """Absolute difference of log depths after removing the clip's median difference; 0 where not valid."""
    difference = (depth.log() - safe_log(true)).detach()
    median = torch.where(valid, difference, torch.nan).flatten(1).nanmedian(1).values[:, None, None, None]
    return torch.where(valid, (difference - median).abs(), 0)


def depth_edges(true: Float[Tensor, "b t h w"], valid: Bool[Tensor, "b t h w"]) -> Bool[Tensor, "b t h w"]:
    """Pixels where the surface breaks: inverse depth, which is linear on any plane, bends by more than a tenth."""
    inverse = torch.where(valid, 1 / true.clamp_min(1e-6), 0)
    padded = F.pad(inverse, (1, 1, 1, 1), mode="replicate")
    centre = 2 * inverse
    across = (padded[..., 1:-1, 2:] + padded[..., 1:-1, :-2] - centre).abs()
    down = (padded[..., 2:, 1:-1] + padded[..., :-2, 1:-1] - centre).abs()
    return (torch.maximum(across, down) * true > _EDGE) & valid


def opacity_target(
    error: Float[Tensor, "b t h w"], edges: Bool[Tensor, "b t h w"], valid: Bool[Tensor, "b t h w"]
) -> Float[Tensor, "b t h w"]:
    """Wanted opacity: ``0.15 / (1 + (error / 0.05)^2)``, 0 on edges and outside the field of view.

    The weights of a mean that are best where errors differ are the inverse squares of the errors; and they leave no
    holes where a whole surface is hard.
    """
    return OPAQUE / (1 + (error / ERROR_SCALE) ** 2) * (valid & ~edges)


def surface_shape(
    true: Float[Tensor, "b t h w"], focal: Float[Tensor, "b"], *, stride: int = 1
) -> Float[Tensor, "b t h2 w2 3 3"]:
    """Symmetric square root of the covariance of a Gaussian that covers its pixel on the true surface.

    In units of the pixel's footprint z / f, in the axes of the camera: half a pixel along the surface, stretched
    by 1 / cos of the viewing angle (at most 5) where it recedes, a fifth across it. Only every ``stride``-th pixel
    is returned.
    """
    ray = _rays(true, focal)
    normal = _normals(ray * true[..., None], stride)
    unit = F.normalize(ray[:, :, ::stride, ::stride], dim=-1)
    cosine = (normal * unit).sum(-1, keepdim=True).abs()
    tilt = unit - (unit * normal).sum(-1, keepdim=True) * normal
    cosine = cosine.clamp_min(_GRAZING)[..., None]
    flat = torch.eye(3, dtype=true.dtype, device=true.device) - _outer(normal)
    return _ALONG * (flat + _outer(tilt) / (cosine * (1 + cosine))) + _ACROSS * _outer(normal)


def gaussian_loss(
    raw: Float[Tensor, "b t g h w"],
    depth: Float[Tensor, "b t h w"],
    true: Float[Tensor, "b t h w"],
    valid: Bool[Tensor, "b t h w"],
    focal: Float[Tensor, "b"],
    *,
    stride: int = 3,
) -> Float[Tensor, ""]:
    """Five times the opacity's cross-entropy, half the shape error, a twentieth of the fusion confidence's error.

    Shapes are compared as symmetric matrices, so the order and the signs of a Gaussian's axes do not matter. The
    fusion confidence should be ``-log(error + 0.02)``. Colour residuals have no target: they start, and stay, at zero.

    Args:
        raw: Raw channels in the ``footprint`` meaning, fusion confidence last.
        depth: Predicted depth.
        true: True depth.
        valid: Where it is known.
        focal: True focal length in pixels.
        stride: Every how many pixels shape and confidence are compared.
    """
    error, edges = depth_error(depth, true, valid), depth_edges(true, valid)
    opacity = F.binary_cross_entropy_with_logits(raw[:, :, 0], opacity_target(error, edges, valid))
    raw, error = raw[..., ::stride, ::stride], error[..., ::stride, ::stride]
    smooth = (valid & ~edges)[..., ::stride, ::stride]
    wanted = surface_shape(true, focal, stride=stride)
    shape = masked_mean((predicted_shape(raw) - wanted).abs().sum((-2, -1)), smooth)
    confidence = masked_mean((raw[:, :, -1] + (error + _CONFIDENCE_FLOOR).log()).abs(), smooth)
    return _OPACITY_WEIGHT * opacity + 0.5 * shape + 0.05 * confidence


def predicted_shape(raw: Float[Tensor, "b t g h w"]) -> Float[Tensor, "b t h w 3 3"]:
    """Symmetric square root of the predicted covariance, in footprints and the axes of the camera."""
    channels = raw.permute(0, 1, 3, 4, 2)
    w, x, y, z = (channels[..., 4:8] + channels.new_tensor((1.0, 0.0, 0.0, 0.0))).unbind(-1)
    rotation = quaternion_to_matrix(torch.stack((x, y, z, w), -1))
    scales = F.softplus(channels[..., 1:4]).clamp_max(LARGEST_FOOTPRINT)
    return (rotation * scales[..., None, :]) @ rotation.transpose(-1, -2)


def _rays(depth: Float[Tensor, "b t h w"], focal: Float[Tensor, "b"]) -> Float[Tensor, "b t h w 3"]:
    height, width = depth.shape[-2:]
    x = torch.arange(width, device=depth.device, dtype=depth.dtype) + 0.5 - width / 2
    y = torch.arange(height, device=depth.device, dtype=depth.dtype) + 0.5 - height / 2
    grid = torch.stack([x.expand(height, width), y[:, None].expand(height, width)], -1)
    scaled = grid[None, None] / focal[:, None, None, None, None]
    ones = torch.ones_like(scaled[..., :1])
    return torch.cat([scaled, ones], -1).expand(*depth.shape, 3)


def _normals(points: Float[Tensor, "b t h w 3"], stride: int) -> Float[Tensor, "b t h2 w2 3"]:
    """Unit normals from central differences (one-sided at the border) of every ``stride``-th pixel."""
    across = torch.gradient(points[:, :, ::stride], dim=3)[0][:, :, :, ::stride]
    down = torch.gradient(points[:, :, :, ::stride], dim=2)[0][:, :, ::stride]
    return F.normalize(torch.linalg.cross(across, down), dim=-1, eps=1e-12)


def _outer(vector: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    return vector[..., :, None] * vector[..., None, :]
