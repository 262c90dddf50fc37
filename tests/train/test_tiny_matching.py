"""Matching between frames: grids, look-ups, and the ground truth that supervises it, on scenes done by hand."""

import cv2
import numpy as np
import torch

from bathyscope_train.data.windows import Batch
from bathyscope_train.losses.camera import focal_loss, induced_flow_loss, motion_loss
from bathyscope_train.losses.matching import (
    TrueMatches,
    distort,
    flow_loss,
    matching_cross_entropy,
    true_matches,
    undistort,
)
from bathyscope_train.model.correspondence import Matcher, look_up, query_centres, query_depth
from bathyscope_train.model.pose_layer import Motion, solve_motion
from bathyscope_train.model.rigid import rotation_exponential
from bathyscope_train.model.trajectory import ClipPairs

SIZE, FOCAL = (56, 72), 40.0


def sideways_over_a_plane(shift: float = 0.2, distance: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Two frames of a wall at ``distance``; the camera moves right by ``shift``: everything moves left."""
    poses = torch.eye(4).repeat(1, 2, 1, 1)
    poses[0, 1, 0, 3] = shift
    return torch.full((1, 2, *SIZE), distance), poses


def matches(depth: torch.Tensor, poses: torch.Tensor, **labels: torch.Tensor) -> TrueMatches:
    """From frame 0 to frame 1 of one clip, by a lens without distortion, nothing moving by itself unless said."""
    known = {"moving": torch.zeros_like(depth, dtype=torch.bool), "distortion": torch.zeros(1, 2)} | labels
    batch = Batch(
        images=torch.zeros(1, 2, 3, *SIZE),
        depth=depth,
        valid=depth > 0,
        world_from_camera=poses,
        focal=torch.tensor([FOCAL]),
        **known,
    )
    return true_matches(batch, ClipPairs(torch.tensor([0]), torch.tensor([1]), torch.ones(1)))


def test_queries_are_every_second_cell_and_their_depth_is_taken_there() -> None:
    queries = query_centres(14, 18, like=torch.zeros(()))
    assert queries.shape == (7 * 9, 2)
    torch.testing.assert_close(queries[10], torch.tensor([2.5, 2.5]))
    columns = torch.arange(72.0).expand(1, 1, 56, 72)
    # Cell 2 spans the pixels 8 to 11; its centre lies between the pixels 9 and 10.
    assert query_depth(columns)[0, 0, 10] == 9


def test_a_wall_moves_by_focal_length_times_shift_over_distance() -> None:
    depth, poses = sideways_over_a_plane()
    true = matches(depth, poses)
    flow = true.positions[0] - true.queries
    torch.testing.assert_close(flow, torch.tensor([-FOCAL / 4 * 0.2, 0.0]).expand(63, 2), atol=1e-4, rtol=0)


def test_points_outside_the_target_or_hidden_there_are_not_visible() -> None:
    depth, poses = sideways_over_a_plane()
    depth[:, 1, :, :36] = 0.5
    true = matches(depth, poses)
    # In cells from the corner: the left half of the target (x < 9) shows something nearer.
    landed = true.positions[0, :, 0] + SIZE[1] / 8
    expected = (landed >= 9) & (landed < 18)
    assert torch.equal(true.visible[0], expected)
    assert 0 < int(expected.sum()) < 63


def test_instruments_are_matched_neither_from_nor_to() -> None:
    depth, poses = sideways_over_a_plane()
    moving = torch.zeros(1, 2, *SIZE, dtype=torch.bool)
    moving[:, 0, :28], moving[:, 1, :, :36] = True, True
    free, held = matches(depth, poses), matches(depth, poses, moving=moving)
    landed = held.positions[0, :, 0] + SIZE[1] / 8
    upper = held.queries[:, 1] + SIZE[0] / 8 < 7
    assert torch.equal(held.visible[0], free.visible[0] & ~upper & (landed >= 9))


def test_a_bent_lens_shows_the_same_world_elsewhere() -> None:
    """A wall parallel to the image: undistort, shift by f t / z, distort again."""
    depth, poses = sideways_over_a_plane()
    bend = torch.tensor([[-0.2, 0.03]])
    true = matches(depth, poses, distortion=bend)
    plain = undistort(true.queries[None] / (FOCAL / 4), bend) - torch.tensor([0.2, 0.0])
    torch.testing.assert_close(true.positions, distort(plain, bend) * FOCAL / 4, atol=1e-4, rtol=0)
    assert float((true.positions - true.ideal).abs().max()) > 0.3


def test_undistorting_undoes_the_lens_and_agrees_with_opencv() -> None:
    points = torch.rand(1, 50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 1.6 - 0.8
    bend = torch.tensor([[-0.25, 0.06]], dtype=torch.float64)
    shown = distort(points, bend)
    torch.testing.assert_close(undistort(shown, bend), points, atol=1e-9, rtol=0)
    lifted = np.concatenate([points[0].numpy(), np.ones((50, 1))], 1)
    expected, _ = cv2.projectPoints(lifted, np.zeros(3), np.zeros(3), np.eye(3), np.array([-0.25, 0.06, 0, 0, 0]))
    np.testing.assert_allclose(shown[0].numpy(), expected[:, 0], atol=1e-9)


def test_true_matches_through_the_solver_give_the_true_motion() -> None:
    random = torch.Generator().manual_seed(0)
    depth = (0.7 + 0.6 * torch.rand(1, 1, *SIZE, generator=random)).expand(1, 2, *SIZE)
    poses = torch.eye(4).repeat(1, 2, 1, 1)
    poses[0, 1, :3, :3] = rotation_exponential(torch.tensor([0.02, -0.05, 0.03]))
    poses[0, 1, :3, 3] = torch.tensor([0.05, 0.02, -0.04])
    true = matches(depth, poses)
    weights = torch.ones_like(true.positions)
    found = solve_motion(true.points, true.positions, weights, true.focal, Motion.none(true.points[:, 0]), iterations=5)
    assert motion_loss(found.motion, true.motion) < 2e-3
    assert induced_flow_loss(found.motion, true) < 1e-2


def test_look_up_reads_the_cells_around_a_place_and_zero_beyond_the_border() -> None:
    logits = torch.arange(1.0, 1 + 6 * 8).reshape(1, 1, 6, 8)
    window = look_up(logits, torch.tensor([[[2.5, 2.5]]])).reshape(7, 7)
    assert window[3, 3] == logits[0, 0, 2, 2]
    assert window[4, 5] == logits[0, 0, 3, 4]
    assert float(window[0].abs().max()) < 1e-5
    halfway = look_up(logits, torch.tensor([[[3.0, 2.5]]])).reshape(7, 7)
    torch.testing.assert_close(halfway[3, 3], logits[0, 0, 2, 2:4].mean())


def test_distinct_descriptors_are_matched_where_they_went() -> None:
    """Random unit vectors, moved by two cells: correlation alone finds them, and so does the cross-entropy."""
    random = torch.Generator().manual_seed(2)
    source = torch.nn.functional.normalize(torch.randn(1, 64, 14, 18, generator=random), dim=1)
    target = source.roll(-2, dims=3)
    with torch.no_grad():
        matcher = Matcher()
        matcher.temperature.fill_(4.0)
        correlation = matcher.correlate(source, target)
    depth, poses = sideways_over_a_plane(shift=0.2)
    true = matches(depth, poses)
    principal = torch.tensor([9.0, 7.0])
    assert flow_loss(correlation.best - principal, true) < 0.05
    assert matching_cross_entropy(correlation, true, principal) < 0.05
    wrong = matcher.correlate(source, source.roll(3, dims=3))
    assert matching_cross_entropy(wrong, true, principal) > 5


def test_camera_losses_are_zero_for_the_truth_and_closed_form_off_it() -> None:
    turn = rotation_exponential(torch.tensor([[0.0, 0.3, 0.0]]))
    true = Motion(torch.eye(3)[None], torch.tensor([[0.0, 0.4, 0.0]]))
    assert motion_loss(true, true) < 1e-5
    wrong = Motion(turn, torch.tensor([[0.0, 0.4, 0.2]]))
    expected = torch.sin(torch.tensor(0.3)) + 2 * (1 - torch.cos(torch.tensor(0.3))) + 0.1 * 0.2 / 0.5
    torch.testing.assert_close(motion_loss(wrong, true), expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(focal_loss(torch.tensor([80.0]), torch.tensor([40.0])), torch.tensor(2.0).log())
