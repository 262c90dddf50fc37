"""Training windows: a few frames of a rendered clip with their truth, cut, flipped and recoloured at random."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from bathyscope.errors import DatasetError


@dataclass(frozen=True, slots=True)
class TruthClip:
    """A clip with ground truth, in memory."""

    frames: UInt8[Tensor, "t 3 h w"]
    depth: Float[Tensor, "t h w"]
    """0 where unknown."""
    world_from_camera: Float[Tensor, "t 4 4"]
    focal: float
    """In pixels; square pixels, principal point at the centre of the image."""
    name: str
    moving: Bool[Tensor, "t h w"] | None = None
    """Pixels whose motion is not the camera's; None for nowhere."""
    distortion: tuple[float, float] = (0.0, 0.0)
    """Radial, of normalised coordinates: 1 + k1 r^2 + k2 r^4."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Windows of t frames. Lengths in units of each window's mean true depth; frame 0 is the identity."""

    images: Float[Tensor, "b t 3 h w"]
    depth: Float[Tensor, "b t h w"]
    valid: Bool[Tensor, "b t h w"]
    world_from_camera: Float[Tensor, "b t 4 4"]
    focal: Float[Tensor, "b"]
    moving: Bool[Tensor, "b t h w"]
    """Pixels whose motion is not the camera's."""
    distortion: Float[Tensor, "b 2"]
    """Radial distortion k1, k2 of the lens."""


@dataclass(frozen=True, slots=True)
class Augmentation:
    """How far a window may be changed; see :func:`sample_window`."""

    crop: float = 0.7
    """Smallest side of a central crop, as a share of the image's: narrows the field of view."""
    crop_chance: float = 0.4
    gamma: tuple[float, float] = (0.75, 1.35)
    gain: tuple[float, float] = (0.85, 1.15)
    tint: float = 0.06
    """Largest relative change of one colour channel against the others."""
    slow_chance: float = 0.15
    """Share of windows that repeat frames, as a camera that stands still does."""


def cut_window(clip: TruthClip, index: Sequence[int]) -> Batch:
    """The frames ``index`` of a clip, unchanged, as a batch of one.

    Raises:
        DatasetError: If no pixel of these frames has a depth.
    """
    chosen = list(index)
    depth = clip.depth[chosen]
    valid = depth > 0
    if not valid.any():
        raise DatasetError(f"clip {clip.name}: frames {chosen} have no depth")
    poses = clip.world_from_camera[chosen]
    return scaled(
        Batch(
            images=clip.frames[chosen][None].float() / 255,
            depth=depth[None],
            valid=valid[None],
            world_from_camera=(torch.linalg.inv(poses[0].double()) @ poses.double()).float()[None],
            focal=torch.tensor([clip.focal]),
            moving=torch.zeros_like(valid)[None] if clip.moving is None else clip.moving[chosen][None],
            distortion=torch.tensor([clip.distortion]),
        )
    )


def sample_window(
    clip: TruthClip, random: np.random.Generator, *, frames: int = 8, augmentation: Augmentation | None = None
) -> Batch:
    """A random window of a clip: stride 1 or 2 or standing still at times, either direction of time, augmented."""
    augmentation = augmentation or Augmentation()
    batch = cut_window(clip, draw_index(len(clip.frames), frames, random, augmentation.slow_chance))
    if random.random() < 0.5:
        batch = mirror(batch, axis=0)
    if random.random() < 0.5:
        batch = mirror(batch, axis=1)
    if random.random() < augmentation.crop_chance:
        batch = crop_centre(batch, float(random.uniform(augmentation.crop, 1.0)))
    return recolour(batch, random, augmentation)


def stack(windows: Sequence[Batch]) -> Batch:
    """One batch of several windows of equal size."""
    names = [field.name for field in fields(Batch)]
    return Batch(*(torch.cat([getattr(window, name) for window in windows]) for name in names))


def to_device(batch: Batch, device: torch.device) -> Batch:
    """The same windows on a device."""
    return Batch(*(getattr(batch, field.name).to(device) for field in fields(Batch)))


def mirror(batch: Batch, *, axis: int) -> Batch:
    """The same world in a mirror: ``axis`` 0 swaps left and right, 1 top and bottom."""
    flip = torch.eye(4).to(batch.world_from_camera)
    flip[axis, axis] = -1
    dim = -1 - axis
    return replace(
        batch,
        images=batch.images.flip(dim),
        depth=batch.depth.flip(dim),
        valid=batch.valid.flip(dim),
        world_from_camera=flip @ batch.world_from_camera @ flip,
        moving=batch.moving.flip(dim),
    )


def crop_centre(batch: Batch, share: float | Float[Tensor, "b"]) -> Batch:
    """The central ``share`` of each side, resized to the old size: a narrower field of view, exact truth.

    Images are sampled bilinearly, depth at the nearest pixel. A window that would show no depth stays as it is.
    """
    b, t, _, height, width = batch.images.shape
    share = torch.as_tensor(share, dtype=batch.depth.dtype, device=batch.depth.device).expand(b)
    x = torch.linspace(-1 + 1 / width, 1 - 1 / width, width, device=share.device)
    y = torch.linspace(-1 + 1 / height, 1 - 1 / height, height, device=share.device)
    grid = torch.stack([x.expand(height, width), y[:, None].expand(height, width)], -1)
    grid = (grid * share[:, None, None, None]).repeat_interleave(t, 0)
    images = F.grid_sample(batch.images.flatten(0, 1), grid, align_corners=False)
    labels = torch.stack([batch.depth, batch.moving.to(batch.depth.dtype)], 2).flatten(0, 1)
    labels = F.grid_sample(labels, grid, mode="nearest", align_corners=False).unflatten(0, (b, t))
    depth = labels[:, :, 0]
    cropped = replace(
        batch,
        images=images.unflatten(0, (b, t)),
        depth=depth,
        valid=depth > 0,
        focal=batch.focal / share,
        moving=labels[:, :, 1] > 0,
    )
    return choose((depth > 0).flatten(1).any(1), scaled(cropped), batch)


def choose(flags: Bool[Tensor, "b"], first: Batch, second: Batch) -> Batch:
    """Windows of ``first`` where the flag is set, of ``second`` elsewhere."""
    pairs = [(getattr(first, field.name), getattr(second, field.name)) for field in fields(Batch)]
    return Batch(*(torch.where(flags.view(-1, *(1,) * (a.ndim - 1)), a, b) for a, b in pairs))


def scaled(batch: Batch) -> Batch:
    """Lengths in units of each window's mean depth."""
    count = batch.valid.sum((1, 2, 3)).clamp_min(1)
    mean = batch.depth.sum((1, 2, 3)) / count
    mean = torch.where(mean > 0, mean, 1.0)
    poses = batch.world_from_camera.clone()
    poses[:, :, :3, 3] /= mean[:, None, None]
    return replace(batch, depth=batch.depth / mean[:, None, None, None], world_from_camera=poses)


def draw_index(length: int, frames: int, random: np.random.Generator, slow_chance: float) -> list[int]:
    """Frame numbers of a window, forwards or backwards in time."""
    if random.random() < slow_chance or length < frames:
        span = int(random.integers(1, min(frames, length) + 1))
        start = int(random.integers(0, length - span + 1))
        index = start + np.sort(random.integers(0, span, frames))
    else:
        stride = int(random.integers(1, 3))
        stride = stride if (frames - 1) * stride < length else 1
        start = int(random.integers(0, length - (frames - 1) * stride))
        index = start + stride * np.arange(frames)
    return [int(k) for k in (index if random.random() < 0.5 else index[::-1])]


def recolour(batch: Batch, random: np.random.Generator, augmentation: Augmentation) -> Batch:
    """One gamma, gain and tint for each window."""
    count = len(batch.images)
    gamma, gain = random.uniform(*augmentation.gamma, count), random.uniform(*augmentation.gain, count)
    tint = 1 + random.uniform(-augmentation.tint, augmentation.tint, (count, 3))
    exponent = torch.from_numpy(gamma).to(batch.images)[:, None, None, None, None]
    factor = torch.from_numpy(gain[:, None] * tint).to(batch.images)[:, None, :, None, None]
    return replace(batch, images=(batch.images.clamp_min(1e-4).pow(exponent) * factor).clamp(0, 1))
