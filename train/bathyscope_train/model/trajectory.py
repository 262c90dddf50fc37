"""Camera trajectory of a clip from motions between pairs of frames.

Frame k is reached from frames k - 1, k - 2 and k - 4. The estimate from k - 1 alone is a chain of products;
the other two correct it, each direction of each correction weighted by its information. Written frame by
frame this is a recurrence: ``d_k = sum_g W_g (A_g d_{k-g} + m_g)``, with ``d_k`` the small motion that
corrects the chain at frame k, ``m_g`` the disagreement of the pair (k - g, k) with the chain, ``A_g`` the
adjoint of the pair's motion and ``W_g`` the information weights. Both the chain and the (affine) recurrence are
evaluated by doubling, in log2(t) parallel steps: the graph has no loop and works at any clip length up to
:data:`LONGEST_CLIP`. Loop pairs then pull on all frames at once (:mod:`.pose_graph`).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bathyscope_train.model.pose_layer import Motion, solve_columns
from bathyscope_train.model.rigid import adjoint, compose, inverse, rotate, rotation_exponential, rotation_logarithm

GAPS = (1, 2, 4)
"""Distances, in frames, of the pairs that the recurrence runs over."""

GROUPS = 4
"""Pairs that start in each frame: to k + 1, back to k - 2, to k + 4, and to its mirror image in the clip."""

LONGEST_CLIP = 128
"""Frames that seven doublings reach; longer videos are cut into windows long before."""

_DOUBLINGS = 7
_TINY_INFORMATION = 1e-4


@dataclass(frozen=True, slots=True)
class ClipPairs:
    """All pairs of a clip, group by group, in each group one that starts in each frame."""

    source: Int[Tensor, "e"]
    target: Int[Tensor, "e"]
    inside: Float[Tensor, "e"]
    """1 where source and target are two frames of the clip, 0 where the target had to be moved into it."""


def clip_pairs(frames: int, device: torch.device | None = None) -> ClipPairs:
    """The pairs of a clip: neighbours, both directions of time, and loops.

    Every frame starts a pair forwards, one backwards and one to the frame as far from the clip's end as it is from
    its beginning, so every depth can be checked by parallax and the ends of a clip are tied together. There are
    always 4 t pairs, at t = 1 too, and the count is a plain multiple of t in an exported graph.
    """
    source = torch.arange(frames, device=device)
    wanted = (source + 1, source - 2, source + 4, frames - 1 - source)
    targets = [each.clamp(0, frames - 1) for each in wanted]
    inside = [(each == kept) & (each != source) for each, kept in zip(wanted, targets, strict=True)]
    return ClipPairs(torch.cat([source] * GROUPS), torch.cat(targets), torch.cat(inside).to(torch.float32))


def fuse_trajectory(motion: Motion, information: Float[Tensor, "b e 6 6"]) -> Motion:
    """Camera-from-first-camera motion of each frame, from the motions of :func:`clip_pairs` but for the loops.

    Args:
        motion: Target-from-source motions, (b, 4 t, ...), group-major.
        information: How far each direction of each motion may be trusted.

    Returns:
        Motions (b, t, ...) that map points of camera 0 into camera k; the first is the identity.
    """
    frames = information.shape[1] // GROUPS
    arriving = _arriving(motion, information)
    first = arriving[0][0]
    chain = chain_motions(first)
    weights, offsets = [], []
    index = torch.arange(frames, device=information.device)
    inside = [(index >= gap).to(information.dtype)[:, None, None] for gap in GAPS]
    identity = torch.eye(6, dtype=information.dtype, device=information.device)
    trusted = [arriving[n][1] * inside[n] for n in range(len(GAPS))]
    trusted[0] = trusted[0] + _TINY_INFORMATION * identity
    shares = solve_columns(trusted[0] + trusted[1] + trusted[2], torch.cat(trusted, -1)).split(6, -1)
    for n, gap in enumerate(GAPS):
        pair = arriving[n][0]
        source = (index - gap).clamp_min(0)
        reached = compose((pair.rotation, pair.translation), (chain.rotation[:, source], chain.translation[:, source]))
        disagreement = difference(Motion(*reached), chain)
        share = shares[n] * inside[n]
        weights.append(share @ adjoint(pair.rotation, pair.translation))
        offsets.append(rotate(share, disagreement))
    correction = _affine_recurrence(weights, offsets[0] + offsets[1] + offsets[2])
    return move(correction, chain)


def follow_steps(motion: Motion) -> Motion:
    """The motions of :func:`clip_pairs`, those over four frames and of loops replaced by the steps between their ends.

    What a point of a far frame did may be more than one look can find; the steps from frame to frame lead there.

    Args:
        motion: Target-from-source motions, (b, 4 t, ...), group-major.
    """
    frames = motion.translation.shape[1] // GROUPS
    index = torch.arange(frames, device=motion.translation.device)
    arriving = (index - 1).clamp_min(0)
    path = chain_motions(Motion(motion.rotation[:, arriving], motion.translation[:, arriving]))
    pairs = clip_pairs(frames, motion.translation.device)
    source, target = pairs.source[2 * frames :], pairs.target[2 * frames :]
    back = inverse((path.rotation[:, source], path.translation[:, source]))
    far = compose((path.rotation[:, target], path.translation[:, target]), back)
    near = 2 * frames
    return Motion(
        torch.cat([motion.rotation[:, :near], far[0]], 1), torch.cat([motion.translation[:, :near], far[1]], 1)
    )


def move(step: Float[Tensor, "*b 6"], motion: Motion) -> Motion:
    """``motion``, then the small motion ``step`` (translation, rotation vector)."""
    turn = rotation_exponential(step[..., 3:])
    return Motion(*compose((turn, step[..., :3]), (motion.rotation, motion.translation)))


def difference(reached: Motion, base: Motion) -> Float[Tensor, "*b 6"]:
    """Small motion (translation, rotation vector) that takes ``base`` to ``reached`` from the left."""
    turn = reached.rotation @ base.rotation.transpose(-1, -2)
    return torch.cat([reached.translation - rotate(turn, base.translation), rotation_logarithm(turn)], -1)


def _arriving(motion: Motion, information: Float[Tensor, "b e 6 6"]) -> list[tuple[Motion, Float[Tensor, "b t 6 6"]]]:
    """For each gap g the motions (k - g, k) at index k, with their information; meaningless where k < g."""
    frames = information.shape[1] // GROUPS
    rotations = motion.rotation.unflatten(1, (GROUPS, frames))
    translations = motion.translation.unflatten(1, (GROUPS, frames))
    informations = information.unflatten(1, (GROUPS, frames))
    index = torch.arange(frames, device=information.device)
    found = []
    for group, gap in ((0, 1), (1, 2), (2, 4)):
        pair = Motion(rotations[:, group], translations[:, group])
        weight = informations[:, group]
        if group == 1:  # measured from k to k - 2: M = exp(d) M* has the inverse M*^-1 exp(-d)
            carried = adjoint(pair.rotation, pair.translation)
            weight = carried.transpose(-1, -2) @ weight @ carried
            pair = Motion(*inverse((pair.rotation, pair.translation)))
        else:
            start = (index - gap).clamp_min(0)
            pair, weight = Motion(pair.rotation[:, start], pair.translation[:, start]), weight[:, start]
        found.append((pair, weight))
    return found


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
