"""From what the network says about a window of frames to cameras and Gaussians in one world, in numpy.

The world is that of the window's first camera: pose 0 is the identity, and the Gaussians are carried along.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Size, invert_pose, quaternion_to_matrix, rebase
from bathyscope.errors import GeometryError
from bathyscope.gaussian_parameters import anysplat_gaussians, footprint_gaussians, fuse_voxels, move_gaussians
from bathyscope.gaussians import Gaussians, concatenate
from bathyscope.model_spec import SceneSpec

F32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class WindowMaps:
    """Raw outputs of the network for a window of t frames of (h, w).

    Raises:
        GeometryError: If the shapes do not belong together, a value is not finite, or a depth is not positive.
    """

    depth: F32
    """(t, h, w) z-depth."""
    confidence: F32
    """(t, h, w)"""
    gaussians: F32 | None
    """(t, g, h, w) raw channels; ``None`` from a network that has none."""
    pose_encoding: F32
    """(t, 9) translation, quaternion (x, y, z, w), vertical and horizontal field of view; camera from world."""

    def __post_init__(self) -> None:
        t, h, w = self.depth.shape
        wanted = {"confidence": (t, h, w), "pose_encoding": (t, 9)}
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape:
                raise GeometryError(f"{name} must have shape {shape}, got {getattr(self, name).shape}")
        if self.gaussians is not None:
            g = self.gaussians.shape[1] if self.gaussians.ndim == 4 else 0
            if self.gaussians.shape != (t, g, h, w) or g < 12 or (g - 9) % 3:
                raise GeometryError(f"gaussians must have shape ({t}, 9 + 3 k, {h}, {w}), got {self.gaussians.shape}")
        for name in ("depth", "confidence", "gaussians", "pose_encoding"):
            values = getattr(self, name)
            bad = ~np.isfinite(values) if values is not None else np.zeros(0, np.bool_)
            if bad.any():
                raise GeometryError(f"the network's {name} has {int(bad.sum())} values that are not finite")
        if (self.depth <= 0).any():
            raise GeometryError(f"the network's depth must be positive, its smallest value is {self.depth.min()}")

    @property
    def size(self) -> Size:
        """(height, width)."""
        return self.depth.shape[1], self.depth.shape[2]


@dataclass(frozen=True, slots=True)
class Cameras:
    """Cameras of t frames."""

    world_from_camera: F64
    """(t, 4, 4)"""
    intrinsics: F64
    """(t, 3, 3) in pixels of the maps."""


@dataclass(frozen=True, slots=True)
class Scene:
    """Cameras and Gaussians in one world."""

    cameras: Cameras
    gaussians: Gaussians


def with_focal(maps: WindowMaps, focal: float, focal_epsilon: float) -> WindowMaps:
    """The maps with a known focal length, in their pixels, in place of the fields of view that were estimated."""
    encoding = maps.pose_encoding.copy()
    encoding[:, 7:9] = 2 * np.arctan(np.array(maps.size) / (2 * focal) - focal_epsilon)
    return replace(maps, pose_encoding=encoding)


def decode_cameras(pose_encoding: F32, size: Size, focal_epsilon: float) -> Cameras:
    """Cameras of pose encodings (t, 9), in the network's own world.

    The focal length is half the image over tan(fov / 2) + ``focal_epsilon``.

    Raises:
        GeometryError: If a quaternion has no direction or a field of view is not between 0 and 180 degrees.
    """
    encoding = np.asarray(pose_encoding, np.float64)
    h, w = size
    quaternions = encoding[:, [6, 3, 4, 5]]
    if (np.linalg.norm(quaternions, axis=1) < 1e-9).any():
        raise GeometryError("a pose encoding has a quaternion of length 0")
    tangents = np.tan(encoding[:, 7:9] / 2) + focal_epsilon
    if (tangents <= 0).any() or (encoding[:, 7:9] < 0).any() or (encoding[:, 7:9] >= np.pi).any():
        raise GeometryError(f"fields of view must lie between 0 and 180 degrees, got {encoding[:, 7:9].tolist()} rad")
    camera_from_world = np.tile(np.eye(4), (len(encoding), 1, 1))
    camera_from_world[:, :3, :3] = quaternion_to_matrix(quaternions)
    camera_from_world[:, :3, 3] = encoding[:, :3]
    intrinsics = np.tile(np.eye(3), (len(encoding), 1, 1))
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = w / 2 / tangents[:, 1], h / 2 / tangents[:, 0]
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = w / 2, h / 2
    return Cameras(invert_pose(camera_from_world), intrinsics)


def unproject_window(depth: F32, cameras: Cameras, pixel_centre: float) -> F64:
    """World points (t, h, w, 3) of depth maps (t, h, w), by rays through ``pixel_centre`` of each pixel."""
    _, h, w = depth.shape
    k = cameras.intrinsics
    x = (np.arange(w) + pixel_centre - k[:, 0, 2, None]) / k[:, 0, 0, None]
    y = (np.arange(h) + pixel_centre - k[:, 1, 2, None]) / k[:, 1, 1, None]
    z = depth.astype(np.float64)
    points = np.stack([x[:, None, :] * z, y[:, :, None] * z, z], -1)
    rotation, centre = cameras.world_from_camera[:, :3, :3], cameras.world_from_camera[:, :3, 3]
    turned = np.einsum("tij,thwj->thwi", rotation, points, optimize=True)
    return np.asarray(turned + centre[:, None, None], np.float64)


def assemble_scene(
    maps: WindowMaps,
    images: F32,
    spec: SceneSpec,
    *,
    valid: NDArray[np.bool_] | None = None,
    first_is_identity: bool = True,
    colour: bool = True,
) -> Scene:
    """Decode cameras, unproject depth, and activate (and, where the bundle says so, fuse) the Gaussians.

    Args:
        maps: Raw outputs of the network.
        images: (t, 3, h, w) RGB in [0, 1], what the network saw.
        spec: The bundle's reading of the raw maps.
        valid: (t, h, w) pixels that may become Gaussians; all unless given.
        colour: Whether the Gaussians get their colours; without, they keep one grey constant term.
        first_is_identity: Re-express everything in the first camera's world. Off, the world is the network's own.

    Raises:
        GeometryError: If the encodings are no cameras, the shapes do not fit, or there are no Gaussians.
    """
    cameras = decode_cameras(maps.pose_encoding, maps.size, spec.focal_epsilon)
    points = unproject_window(maps.depth, cameras, spec.pixel_centre)
    keep = np.ones(maps.depth.shape, np.bool_) if valid is None else valid
    if keep.shape != maps.depth.shape or images.shape != (len(keep), 3, *maps.size):
        raise GeometryError(f"maps {maps.depth.shape} do not fit images {images.shape} and valid {keep.shape}")
    raw = maps.gaussians
    if raw is None:
        raise GeometryError("a scene needs Gaussians; this network has none")
    if not colour:
        raw = np.concatenate([raw[:, :11], raw[:, -1:]], 1)
    if spec.activation == "anysplat":
        gaussians = _fused(raw, points, keep, spec)
    else:
        gaussians = concatenate(
            [
                _of_frame(raw[t], maps.depth[t], images[t], points[t], cameras=cameras, t=t, inside=keep[t])
                for t in range(len(keep))
            ]
        )
    if not first_is_identity:
        return Scene(cameras, gaussians)
    first = invert_pose(cameras.world_from_camera[0])
    moved = Cameras(rebase(cameras.world_from_camera), cameras.intrinsics)
    return Scene(moved, move_gaussians(gaussians, first))


def frame_gaussians(
    raw: F32, depth: F32, image: F32, camera: Cameras, spec: SceneSpec, *, inside: NDArray[np.bool_]
) -> Gaussians:
    """Gaussians of one frame, without colours, in the world of its camera.

    Args:
        raw: (g, h, w) raw channels.
        depth: (h, w)
        image: (3, h, w) RGB in [0, 1].
        camera: Of this frame alone.
        spec: The bundle's reading of the raw maps.
        inside: (h, w) pixels that may become Gaussians.

    Raises:
        GeometryError: If this network's Gaussians are not those of a frame, but fused over a window.
    """
    if spec.activation != "footprint":
        raise GeometryError(f"{spec.activation} Gaussians belong to a window, not to a frame")
    points = unproject_window(depth[None], camera, spec.pixel_centre)[0]
    plain = np.concatenate([raw[:11], raw[-1:]])
    return _of_frame(plain, depth, image, points, cameras=camera, t=0, inside=inside)


def _fused(raw: F32, points: F64, keep: NDArray[np.bool_], spec: SceneSpec) -> Gaussians:
    kept = raw.transpose(0, 2, 3, 1)[keep]
    means, features, confidence = points[keep], kept[:, :-1], kept[:, -1]
    if spec.voxel_size is not None:
        means, features = fuse_voxels(means, features, confidence, spec.voxel_size)
    return anysplat_gaussians(means, features, opacity_exponent=spec.opacity_exponent)


def _of_frame(
    raw: F32, depth: F32, image: F32, points: F64, *, cameras: Cameras, t: int, inside: NDArray[np.bool_]
) -> Gaussians:
    k = cameras.intrinsics[t]
    pixel = (1 / k[0, 0] + 1 / k[1, 1]) / 2
    return footprint_gaussians(
        points[inside],
        raw.transpose(1, 2, 0)[inside][:, :-1],
        footprint=(depth[inside] * pixel).astype(np.float32),
        colours=image.transpose(1, 2, 0)[inside],
        rotation=cameras.world_from_camera[t, :3, :3],
    )
