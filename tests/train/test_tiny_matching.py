"""Matching between frames: grids, look-ups, and the ground truth that supervises it, on scenes done by hand."""

import torch

from bathyscope_train.losses.camera import focal_loss, induced_flow_loss, motion_loss
from bathyscope_train.losses.matching import flow_loss, matching_cross_entropy, true_matches
from bathyscope_train.model.correspondence import Matcher, look_up, query_centres, query_depth
from bathyscope_train.model.pose_layer import Motion, solve_motion
from bathyscope_train.model.rigid import rotation_exponential

SIZE, FOCAL = (56, 72), 40.0


def sideways_over_a_plane(shift: float = 0.2, distance: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Two frames of a wall at ``distance``; the camera moves right by ``shift``: everything moves left."""
    poses = torch.eye(4).repeat(1, 2, 1, 1)
    poses[0, 1, 0, 3] = shift
    return torch.full((1, 2, *SIZE), distance), poses


def pair() -> tuple[torch.Tensor, torch.Tensor]:
    return torch.tensor([0]), torch.tensor([1])


def test_queries_are_every_second_cell_and_their_depth_is_taken_there() -> None:
    queries = query_centres(14, 18, like=torch.zeros(()))
    assert queries.shape == (7 * 9, 2)
    torch.testing.assert_close(queries[10], torch.tensor([2.5, 2.5]))
    columns = torch.arange(72.0).expand(1, 1, 56, 72)
    # Cell 2 spans the pixels 8 to 11; its centre lies between the pixels 9 and 10.
    assert query_depth(columns)[0, 0, 10] == 9


def test_a_wall_moves_by_focal_length_times_shift_over_distance() -> None:
    depth, poses = sideways_over_a_plane()
    true = true_matches(depth, poses, torch.tensor([FOCAL]), *pair())
    flow = true.positions[0] - true.queries
    torch.testing.assert_close(flow, torch.tensor([-FOCAL / 4 * 0.2, 0.0]).expand(63, 2), atol=1e-4, rtol=0)


def test_points_outside_the_target_or_hidden_there_are_not_visible() -> None:
    depth, poses = sideways_over_a_plane()
    depth[:, 1, :, :36] = 0.5
    true = true_matches(depth, poses, torch.tensor([FOCAL]), *pair())
    # In cells from the corner: the left half of the target (x < 9) shows something nearer.
    landed = true.positions[0, :, 0] + SIZE[1] / 8
    expected = (landed >= 9) & (landed < 18)
    assert torch.equal(true.visible[0], expected)
    assert 0 < int(expected.sum()) < 63


def test_true_matches_through_the_solver_give_the_true_motion() -> None:
    random = torch.Generator().manual_seed(0)
    depth = (0.7 + 0.6 * torch.rand(1, 1, *SIZE, generator=random)).expand(1, 2, *SIZE)
    poses = torch.eye(4).repeat(1, 2, 1, 1)
    poses[0, 1, :3, :3] = rotation_exponential(torch.tensor([0.02, -0.05, 0.03]))
    poses[0, 1, :3, 3] = torch.tensor([0.05, 0.02, -0.04])
    true = true_matches(depth, poses, torch.tensor([FOCAL]), *pair())
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
    true = true_matches(depth, poses, torch.tensor([FOCAL]), *pair())
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
