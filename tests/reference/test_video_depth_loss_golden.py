"""The supervised video loss against the golden values (``evaluation/vda_train_loss*.npz``)."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from bathyscope.errors import GeometryError
from bathyscope_train.losses.video_depth import video_depth_loss

REFERENCE = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference"))
FILES = sorted((REFERENCE / "evaluation").glob("vda_train_loss*.npz"))


@pytest.mark.skipif(not FILES, reason=f"no evaluation/vda_train_loss*.npz under {REFERENCE}")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_both_terms_are_the_golden_ones(path: Path) -> None:
    with np.load(path) as arrays:
        found = video_depth_loss(*(torch.from_numpy(arrays[name]) for name in ("prediction", "target", "mask")))
        expected = [float(arrays[name]) for name in ("spatial_loss", "stable_loss", "total_loss")]
    assert [float(value) for value in (found.spatial, found.temporal, found.total)] == pytest.approx(expected, rel=1e-5)


def clip(seed: int = 0) -> torch.Tensor:
    return torch.rand(2, 4, 8, 9, generator=torch.Generator().manual_seed(seed)) + 0.5


def test_a_prediction_right_up_to_scale_and_shift_costs_nothing() -> None:
    target = clip()
    found = video_depth_loss(3 * target + 2, target, torch.ones_like(target, dtype=torch.bool))
    torch.testing.assert_close(found.total, torch.tensor(0.0), atol=2e-4, rtol=0)


def test_a_steady_target_makes_flicker_cost() -> None:
    """A still scene, predicted with a shift that alternates: frame differences are 0.02 and should be 0."""
    target = clip()[:, :1].repeat(1, 4, 1, 1)
    flickering = target + 0.01 * torch.tensor([1.0, -1, 1, -1]).view(1, 4, 1, 1)
    found = video_depth_loss(flickering, target, torch.ones_like(target, dtype=torch.bool))
    torch.testing.assert_close(found.temporal, torch.tensor(0.2), atol=2e-3, rtol=0)


def test_unknown_pixels_send_no_gradient_and_an_empty_mask_costs_nothing() -> None:
    target, mask = clip(), torch.ones(2, 4, 8, 9, dtype=torch.bool)
    mask[:, :, :, 5:] = False
    prediction = clip(1).requires_grad_()
    video_depth_loss(prediction, target, mask).total.backward()
    assert prediction.grad is not None
    assert torch.isfinite(prediction.grad).all()
    assert prediction.grad[..., :5].abs().sum() > 0
    assert float(video_depth_loss(clip(1), target, torch.zeros_like(mask)).total) == 0.0


def test_shapes_must_agree() -> None:
    with pytest.raises(GeometryError, match="three times"):
        video_depth_loss(clip(), clip()[:, :3], torch.ones(2, 4, 8, 9, dtype=torch.bool))
