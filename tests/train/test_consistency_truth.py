"""Each consistency loss is lower for true depth than for depth that is wrong in the ways that training goes wrong."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from wrong_depths import TrueClip, evenly_lit, painted, shrunk, true_clip, wrong_depths

from bathyscope_train.losses.photometric import photometric_loss
from bathyscope_train.losses.temporal import moving_edges_loss, temporal_gradient_loss
from bathyscope_train.losses.world import meeting_pixels, world_consistency_loss
from bathyscope_train.render import CpuRenderer, leave_one_out

STRIDE = 3


@pytest.fixture(scope="module")
def clip() -> TrueClip:
    return true_clip(1, evenly_lit("cavity"))


def rgb(clip: TrueClip) -> float:
    """Leave-one-out, opacity divided out."""
    view = leave_one_out(CpuRenderer(threads=1), painted(clip), clip.world_from_camera, clip.intrinsics, clip.size)
    return float(photometric_loss(view.image, clip.frames, clip.valid, opacity=view.opacity))


@pytest.mark.slow
def test_the_photometric_loss_prefers_the_truth(clip: TrueClip) -> None:
    truth = rgb(clip)
    for name, wrong in wrong_depths(clip).items():
        assert rgb(wrong) > 1.03 * truth, name
    assert rgb(shrunk(clip, 0.5)) == pytest.approx(truth, rel=1e-3)


@pytest.mark.parametrize("fixed", [False, True], ids=["own valid set", "fixed valid set"])
def test_the_world_loss_prefers_the_truth(clip: TrueClip, fixed: bool) -> None:
    meets = meeting_pixels(*clip.geometry, stride=STRIDE) if fixed else None
    truth = float(world_consistency_loss(*clip.geometry, stride=STRIDE, meets=meets))
    for name, wrong in wrong_depths(clip).items():
        assert float(world_consistency_loss(*wrong.geometry, stride=STRIDE, meets=meets)) > 1.5 * truth, name


@pytest.mark.slow
def test_depth_rendered_from_all_frames_hides_that_they_disagree(clip: TrueClip) -> None:
    """Nearly transparent Gaussians are averaged over the frames, and one world always agrees with itself."""
    flickering = wrong_depths(clip)["flicker 10 %"]
    scene = painted(flickering)
    scene = replace(scene, opacities=0.1 * scene.opacities)
    view = CpuRenderer(threads=1)(scene, clip.world_from_camera, clip.intrinsics, clip.size)
    rendered = replace(flickering, depth=view.depth, valid=clip.valid & (view.opacity > 0.3))
    placed_loss = float(world_consistency_loss(*flickering.geometry, stride=STRIDE))
    assert float(world_consistency_loss(*rendered.geometry, stride=STRIDE)) < 0.2 * placed_loss


@pytest.mark.parametrize("fixed", [False, True], ids=["own valid set", "fixed valid set"])
def test_the_compensated_edges_prefer_the_truth(clip: TrueClip, fixed: bool) -> None:
    meets = meeting_pixels(*clip.geometry, stride=STRIDE) if fixed else None
    truth = float(moving_edges_loss(*clip.geometry, stride=STRIDE, meets=meets))
    for name, wrong in wrong_depths(clip).items():
        assert float(moving_edges_loss(*wrong.geometry, stride=STRIDE, meets=meets)) > 1.3 * truth, name


@pytest.mark.parametrize(("factor", "sign"), [(0.9, -1), (1.1, 1)], ids=["too near", "too far"])
def test_the_photometric_slope_leads_back_to_the_truth(factor: float, sign: int) -> None:
    """Of a common factor on depth, cameras fixed. Order and visibility are not differentiated, hence the factor 2."""
    small = true_clip(1, evenly_lit("cavity"), frames=3, size=(42, 56))

    def loss(scale: Tensor) -> Tensor:
        scaled = replace(small, depth=small.depth * scale)
        cameras = small.world_from_camera, small.intrinsics, small.size
        view = leave_one_out(CpuRenderer(threads=1), painted(scaled), *cameras)
        return photometric_loss(view.image, small.frames, small.valid, opacity=view.opacity)

    scale = torch.tensor(factor, requires_grad=True)
    (slope,) = torch.autograd.grad(loss(scale), scale)
    step = 0.01
    difference = float(loss(torch.tensor(factor + step)) - loss(torch.tensor(factor - step))) / (2 * step)
    assert sign * float(slope) > 0
    assert 0.5 < float(slope) / difference < 2


def test_the_literal_temporal_loss_prefers_flat_maps_to_the_truth(clip: TrueClip) -> None:
    """Why it is an option only: whatever flattens the map lowers it, down to nothing for a constant one."""
    truth = float(temporal_gradient_loss(clip.depth, clip.valid, stride=STRIDE))
    wrong = {
        name: float(temporal_gradient_loss(found.depth, found.valid, stride=STRIDE))
        for name, found in wrong_depths(clip).items()
    }
    assert wrong["constant"] == pytest.approx(0, abs=1e-6)
    assert wrong["smoothed"] < truth
    assert wrong["x 0.8"] == pytest.approx(0.8 * truth, rel=1e-4)
