"""What followed points say about a network's depth without ground truth."""

from __future__ import annotations

import numpy as np
import pytest

from bathyscope.camera import F64
from bathyscope_serve.refine.agreement import FrameAgreement, clip_agreement, frame_agreement
from bathyscope_serve.refine.depth_field import KnownDepths


def known(own: F64, found: F64, doubt: float | F64 = 0.01) -> KnownDepths:
    return KnownDepths(np.zeros((len(own), 2)), np.log(own), np.log(found), np.broadcast_to(doubt, own.shape))


def test_it_is_the_relative_error_with_the_frames_scale_taken_out() -> None:
    """Twice the depth of the points but for a quarter of them, where it is 2.4 and 1.8 times that."""
    found = np.linspace(3, 60, 40)
    ratio = np.full(40, 2.0)
    ratio[:5], ratio[5:10] = 2.4, 1.8
    said = frame_agreement(known(ratio * found, found))
    assert said is not None
    assert said.points == 40
    assert said.difference == pytest.approx((5 * 0.2 + 5 * 0.1) / 40)


def test_uncertain_points_do_not_count_and_a_wild_one_counts_once() -> None:
    found, own, doubt = np.full(40, 10.0), np.full(40, 10.0), np.full(40, 0.01)
    own[:10], doubt[:10] = 30.0, 0.2
    own[10] = 1e6
    said = frame_agreement(known(own, found, doubt))
    assert said == FrameAgreement(pytest.approx(1 / 30), 30)
    assert frame_agreement(known(own[:25], found[:25], doubt[:25])) is None


def test_a_clip_is_the_mean_of_the_frames_that_can_say_something() -> None:
    assert clip_agreement([]) is None
    found = clip_agreement([FrameAgreement(0.1, 30), FrameAgreement(0.3, 50)])
    assert found is not None
    assert (found.difference, found.points, found.frames) == (0.2, 40, 2)
