"""Training windows keep the truth true: whatever is done to the images is done to depth, poses and focal length."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bathyscope.errors import DatasetError
from bathyscope_train.data.synthetic import DOMAINS, render_clip
from bathyscope_train.data.truth_clips import truth_clip
from bathyscope_train.data.windows import Batch, TruthClip, crop_centre, cut_window, mirror, sample_window, stack
from bathyscope_train.losses.matching import true_matches
from bathyscope_train.model.trajectory import ClipPairs


@pytest.fixture(scope="module")
def clip() -> TruthClip:
    return truth_clip(render_clip(2, DOMAINS["source"], frames=10, size=(56, 70)))


def visible_share(batch: Batch) -> float:
    """Share of points whose depth agrees where they land one frame later: small as soon as any of the truths is off."""
    count = batch.depth.shape[1]
    source = torch.arange(count - 1)
    true = true_matches(batch, ClipPairs(source, source + 1, torch.ones(count - 1)))
    return float(true.visible.float().mean())


def test_depth_poses_and_focal_length_agree_from_frame_to_frame(clip: TruthClip) -> None:
    batch = cut_window(clip, range(6))
    assert visible_share(batch) > 0.95
    spoilt = replace(batch, world_from_camera=batch.world_from_camera.flip(1))
    assert visible_share(spoilt) < visible_share(batch) - 0.3


@pytest.mark.parametrize("axis", [0, 1], ids=["left-right", "top-bottom"])
def test_a_mirrored_window_still_agrees(clip: TruthClip, axis: int) -> None:
    batch = cut_window(clip, range(6))
    mirrored = mirror(batch, axis=axis)
    assert visible_share(mirrored) == pytest.approx(visible_share(batch), abs=0.02)
    assert torch.equal(mirrored.depth.flip(-1 - axis), batch.depth)
    assert torch.linalg.det(mirrored.world_from_camera[0, 3, :3, :3]).item() == pytest.approx(1.0, abs=1e-5)


def test_a_cropped_window_has_a_longer_focal_length_and_still_agrees(clip: TruthClip) -> None:
    batch = cut_window(clip, range(6))
    cropped = crop_centre(batch, 0.7)
    torch.testing.assert_close(cropped.focal, batch.focal / 0.7)
    assert visible_share(cropped) > 0.95
    assert float(cropped.depth[cropped.valid].mean()) == pytest.approx(1.0, abs=1e-4)


def test_time_runs_backwards_as_well_as_forwards(clip: TruthClip) -> None:
    assert visible_share(cut_window(clip, [5, 4, 3, 2, 1, 0])) > 0.75


def test_a_window_has_mean_depth_one_and_starts_at_the_identity(clip: TruthClip) -> None:
    batch = cut_window(clip, [4, 5, 6])
    torch.testing.assert_close(batch.world_from_camera[0, 0], torch.eye(4), atol=1e-6, rtol=0)
    assert float(batch.depth[batch.valid].mean()) == pytest.approx(1.0, abs=1e-4)


def test_samples_are_the_same_for_the_same_seed_and_stay_in_range(clip: TruthClip) -> None:
    first, again, other = (sample_window(clip, np.random.default_rng(seed), frames=5) for seed in (7, 7, 8))
    assert torch.equal(first.images, again.images)
    assert torch.equal(first.depth, again.depth)
    assert not torch.equal(first.images, other.images)
    assert float(first.images.min()) >= 0
    assert float(first.images.max()) <= 1


def test_a_short_clip_gives_windows_that_stand_still(clip: TruthClip) -> None:
    short = TruthClip(clip.frames[:3], clip.depth[:3], clip.world_from_camera[:3], clip.focal, "short")
    assert sample_window(short, np.random.default_rng(0), frames=6).images.shape[1] == 6


def test_windows_of_several_clips_stack(clip: TruthClip) -> None:
    batch = stack([cut_window(clip, range(4)), cut_window(clip, range(2, 6))])
    assert batch.images.shape[:2] == (2, 4)
    assert batch.focal.shape == (2,)


def test_frames_without_depth_are_refused_by_name(clip: TruthClip) -> None:
    blind = TruthClip(clip.frames, torch.zeros_like(clip.depth), clip.world_from_camera, clip.focal, "blind")
    with pytest.raises(DatasetError, match="blind"):
        cut_window(blind, [0, 1])
