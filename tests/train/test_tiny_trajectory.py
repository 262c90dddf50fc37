"""The trajectory by doubling agrees with the same recurrence written frame by frame."""

import pytest
import torch

from bathyscope_train.model.pose_graph import settle_trajectory
from bathyscope_train.model.pose_layer import Motion
from bathyscope_train.model.rigid import (
    adjoint,
    compose,
    inverse,
    relative_motion,
    rotate,
    rotation_exponential,
    rotation_logarithm,
)
from bathyscope_train.model.trajectory import (
    GAPS,
    GROUPS,
    chain_motions,
    clip_pairs,
    follow_steps,
    fuse_trajectory,
)


def camera_path(frames: int) -> torch.Tensor:
    """World-from-camera poses (frames, 4, 4) along a bent path; the first is the identity."""
    poses = torch.eye(4).repeat(frames, 1, 1)
    rotation, position = torch.eye(3), torch.zeros(3)
    for k in range(1, frames):
        position = position + rotation @ torch.tensor([0.02, 0.01 * (k % 3), 0.05])
        rotation = rotation @ rotation_exponential(torch.tensor([0.02, -0.03 + 0.004 * k, 0.01]))
        poses[k, :3, :3], poses[k, :3, 3] = rotation, position
    return poses


def clip_motions(poses: torch.Tensor, noise: float = 0.0) -> Motion:
    """Motions of all pairs of a clip, (1, 4 t, ...), each disturbed."""
    pairs = clip_pairs(len(poses))
    rotation, translation = relative_motion(poses, pairs.source, pairs.target)
    random = torch.Generator().manual_seed(len(poses))
    turn = rotation_exponential(noise * torch.randn(len(pairs.source), 3, generator=random))
    shift = noise * torch.randn(len(pairs.source), 3, generator=random)
    rotation, translation = compose((turn, shift), (rotation, translation))
    return Motion(rotation[None], translation[None])


def informations(pairs: int) -> torch.Tensor:
    """Random positive definite matrices (1, pairs, 6, 6)."""
    root = torch.randn(pairs, 6, 6, generator=torch.Generator().manual_seed(5))
    return (root @ root.transpose(1, 2) + 0.5 * torch.eye(6))[None]


def fuse_in_sequence(motion: Motion, information: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Frame k from the information-weighted mean of what frames k - 1, k - 2 and k - 4 say, one after the other."""
    frames = information.shape[1] // GROUPS
    reached = [(torch.eye(3), torch.zeros(3))]
    for k in range(1, frames):
        total, weighted, base = torch.zeros(6, 6), torch.zeros(6), None
        for n, gap in enumerate(GAPS):
            if gap > k:
                continue
            start = n * frames + (k if gap == 2 else k - gap)  # pairs over two frames are measured backwards
            pair, trusted = (motion.rotation[0, start], motion.translation[0, start]), information[0, start]
            if gap == 2:
                carried = adjoint(*pair)
                pair, trusted = inverse(pair), carried.T @ trusted @ carried
            candidate = compose(pair, reached[k - gap])
            base = base or candidate
            turn = candidate[0] @ base[0].T
            difference = torch.cat([candidate[1] - rotate(turn, base[1]), rotation_logarithm(turn)])
            total += trusted
            weighted += trusted @ difference
        mean = torch.linalg.solve(total, weighted)
        assert base is not None
        reached.append(compose((rotation_exponential(mean[3:]), mean[:3]), base))
    return reached


@pytest.mark.parametrize("frames", [1, 2, 3, 8, 33])
def test_exact_motions_give_the_exact_path(frames: int) -> None:
    poses = camera_path(frames)
    fused = fuse_trajectory(clip_motions(poses), informations(4 * frames))
    expected = torch.linalg.inv(poses)
    torch.testing.assert_close(fused.rotation[0], expected[:, :3, :3], atol=2e-4, rtol=0)
    torch.testing.assert_close(fused.translation[0], expected[:, :3, 3], atol=5e-4, rtol=0)


def test_the_first_camera_is_exactly_the_identity() -> None:
    fused = fuse_trajectory(clip_motions(camera_path(6), noise=0.01), informations(24))
    assert torch.equal(fused.translation[0, 0], torch.zeros(3))
    torch.testing.assert_close(fused.rotation[0, 0], torch.eye(3), atol=1e-7, rtol=0)


@pytest.mark.parametrize("frames", [4, 9, 20])
def test_disturbed_motions_are_fused_as_frame_by_frame(frames: int) -> None:
    motion, information = clip_motions(camera_path(frames), noise=0.003), informations(4 * frames)
    fused = fuse_trajectory(motion, information)
    expected = fuse_in_sequence(motion, information)
    # The recurrence is linearised about the chain, so they agree to second order in disturbances of 0.003.
    torch.testing.assert_close(fused.rotation[0], torch.stack([r for r, _ in expected]), atol=1e-3, rtol=0)
    torch.testing.assert_close(fused.translation[0], torch.stack([t for _, t in expected]), atol=1e-3, rtol=0)


def test_the_fusion_is_closer_to_the_true_path_than_the_chain() -> None:
    poses = camera_path(24)
    motion = clip_motions(poses, noise=0.01)
    equal = torch.eye(6).expand(1, 96, 6, 6)
    fused = fuse_trajectory(motion, equal)
    neighbours = (torch.arange(24) - 1).clamp_min(0)  # group 0 starts in each frame
    chain = chain_motions(Motion(motion.rotation[:, neighbours], motion.translation[:, neighbours]))
    expected = torch.linalg.inv(poses)[:, :3, 3]
    error, chained = ((each.translation[0] - expected).norm(dim=-1).mean() for each in (fused, chain))
    assert error < 0.7 * chained


def test_every_frame_starts_pairs_in_both_directions_of_time_and_a_loop() -> None:
    pairs = clip_pairs(8)
    counted = {(int(i), int(j)) for i, j, w in zip(pairs.source, pairs.target, pairs.inside, strict=True) if w}
    neighbours = {(k, k + 1) for k in range(7)} | {(k, k - 2) for k in range(2, 8)} | {(k, k + 4) for k in range(4)}
    assert counted == neighbours | {(k, 7 - k) for k in range(8)}
    assert not clip_pairs(1).inside.any()


def test_far_pairs_follow_the_steps_between_their_ends() -> None:
    """Whatever was found for them; near pairs keep what was found."""
    exact = clip_motions(camera_path(9))
    found = Motion(exact.rotation.clone(), exact.translation.clone())
    found.translation[:, 18:] += 5.0
    followed = follow_steps(found)
    inside = clip_pairs(9).inside.bool()
    torch.testing.assert_close(followed.translation[:, inside], exact.translation[:, inside], atol=1e-5, rtol=0)
    torch.testing.assert_close(followed.rotation[:, inside], exact.rotation[:, inside], atol=1e-5, rtol=0)
    found.translation[:, :18] += 0.1
    assert torch.equal(follow_steps(found).translation[:, :18], found.translation[:, :18])


def end_error(found: Motion, poses: torch.Tensor) -> torch.Tensor:
    """Distance of the last frame's translation from that of the true path."""
    return (found.translation[0, -1] - torch.linalg.inv(poses)[-1, :3, 3]).norm()


def test_loops_pull_the_end_of_a_drifted_path_towards_the_true_one() -> None:
    """Neighbours lie, all in the same direction; the loops are exact and know it."""
    poses = camera_path(16)
    motion = clip_motions(poses)
    motion.translation[:, :16] += torch.tensor([0.02, 0.0, 0.0])
    information = torch.eye(6).repeat(1, 64, 1, 1)
    information[:, 48:] = 100 * torch.eye(6)
    drifted = fuse_trajectory(motion, information)
    settled = settle_trajectory(drifted, motion, information, clip_pairs(16))
    assert end_error(drifted, poses) > 0.05
    assert end_error(settled, poses) < 0.2 * end_error(drifted, poses)
    assert torch.equal(settled.translation[0, 0], torch.zeros(3))


def test_a_loop_that_contradicts_everything_is_ignored() -> None:
    poses = camera_path(16)
    motion = clip_motions(poses)
    motion.translation[:, 48:] += torch.tensor([0.0, 3.0, 0.0])
    information = 100 * torch.eye(6).repeat(1, 64, 1, 1)
    settled = settle_trajectory(fuse_trajectory(motion, information), motion, information, clip_pairs(16))
    assert end_error(settled, poses) < 0.02


def test_settling_solves_the_linear_system_of_all_pairs() -> None:
    """Against a dense solver, on a path and measurements so close that linearising is exact enough."""
    frames = 5
    poses, pairs = camera_path(frames), clip_pairs(frames)
    motion = clip_motions(poses, noise=1e-3)
    information = 0.1 * informations(4 * frames) + 5 * torch.eye(6)  # conditioned well enough for eight steps
    start = fuse_trajectory(clip_motions(poses), information)
    measured = Motion(motion.rotation.double(), motion.translation.double())
    path = Motion(start.rotation.double(), start.translation.double())
    settled = settle_trajectory(path, measured, information.double(), pairs)
    matrix, vector = torch.zeros(6 * frames, 6 * frames).double(), torch.zeros(6 * frames).double()
    for n, (i, j) in enumerate(zip(pairs.source.tolist(), pairs.target.tolist(), strict=True)):
        pair = (measured.rotation[0, n], measured.translation[0, n])
        reached = compose(pair, (path.rotation[0, i], path.translation[0, i]))
        turn = reached[0] @ path.rotation[0, j].T
        offset = torch.cat([reached[1] - rotate(turn, path.translation[0, j]), rotation_logarithm(turn)])
        weight = information[0, n].double() * pairs.inside[n] / (1 + offset @ information[0, n].double() @ offset)
        jacobian = torch.zeros(6, 6 * frames).double()
        jacobian[:, 6 * i : 6 * i + 6] += adjoint(*pair)
        jacobian[:, 6 * j : 6 * j + 6] -= torch.eye(6)
        matrix += jacobian.T @ weight @ jacobian
        vector -= jacobian.T @ weight @ offset
    steps = torch.linalg.solve(matrix[6:, 6:], vector[6:]).reshape(frames - 1, 6)
    moved = compose((rotation_exponential(steps[:, 3:]), steps[:, :3]), (path.rotation[0, 1:], path.translation[0, 1:]))
    torch.testing.assert_close(settled.translation[0, 1:], moved[1], atol=5e-5, rtol=0)
    torch.testing.assert_close(settled.rotation[0, 1:], moved[0], atol=5e-5, rtol=0)
