"""A frame shown by the Gaussians of the others: right depth shows it, wrong depth and what is masked do not."""

from dataclasses import replace

import pytest
import torch

from bathyscope_train.data.windows import Batch
from bathyscope_train.losses.held_out_view import held_out_view_loss
from bathyscope_train.losses.supervised import splatting
from bathyscope_train.model import get_preset
from bathyscope_train.model.network import DenseMaps

SIZE, FOCAL, SHIFT = (28, 42), 40.0, 0.1  # the wall at distance 1 moves by four pixels a frame
SETTINGS = get_preset("tiny").scene


def wall() -> Batch:
    """Three frames of a striped wall at distance 1, the camera moving right."""
    column = torch.arange(SIZE[1]) + 0.5
    frames = [0.5 + 0.4 * torch.sin((column + 4 * k) / 3) for k in range(3)]
    images = torch.stack(frames)[:, None, None].expand(3, 3, *SIZE)[None]
    poses = torch.eye(4).repeat(1, 3, 1, 1)
    poses[0, :, 0, 3] = SHIFT * torch.arange(3)
    depth = torch.ones(1, 3, *SIZE)
    inside = torch.zeros(1, 3, *SIZE, dtype=torch.bool)
    inside[..., 10:-10] = True
    return Batch(images, depth, inside, poses, torch.tensor([FOCAL]), torch.zeros_like(inside), torch.zeros(1, 2))


def loss(batch: Batch, depth: torch.Tensor, raw: torch.Tensor) -> torch.Tensor:
    maps = DenseMaps(depth, torch.ones_like(depth), raw)
    return held_out_view_loss(maps, batch, 1, SETTINGS, splatting(torch.device("cpu")))


def opaque() -> torch.Tensor:
    raw = torch.zeros(1, 3, 12, *SIZE)
    raw[:, :, 0] = 6.0
    return raw


def test_the_true_depth_shows_the_frame_and_others_do_not() -> None:
    batch = replace(wall(), valid=torch.ones(1, 3, *SIZE, dtype=torch.bool))
    middle = replace(batch, moving=~wall().valid)  # the border, which nobody else may have seen, does not count
    right, near, far = (float(loss(middle, factor * batch.depth, opaque())) for factor in (1.0, 0.75, 1.35))
    assert right < 0.05
    assert min(near, far) > 2 * right


def test_transparent_gaussians_are_judged_by_what_they_show() -> None:
    batch = wall()
    thin = opaque()
    thin[:, :, 0] = -1.0
    assert float(loss(batch, batch.depth, thin)) == pytest.approx(float(loss(batch, batch.depth, opaque())), abs=0.03)


def test_it_teaches_depth_and_gaussians() -> None:
    batch = wall()
    depth, raw = (1.1 * batch.depth).requires_grad_(), opaque().requires_grad_()
    loss(batch, depth, raw).backward()
    assert depth.grad is not None
    assert raw.grad is not None
    assert depth.grad[:, [0, 2]].abs().sum() > 0
    assert not depth.grad[:, 1].any()  # the frame itself has no say
    assert raw.grad[:, [0, 2], 0].abs().sum() > 0
