"""Camera trajectory of a clip from motions between pairs of frames.

Frame k is reached from frames k - 1, k - 2 and k - 4. The estimate from k - 1 alone is a chain of products;
the other two correct it, each direction of each correction weighted by its information. Written frame by
frame this is a recurrence: ``d_k = sum_g W_g (A_g d_{k-g} + m_g)``, with ``d_k`` the small motion that
corrects the chain at frame k, ``m_g`` the disagreement of the pair (k - g, k) with the chain, ``A_g`` the
adjoint of the pair's motion and ``W_g`` the information weights. Both the chain and the (affine) recurrence are
evaluated by doubling, in log2(t) parallel steps: the graph has no loop and works at any clip length up to
:data:`LONGEST_CLIP`.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bathyscope_train.model.pose_layer import Motion, solve_positive
from bathyscope_train.model.rigid import adjoint, compose, rotate, rotation_exponential, rotation_logarithm

GAPS = (1, 2, 4)
"""Distances, in frames, between the frames of a pair."""

LONGEST_CLIP = 128
"""Frames that seven doublings reach; longer videos are cut into windows long before."""

_DOUBLINGS = 7
_TINY_INFORMATION = 1e-4


def clip_pairs(frames: int, device: torch.device | None = None) -> tuple[Int[Tensor, "e"], Int[Tensor, "e"]]:
    """Source and target frames of all pairs of a clip: for each gap, one pair that ends in each frame.

    Pairs that would start before the clip start at frame 0 and are ignored by :func:`fuse_trajectory`. So
    there are always 3 t pairs, at t = 1 too, and the count is a plain multiple of t in an exported graph.
    """
    target = torch.arange(frames, device=device)
    sources = [(target - gap).clamp_min(0) for gap in GAPS]
    return torch.cat(sources), torch.cat([target] * len(GAPS))


def fuse_trajectory(motion: Motion, information: Float[Tensor, "b e 6 6"]) -> Motion:
    """Camera-from-first-camera motion of each frame, from the motions of :func:`clip_pairs`.

    Args:
        motion: Target-from-source motions, (b, 3 t, ...), gap-major.
        information: How far each direction of each motion may be trusted.

    Returns:
        Motions (b, t, ...) that map points of camera 0 into camera k; the first is the identity.
    """
    frames = information.shape[1] // len(GAPS)
    rotations = motion.rotation.unflatten(1, (len(GAPS), frames))
    translations = motion.translation.unflatten(1, (len(GAPS), frames))
    chain = chain_motions(Motion(rotations[:, 0], translations[:, 0]))
    weights, offsets = [], []
    index = torch.arange(frames, device=information.device)
    per_gap = information.unflatten(1, (len(GAPS), frames))
    inside = [(index >= gap).to(information.dtype)[:, None, None] for gap in GAPS]
    identity = torch.eye(6, dtype=information.dtype, device=information.device)
    trusted = [per_gap[:, n] * inside[n] for n in range(len(GAPS))]
    total = trusted[0] + trusted[1] + trusted[2] + _TINY_INFORMATION * identity
    for n, gap in enumerate(GAPS):
        pair = Motion(rotations[:, n], translations[:, n])
        source = (index - gap).clamp_min(0)
        reached = compose((pair.rotation, pair.translation), (chain.rotation[:, source], chain.translation[:, source]))
        disagreement = _difference(Motion(*reached), chain)
        share = trusted[n] if gap > 1 else trusted[n] + _TINY_INFORMATION * identity
        share = _solve_columns(total, share) * inside[n]
        weights.append(share @ adjoint(pair.rotation, pair.translation))
        offsets.append(rotate(share, disagreement))
    correction = _affine_recurrence(weights, offsets[0] + offsets[1] + offsets[2])
    turn = rotation_exponential(correction[..., 3:])
    return Motion(*compose((turn, correction[..., :3]), (chain.rotation, chain.translation)))


def chain_motions(steps: Motion) -> Motion:
    """Products of the first 1, 2, ... steps of (b, t, ...); the first step, which leads nowhere, is ignored."""
    rotation, translation = steps.rotation, steps.translation
    index = torch.arange(translation.shape[1], device=translation.device)
    identity = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    moving = (index > 0).to(rotation.dtype)[:, None]
    translation = translation * moving
    rotation = rotation * moving[..., None] + identity * (1 - moving[..., None])
    for doubling in range(_DOUBLINGS):
        source = (index - 2**doubling).clamp_min(0)
        # Before the clip there is frame 0, whose own product is the identity: clamping is exact.
        rotation, translation = compose((rotation, translation), (rotation[:, source], translation[:, source]))
    return Motion(rotation, translation)


def _difference(reached: Motion, base: Motion) -> Float[Tensor, "b t 6"]:
    """Small motion (translation, rotation vector) that takes ``base`` to ``reached`` from the left."""
    turn = reached.rotation @ base.rotation.transpose(-1, -2)
    return torch.cat([reached.translation - rotate(turn, base.translation), rotation_logarithm(turn)], -1)


def _solve_columns(matrix: Float[Tensor, "b t 6 6"], columns: Float[Tensor, "b t 6 6"]) -> Float[Tensor, "b t 6 6"]:
    """``matrix^-1 columns`` for a symmetric positive definite matrix."""
    solved = solve_positive(matrix[..., None, :, :].expand(*matrix.shape[:-2], 6, 6, 6), columns.transpose(-1, -2))
    return solved.transpose(-1, -2)


def _affine_recurrence(weights: list[Float[Tensor, "b t 6 6"]], offset: Float[Tensor, "b t 6"]) -> Tensor:
    """``d_k = sum_n weights[n]_k d_{k - GAPS[n]} + offset_k`` with d = 0 before the clip, by doubling.

    The state of frame k is (d_k, d_{k-1}, d_{k-2}, d_{k-3}, 1); one step is a 25x25 matrix. Weights of
    gaps that start before the clip must be zero.
    """
    first, second, fourth = weights
    zero = torch.zeros_like(first)
    top = torch.cat([first, second, zero, fourth, offset[..., None]], -1)
    shift = torch.eye(25, dtype=top.dtype, device=top.device)
    lower = torch.cat([shift[:18], shift[24:]]).expand(*top.shape[:2], 19, 25)
    step = torch.cat([top, lower], -2)
    index = torch.arange(top.shape[1], device=top.device)
    for doubling in range(_DOUBLINGS):
        distance = 2**doubling
        source = (index - distance).clamp_min(0)
        inside = (index >= distance).to(top.dtype)[:, None, None]
        step = step @ (step[:, source] * inside + shift * (1 - inside))
    # The state before the clip is (0, 0, 0, 0, 1).
    return step[..., :6, 24]
