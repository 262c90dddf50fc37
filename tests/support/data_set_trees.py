"""Small trees in the exact on-disk formats of public data sets, with values that are known in closed form.

The scene is a plane seen head on; the camera moves sideways and towards it, so depth and poses agree exactly.
"""

from __future__ import annotations

import io
import json
import struct
import tarfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from made_videos import write_video
from numpy.typing import NDArray

SIZE = (32, 48)
"""(height, width) of one eye."""
K_OPENCV = np.array([[40.0, 0.0, 23.5], [0.0, 42.0, 15.5], [0.0, 0.0, 1.0]])
"""With the centre of the first pixel at 0, as OpenCV calibrates."""
K_CORNER = np.array([[40.0, 0.0, 24.0], [0.0, 42.0, 16.0], [0.0, 0.0, 1.0]])
"""The same camera with the centre of the first pixel at (0.5, 0.5)."""


def picture(index: int, size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """RGB that tells its number: blue is 40 + 8 index; smooth, to survive a codec."""
    h, w = size
    y, x = np.mgrid[:h, :w]
    return np.stack([60 + 120 * x / w, 60 + 120 * y / h, np.full((h, w), 40 + 8 * index)], -1).astype(np.uint8)


def plane_depth(index: int) -> float:
    """z of the plane in frame ``index``, in mm: the camera comes 2 mm closer with each."""
    return 60.0 - 2.0 * index


def camera_from_world(index: int) -> NDArray[np.float64]:
    """World to camera: the camera stands at (index, 0, 2 index)."""
    pose = np.eye(4)
    pose[:3, 3] = [-float(index), 0.0, -2.0 * index]
    return pose


def points(index: int, size: tuple[int, int] = SIZE, unknown: float = 0.0) -> NDArray[np.float32]:
    """(h, w, 3) X, Y, Z in mm of the plane; the first column is unknown."""
    h, w = size
    v, u = np.mgrid[:h, :w].astype(np.float64)
    z = np.full((h, w), plane_depth(index))
    xyz = np.stack([(u - K_OPENCV[0, 2]) / K_OPENCV[0, 0] * z, (v - K_OPENCV[1, 2]) / K_OPENCV[1, 1] * z, z], -1)
    xyz[:, 0] = unknown
    return xyz.astype(np.float32)


def float_tiff(values: NDArray[np.float32]) -> bytes:
    """An uncompressed little-endian TIFF of three float channels, X Y Z in the order of the file (TIFF 6.0)."""
    h, w, channels = values.shape
    tags = [
        (256, 4, 1, w),
        (257, 4, 1, h),
        (258, 3, 3, 8 + 2 + 11 * 12 + 4),
        (259, 3, 1, 1),
        (262, 3, 1, 2),
        (273, 4, 1, 8 + 2 + 11 * 12 + 4 + 12),
        (277, 3, 1, channels),
        (278, 4, 1, h),
        (279, 4, 1, values.nbytes),
        (284, 3, 1, 1),
        (339, 3, 3, 8 + 2 + 11 * 12 + 4 + 6),
    ]
    directory = struct.pack("<H", len(tags)) + b"".join(struct.pack("<HHII", *tag) for tag in tags) + bytes(4)
    extra = struct.pack("<3H", 32, 32, 32) + struct.pack("<3H", 3, 3, 3)
    return b"II*\0" + struct.pack("<I", 8) + directory + extra + np.ascontiguousarray(values, "<f4").tobytes()


def frame_data(index: int) -> dict[str, Any]:
    """A ``frame_data`` json with SCARED's keys."""
    calibration = {
        "KL": K_OPENCV.tolist(),
        "KR": K_OPENCV.tolist(),
        "DL": [[0.0] * 5],
        "DR": [[0.0] * 5],
        "R": np.eye(3).tolist(),
        "T": [[-4.0, 0.0, 0.0]],
    }
    return {"camera-pose": camera_from_world(index).tolist(), "camera-calibration": calibration}


def write_tar(path: Path, members: Iterable[tuple[str, bytes]]) -> Path:
    """A ``tar.gz``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(path, "w:gz") as tar:
        for name, data in members:
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    return path


def scared_official(
    root: Path,
    dataset: int,
    keyframe: int,
    frames: int = 5,
    *,
    depth_of: Sequence[int] | None = None,
    poses_of: Sequence[int] | None = None,
    still: bool = True,
) -> Path:
    """``dataset_D/keyframe_K`` as distributed: stacked video, archives of points and jsons, the keyframe."""
    folder = root / f"dataset_{dataset}" / f"keyframe_{keyframe}"
    (folder / "data").mkdir(parents=True)
    if still:
        scared_still(folder)
    stacked = [np.concatenate([picture(i), picture(0)[::-1]]) for i in range(frames)]
    write_video(folder / "data" / "rgb.mp4", stacked)
    right = np.full((*SIZE, 3), 7, np.float32)
    every = range(frames)
    write_tar(
        folder / "data" / "scene_points.tar.gz",
        (
            (f"scene_points{i:06d}.tiff", float_tiff(np.concatenate([points(i), right])))
            for i in (every if depth_of is None else depth_of)
        ),
    )
    write_tar(
        folder / "data" / "frame_data.tar.gz",
        (
            (f"frame_data{i:06d}.json", json.dumps(frame_data(i)).encode())
            for i in (every if poses_of is None else poses_of)
        ),
    )
    return folder


def scared_still(folder: Path) -> None:
    """The keyframe's own files: both eyes, depth with NaN where unknown, OpenCV's calibration."""
    folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "Left_Image.png"), picture(0)[..., ::-1])
    cv2.imwrite(str(folder / "Right_Image.png"), picture(1)[..., ::-1])
    (folder / "left_depth_map.tiff").write_bytes(float_tiff(points(0, unknown=np.nan)))
    storage = cv2.FileStorage(str(folder / "endoscope_calibration.yaml"), cv2.FILE_STORAGE_WRITE)
    storage.write("M1", K_OPENCV)
    storage.release()


def scared_left_images(
    folder: Path, frames: int = 5, *, first: int = 0, image_name: str = "frame_data{:06d}.png", kind: str = "tiff"
) -> Path:
    """EndoDAC's and EndoDAV's tree: ``data/left``, ``data/scene_points``, ``data/frame_data``."""
    for part in ("left", "scene_points", "frame_data"):
        (folder / "data" / part).mkdir(parents=True)
    right = np.full((*SIZE, 3), 7, np.float32)
    for i in range(frames):
        cv2.imwrite(str(folder / "data/left" / image_name.format(i + first)), picture(i)[..., ::-1])
        both = np.concatenate([points(i), right])
        place = folder / "data/scene_points" / f"scene_points{i:06d}.{kind}"
        place.write_bytes(float_tiff(both)) if kind == "tiff" else np.save(place, both)
        (folder / "data/frame_data" / f"frame_data{i:06d}.json").write_text(json.dumps(frame_data(i)))
    return folder


def scared_af(folder: Path, frames: int = 5, *, stacked: bool = False) -> Path:
    """AF-SfMLearner's tree: images from 1, points from 0."""
    images, truth = folder / "image_02/data", folder / "image_02/data/groundtruth"
    truth.mkdir(parents=True)
    for i in range(frames):
        image = np.concatenate([picture(i), picture(0)[::-1]]) if stacked else picture(i)
        cv2.imwrite(str(images / f"{i + 1:010d}.png"), image[..., ::-1])
        both = np.concatenate([points(i), np.full((*SIZE, 3), 7, np.float32)])
        (truth / f"scene_points{i:06d}.tiff").write_bytes(float_tiff(both))
    return folder


def hamlyn(root: Path, name: str = "rectified04", frames: int = 4, size: tuple[int, int] = SIZE) -> Path:
    """``rectifiedNN`` with both eyes and depth in millimetres (value 50 + frame), intrinsics in ``calibration/NN``."""
    for part in ("image01", "image02", "depth01", "depth02"):
        (root / name / part).mkdir(parents=True)
    for i in range(frames):
        for eye in ("01", "02"):
            cv2.imwrite(str(root / name / f"image{eye}" / f"{i:010d}.jpg"), picture(i, size)[..., ::-1])
            depth = np.full(size, 50 + i, np.uint16)
            depth[0] = 0
            cv2.imwrite(str(root / name / f"depth{eye}" / f"{i:010d}.png"), depth)
    calibration = root / "calibration" / name.removeprefix("rectified")
    calibration.mkdir(parents=True)
    np.savetxt(calibration / "intrinsics.txt", K_OPENCV)
    return root / name


def c3vd(folder: Path, frames: int = 4, size: tuple[int, int] = SIZE) -> Path:
    """A video of C3VD: colour, 16-bit depth, and poses as transposed matrices."""
    folder.mkdir(parents=True)
    lines = []
    for i in range(frames):
        cv2.imwrite(str(folder / f"{i:04d}_color.png"), picture(i, size)[..., ::-1])
        depth = np.full(size, round(plane_depth(i) / 100 * 65535), np.uint16)
        depth[0] = 65535
        cv2.imwrite(str(folder / f"{i:04d}_depth.tiff"), depth)
        cv2.imwrite(str(folder / f"{i:04d}_occlusion.png"), depth)
        lines.append(",".join(map(str, np.linalg.inv(camera_from_world(i)).T.ravel())))
    (folder / "pose.txt").write_text("\n".join(lines) + "\n")
    return folder


def simcol(root: Path, trajectory: str = "S5", scene: str = "SyntheticColon_I", frames: int = 4) -> Path:
    """A trajectory of SimCol3D in Unity's left-handed axes: y is up, so y of positions and rotations is turned."""
    folder = root / scene / f"Frames_{trajectory}"
    folder.mkdir(parents=True)
    depth = np.full((19, 19), round(4.0 / 20 * 255 * 256), np.uint16)
    for i in range(frames):
        cv2.imwrite(str(folder / f"FrameBuffer_{i:04d}.png"), picture(i, (19, 19))[..., ::-1])
        cv2.imwrite(str(folder / f"Depth_{i:04d}.png"), depth)
    positions = np.array([[0.1 * i, 0.2 * i, 0.3 * i] for i in range(frames)])
    angle = 0.1 * np.arange(frames)
    # a turn about the camera's x axis, which in left-handed axes with y up goes the other way round
    quaternions = np.stack([np.sin(angle / 2), 0 * angle, 0 * angle, np.cos(angle / 2)], -1)
    np.savetxt(folder.parent / f"SavedPosition_{trajectory}.txt", positions)
    np.savetxt(folder.parent / f"SavedRotationQuaternion_{trajectory}.txt", quaternions)
    (folder.parent / "cam.txt").write_text("227.60416 0 0\n0 237.5 0\n")
    return folder


def endoslam(root: Path, organ: str = "Colon", frames: int = 3) -> Path:
    """The Unity part of EndoSLAM."""
    for part in ("Frames", "Pixelwise Depths", "Poses"):
        (root / organ / part).mkdir(parents=True)
    rows = ["tx,ty,tz,qx,qy,qz,qw,time"]
    for i in range(frames):
        cv2.imwrite(str(root / organ / "Frames" / f"image_{i:04d}.png"), picture(i, (16, 16))[..., ::-1])
        grey = np.full((16, 16, 3), 100 + i, np.uint8)
        cv2.imwrite(str(root / organ / "Pixelwise Depths" / f"aov_image_{i:04d}.png"), grey)
        rows.append(f"{i},{2 * i},{3 * i},0,0,0,1,{0.1 * i}")
    (root / organ / "Poses" / "poses.csv").write_text("\n".join(rows) + "\n")
    return root / organ
