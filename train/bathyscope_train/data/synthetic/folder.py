"""Write a rendered clip as a data set folder: frames, depth, poses and intrinsics in plain files.

The layout is the one that ``bathyscope evaluate`` reads: ``frames/NNNN.png``, ``depth/NNNN.png`` (uint16, times
``depth_scale``), ``poses.txt`` (file name and the 16 numbers of the camera-to-world matrix), ``intrinsics.json``
and, where the field of view is not the whole image, ``mask.png`` (255 inside). Clips with instruments have
``moving/NNNN.png`` (255 on an instrument); the two numbers of a bent lens are ``k1`` and ``k2`` of ``intrinsics.json``,
OpenCV's.
"""

import json
from pathlib import Path

import cv2
import numpy as np

from bathyscope.errors import DatasetError
from bathyscope_train.data.synthetic.clip import SyntheticClip

_LEVELS = 65535


def write_dataset_folder(clip: SyntheticClip, folder: Path) -> None:
    """Write ``clip`` into ``folder``, which is made if missing.

    Depth is stored to 1 / 65535 of the clip's largest depth.

    Raises:
        DatasetError: If a file cannot be written.
    """
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    (folder / "depth").mkdir(exist_ok=True)
    if clip.moving.any():
        (folder / "moving").mkdir(exist_ok=True)
        for index, moving in enumerate(clip.moving):
            _write_png(folder / "moving" / f"{index:04d}.png", np.where(moving, 255, 0).astype(np.uint8))
    depth_scale = float(np.ceil(clip.depth.max())) / _LEVELS
    lines = ["# file, then world_from_camera row by row; millimetres, x right, y down, z forward\n"]
    for index, (frame, depth, pose) in enumerate(zip(clip.frames, clip.depth, clip.world_from_camera, strict=True)):
        name = f"{index:04d}.png"
        _write_png(folder / "frames" / name, frame[..., ::-1])
        _write_png(folder / "depth" / name, np.rint(depth / depth_scale).astype(np.uint16))
        lines.append(" ".join([name, *(f"{value:.12g}" for value in pose.ravel())]) + "\n")
    (folder / "poses.txt").write_text("".join(lines), encoding="utf-8")
    if not clip.valid.all():
        _write_png(folder / "mask.png", np.where(clip.valid.any(axis=0), 255, 0).astype(np.uint8))
    height, width = clip.frames.shape[1:3]
    intrinsics = {
        "width": width,
        "height": height,
        "fx": float(clip.intrinsics[0, 0]),
        "fy": float(clip.intrinsics[1, 1]),
        "cx": float(clip.intrinsics[0, 2]),
        "cy": float(clip.intrinsics[1, 2]),
        "k1": clip.distortion.k1,
        "k2": clip.distortion.k2,
        "pixel_origin": "(0,0) is the top-left corner of the top-left pixel",
        "depth": "uint16 PNG, z along the optical axis; depth_mm = value * depth_scale; 0 = nothing",
        "depth_scale": depth_scale,
        "depth_unit": "mm",
        "pose_unit": "mm",
        "depth_valid": None,
        "source": f"rendered: domain {clip.domain}, seed {clip.seed}",
    }
    (folder / "intrinsics.json").write_text(json.dumps(intrinsics, indent=1) + "\n", encoding="utf-8")


def _write_png(path: Path, image: np.ndarray[tuple[int, ...], np.dtype[np.uint8 | np.uint16]]) -> None:
    if not cv2.imwrite(str(path), np.ascontiguousarray(image)):
        raise DatasetError(f"{path}: the image could not be written")
