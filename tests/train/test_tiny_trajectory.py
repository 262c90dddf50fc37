"""The trajectory by doubling agrees with the same recurrence written frame by frame."""

import pytest
import torch

from bathyscope_train.model.pose_layer import Motion
from bathyscope_train.model.rigid import compose, relative_motion, rotate, rotation_exponential, rotation_logarithm
from bathyscope_train.model.trajectory import GAPS, chain_motions, clip_pairs, fuse_trajectory


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
    """Motions of all pairs of a clip, (1, 3 t, ...), each disturbed."""
    source, target = clip_pairs(len(poses))
    rotation, translation = relative_motion(poses, source, target)
    random = torch.Generator().manual_seed(len(poses))
    turn = rotation_exponential(noise * torch.randn(len(source), 3, generator=random))
    shift = noise * torch.randn(len(source), 3, generator=random)
    rotation, translation = compose((turn, shift), (rotation, translation))
    return Motion(rotation[None], translation[None])


def informations(pairs: int) -> torch.Tensor:
    """Random positive definite matrices (1, pairs, 6, 6)."""
    root = torch.randn(pairs, 6, 6, generator=torch.Generator().manual_seed(5))
    return (root @ root.transpose(1, 2) + 0.5 * torch.eye(6))[None]


def fuse_in_sequence(motion: Motion, information: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Frame k from the information-weighted mean of what frames k - 1, k - 2 and k - 4 say, one after the other."""
    frames = information.shape[1] // 3
    reached = [(torch.eye(3), torch.zeros(3))]
    for k in range(1, frames):
        total, weighted, base = torch.zeros(6, 6), torch.zeros(6), None
        for n, gap in enumerate(GAPS):
            if gap > k:
                continue
            pair = (motion.rotation[0, n * frames + k], motion.translation[0, n * frames + k])
            candidate = compose(pair, reached[k - gap])
            base = base or candidate
            turn = candidate[0] @ base[0].T
            difference = torch.cat([candidate[1] - rotate(turn, base[1]), rotation_logarithm(turn)])
            total += information[0, n * frames + k]
            weighted += information[0, n * frames + k] @ difference
        mean = torch.linalg.solve(total, weighted)
        assert base is not None
        reached.append(compose((rotation_exponential(mean[3:]), mean[:3]), base))
    return reached


@pytest.mark.parametrize("frames", [1, 2, 3, 8, 33])
def test_exact_motions_give_the_exact_path(frames: int) -> None:
    poses = camera_path(frames)
    fused = fuse_trajectory(clip_motions(poses), informations(3 * frames))
    expected = torch.linalg.inv(poses)
    torch.testing.assert_close(fused.rotation[0], expected[:, :3, :3], atol=2e-4, rtol=0)
    torch.testing.assert_close(fused.translation[0], expected[:, :3, 3], atol=5e-4, rtol=0)


def test_the_first_camera_is_exactly_the_identity() -> None:
    fused = fuse_trajectory(clip_motions(camera_path(6), noise=0.01), informations(18))
    assert torch.equal(fused.translation[0, 0], torch.zeros(3))
    torch.testing.assert_close(fused.rotation[0, 0], torch.eye(3), atol=1e-7, rtol=0)


@pytest.mark.parametrize("frames", [4, 9, 20])
def test_disturbed_motions_are_fused_as_frame_by_frame(frames: int) -> None:
    motion, information = clip_motions(camera_path(frames), noise=0.003), informations(3 * frames)
    fused = fuse_trajectory(motion, information)
    expected = fuse_in_sequence(motion, information)
    # The recurrence is linearised about the chain, so they agree to second order in disturbances of 0.003.
    torch.testing.assert_close(fused.rotation[0], torch.stack([r for r, _ in expected]), atol=1e-3, rtol=0)
    torch.testing.assert_close(fused.translation[0], torch.stack([t for _, t in expected]), atol=1e-3, rtol=0)


def test_the_fusion_is_closer_to_the_true_path_than_the_chain() -> None:
    poses = camera_path(24)
    motion = clip_motions(poses, noise=0.01)
    equal = torch.eye(6).expand(1, 72, 6, 6)
    fused = fuse_trajectory(motion, equal)
    chain = chain_motions(Motion(motion.rotation[:, :24], motion.translation[:, :24]))
    expected = torch.linalg.inv(poses)[:, :3, 3]
    error, chained = ((each.translation[0] - expected).norm(dim=-1).mean() for each in (fused, chain))
    assert error < 0.7 * chained
