"""What reaches the chip, in torch: the scene through smoke, out of focus, moving while the shutter is open.

See ``haze``, ``focus`` and ``shutter`` for the equations. Effects that a clip does not have cost it nothing.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.data.synthetic.focus import _LARGEST_PX as LARGEST_PX
from bathyscope_train.data.synthetic.focus import _LEAST_PX as LEAST_BLUR_PX
from bathyscope_train.data.synthetic.focus import _STEPS as STEPS
from bathyscope_train.data.synthetic.haze import _LEAST as LEAST_DENSITY
from bathyscope_train.data.synthetic.optics import Sensor
from bathyscope_train.data.synthetic.shutter import _LEAST_PX as LEAST_MOTION_PX
from bathyscope_train.data.synthetic.shutter import _MOST_PX as MOST_PX
from bathyscope_train.data.synthetic.shutter import _TAPS as TAPS
from bathyscope_train.data.synthetic.torch_filters import blur
from bathyscope_train.data.synthetic.torch_lens import distort, undistort
from bathyscope_train.data.synthetic.torch_metering import masked_percentile, metered, per_clip, views

Clips = Float[Tensor, "b t 3 h w"]
Depths = Float[Tensor, "b t h w"]
Motions = Float[Tensor, "b t 2 h w"]


def on_some(clips: Clips, on: Sequence[bool], change: Callable[[Clips, list[int]], Clips]) -> Clips:
    """Change the clips that are marked; ``change`` gets them and their numbers."""
    chosen = [index for index, marked in enumerate(on) if marked]
    if not chosen:
        return clips
    if len(chosen) == len(clips):
        return change(clips, chosen)
    return clips.index_copy(0, torch.tensor(chosen, device=clips.device), change(clips[chosen], chosen))


def form_images(
    radiance: Clips, depth: Depths, motion: Callable[[list[int]], Motions], focal_px: Sequence[float],
    sensors: Sequence[Sensor],
) -> Clips:  # fmt: skip
    """Send clips through the air, the lens and the shutter.

    Args:
        radiance: Of the scene.
        depth: In millimetres.
        motion: Of the clips with these numbers: pixels that the content moves until the next frame.
        focal_px: Focal length of each clip.
        sensors: One camera head a clip.
    """
    smoky = [sensor.haze.opacity > 0 for sensor in sensors]
    deep = [sensor.aperture_mm > 0 for sensor in sensors]
    timed = [sensor.timed and depth.shape[1] > 1 for sensor in sensors]
    if not any(smoky + deep + timed):
        return radiance
    inside = (views(sensors, depth)[:, 0, 0] > 0.5) & (depth[:, 0] > 0)
    median_mm = masked_percentile(depth[:, 0].flatten(1), inside.flatten(1), 0.5)
    brightness = metered(radiance[:, :1], sensors)[:, 0]

    def through_smoke(clips: Clips, chosen: list[int]) -> Clips:
        return _add_haze(clips, depth[chosen], [sensors[n] for n in chosen], median_mm[chosen], brightness[chosen])

    def out_of_focus(clips: Clips, chosen: list[int]) -> Clips:
        some = [sensors[n] for n in chosen]
        focus_mm = median_mm[chosen] * per_clip([sensor.focus for sensor in some], median_mm)
        opening = [0.25 * sensor.aperture_mm * focal_px[n] for n, sensor in zip(chosen, some, strict=True)]
        return _defocus(clips, _spread(depth[chosen], opening, focus_mm))

    def over_time(clips: Clips, chosen: list[int]) -> Clips:
        some, moving = [sensors[n] for n in chosen], motion(chosen)
        smeared = _smear(clips, moving, [sensor.shutter for sensor in some])
        return on_some(
            smeared, [sensor.interlaced for sensor in some], lambda woven, these: _interlace(woven, moving[these])
        )

    return on_some(on_some(on_some(radiance, smoky, through_smoke), deep, out_of_focus), timed, over_time)


def _add_haze(
    clips: Clips, depth: Depths, sensors: Sequence[Sensor], depth_mm: Float[Tensor, "b"], brightness: Float[Tensor, "b"]
) -> Clips:
    """Clips through smoke whose density drifts; depth 0 counts as far away."""
    height, width = depth.shape[-2:]
    v = (torch.arange(height, device=depth.device, dtype=depth.dtype) / width)[:, None]
    u = torch.arange(width, device=depth.device, dtype=depth.dtype) / width
    time = torch.arange(depth.shape[1], device=depth.device, dtype=depth.dtype)[:, None, None]
    thickness = torch.ones_like(depth)
    for waves in zip(*(sensor.haze.waves for sensor in sensors), strict=True):
        across, along, speed, phase = (per_clip(numbers, depth) for numbers in zip(*waves, strict=True))
        turns = across * u + along * v + speed * time + phase
        thickness *= 1 + per_clip([sensor.haze.wisps for sensor in sensors], depth) * torch.sin(2 * np.pi * turns)
    reference = depth_mm[:, None, None, None]
    reach = torch.where(depth > 0, depth, 4 * reference) / reference
    left = per_clip([1 - sensor.haze.opacity for sensor in sensors], depth)
    passed = (left ** (reach * thickness.clamp_min(LEAST_DENSITY)))[:, :, None]
    veil = torch.tensor([sensor.haze.veil for sensor in sensors]).to(depth) * brightness[:, None]
    return clips * passed + (1 - passed) * veil[:, None, :, None, None]


def _spread(depth: Depths, opening: Sequence[float], focus_mm: Float[Tensor, "b"]) -> Depths:
    """Standard deviation of the blur of every pixel."""
    focus = focus_mm[:, None, None, None]
    return per_clip(opening, depth) * (1 / torch.where(depth > 0, depth, focus) - 1 / focus).abs()


def _defocus(clips: Clips, spread: Depths) -> Clips:
    """Blur by ``spread`` pixels: a mixture of four copies."""
    largest = LARGEST_PX * clips.shape[-1] / 140
    smooth = blur(spread, [1.0] * len(spread), border="reflect") / largest
    place = torch.zeros_like(smooth)
    for low, high in pairwise(STEPS):
        place += ((smooth - low) / (high - low)).clamp(0, 1)
    place = place[:, :, None]
    mixed = clips * (1 - place).clamp_min(0)
    for level, step in enumerate(STEPS[1:], start=1):
        copy = blur(clips, [step * largest] * len(clips), border="reflect")
        mixed += copy * (1 - (place - level).abs()).clamp_min(0)
    sharp = spread.amax((2, 3), keepdim=True)[:, :, None] < LEAST_BLUR_PX
    return torch.where(sharp, clips, mixed)


def _advance(clips: Clips, motion: Motions, share: Tensor | float) -> Clips:
    """Clips ``share`` frames later."""
    height, width = clips.shape[-2:]
    v = torch.arange(height, device=clips.device, dtype=clips.dtype)[:, None].expand(height, width)
    u = torch.arange(width, device=clips.device, dtype=clips.dtype).expand(height, width)
    place = torch.stack([u, v]) - share * motion.clamp(-MOST_PX, MOST_PX)
    size = clips.new_tensor([width, height])[:, None, None]
    grid = ((2 * place + 1) / size - 1).flatten(0, 1).movedim(1, -1)
    moved = F.grid_sample(clips.flatten(0, 1), grid, padding_mode="border", align_corners=False)
    return moved.view_as(clips)


def _smear(clips: Clips, motion: Motions, shutters: Sequence[float]) -> Clips:
    """Mean image while the shutter is open."""
    shutter = per_clip(shutters, clips)
    largest = motion.abs().amax(2).flatten(2)
    every = torch.ones_like(largest, dtype=torch.bool).flatten(0, 1)
    longest = masked_percentile(largest.flatten(0, 1), every, 0.95).view(largest.shape[:2])[..., None, None, None]
    longest = longest * shutter
    taps = (2 * torch.ceil(0.5 * longest) + 1).clamp_max(TAPS)
    total = torch.zeros_like(clips)
    for tap in range(TAPS):
        share = shutter * ((tap + 0.5) / taps - 0.5)
        total += torch.where(tap < taps, _advance(clips, motion, share) / taps, 0.0)
    return torch.where(longest < LEAST_MOTION_PX, clips, total)


def _interlace(clips: Clips, motion: Motions) -> Clips:
    """Even rows of this instant, odd rows of the one half a frame later."""
    odd = (torch.arange(clips.shape[-2], device=clips.device) % 2 == 1)[:, None]
    return torch.where(odd, _advance(clips, motion, 0.5), clips)


def image_motion(
    depth: Depths,
    scene_from_camera: Float[Tensor, "b t 4 4"],
    intrinsics: Float[Tensor, "b 3 3"],
    distortion: Float[Tensor, "b 2"],
) -> Motions:
    """Pixels that each point of a still scene moves until the next frame; see ``shutter.image_motion``."""
    t, height, width = depth.shape[1:]
    v = torch.arange(height, device=depth.device, dtype=depth.dtype)[:, None].expand(height, width) + 0.5
    u = torch.arange(width, device=depth.device, dtype=depth.dtype).expand(height, width) + 0.5
    pixels = torch.stack([u, v]).flatten(1)[:, None]  # (2, 1, n), as rays of a row are
    focal, centre = intrinsics[:, [0, 1], [0, 1]].T[..., None], intrinsics[:, :2, 2].T[..., None]
    k = distortion.T[..., None]
    rays = undistort((pixels - centre) / focal, k)
    other = torch.tensor([*range(1, t), t - 2], device=depth.device)
    carry = torch.linalg.inv(scene_from_camera[:, other]) @ scene_from_camera
    still = torch.cat([rays, torch.ones_like(rays[:1])])  # (3, b, n)
    points = torch.einsum("btij,jbn->itbn", carry[..., :3, :3], still) * depth.flatten(2).transpose(0, 1)
    points = points + carry[..., :3, 3].permute(2, 1, 0)[..., None]
    ahead = (depth.flatten(2).transpose(0, 1) > 0) & (points[2] > 0.1)
    plane = points[:2] / torch.where(ahead, points[2], 1.0)
    moved = distort(plane, k) * focal[:, None] + centre[:, None] - pixels[:, None]
    sign = torch.ones(t, device=depth.device, dtype=depth.dtype)
    sign[-1] = -1
    moved = torch.where(ahead, sign[:, None, None] * moved, 0.0)
    return moved.permute(2, 1, 0, 3).reshape(-1, t, 2, height, width)
