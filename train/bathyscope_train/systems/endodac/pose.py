"""EndoDAC's pose decoder and intrinsics head: from the features of two frames to their motion and their camera."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.rigid import rotation_exponential
from bathyscope_train.systems.endodac.resnet import CHANNELS

POSE_SCALE = 0.001
"""What the decoder's numbers are multiplied by, so that a fresh network predicts next to no motion."""

_WIDTH = 256


class Motion(NamedTuple):
    """Motion between two frames, before it becomes a matrix."""

    axis_angle: Float[Tensor, "n 3"]
    """Axis times angle, in radians."""
    translation: Float[Tensor, "n 3"]
    """In the unit of the depth network."""
    features: Float[Tensor, "n c h w"]
    """What the intrinsics head reads."""

    def matrix(self) -> Float[Tensor, "n 4 4"]:
        """:func:`motion_matrix` of it."""
        return motion_matrix(self.axis_angle, self.translation)


class PoseDecoder(nn.Module):
    """Motion of a pair (source, target) from the coarsest features of :class:`~.resnet.PairEncoder`."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.ModuleList(
            (
                nn.Conv2d(CHANNELS[-1], _WIDTH, 1),
                nn.Conv2d(_WIDTH, _WIDTH, 3, padding=1),
                nn.Conv2d(_WIDTH, _WIDTH, 3, padding=1),
                nn.Conv2d(_WIDTH, 12, 1),
            )
        )

    def forward(self, features: Float[Tensor, "n c h w"]) -> Motion:
        """The first six of twelve numbers, averaged over the map; the last six are not used."""
        squeeze, first, second, last = self.net
        hidden = second(F.relu(first(F.relu(squeeze(features)))))
        numbers = POSE_SCALE * last(F.relu(hidden)).mean((2, 3))
        return Motion(numbers[:, :3], numbers[:, 3:6], hidden)


class IntrinsicsHead(nn.Module):
    """Focal lengths and principal point from the pose decoder's features, before their ReLU.

    ``convs_suqeeze`` is part of the published checkpoints, spelt so, and never read.
    """

    def __init__(self) -> None:
        super().__init__()
        self.convs_suqeeze = nn.Conv2d(CHANNELS[-1], _WIDTH, 1)
        self.convs_suqeeze.requires_grad_(False)
        self.focal_length_conv = nn.Conv2d(_WIDTH, 2, 1, bias=False)
        self.offsets_conv = nn.Conv2d(_WIDTH, 2, 1, bias=False)

    def forward(self, features: Float[Tensor, "n c h w"], size: tuple[int, int]) -> Float[Tensor, "n 3 3"]:
        """Intrinsics in pixels for images of ``size`` (height, width).

        With f and o the two numbers of each convolution: ``fx, fy = (softplus(f) + 0.5) (w, h)`` and
        ``cx, cy = (o + 0.5) (w, h)``.
        """
        pooled = features.mean((2, 3), keepdim=True)
        sides = features.new_tensor((size[1], size[0]))
        focal = (F.softplus(self.focal_length_conv(pooled)[:, :, 0, 0]) + 0.5) * sides
        centre = (self.offsets_conv(pooled)[:, :, 0, 0] + 0.5) * sides
        zero, one = torch.zeros_like(focal[:, 0]), torch.ones_like(focal[:, 0])
        rows = (focal[:, 0], zero, centre[:, 0], zero, focal[:, 1], centre[:, 1], zero, zero, one)
        return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def average_intrinsics(size: tuple[int, int]) -> Float[Tensor, "3 3"]:
    """What is used where intrinsics are not learnt: the average over SCARED's calibrations, in pixels of ``size``."""
    height, width = size
    return torch.tensor(((0.82 * width, 0.0, width / 2), (0.0, 1.02 * height, height / 2), (0.0, 0.0, 1.0)))


def motion_matrix(axis_angle: Float[Tensor, "*b 3"], translation: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
    """The rotation, then the translation: maps points of the target's camera to the source's."""
    top = torch.cat((rotation_exponential(axis_angle), translation[..., None]), dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat((top, bottom), dim=-2)
