"""The files of a data set folder that ``prepare`` writes: poses, intrinsics, images."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64
from bathyscope_train.data.datasets.scared_splits import WRONG_CALIBRATION, dataset_number
from bathyscope_train.data.datasets.sequence import DataSequence

DEPTH_SCALE_MM = 1 / 256
"""One step of the depth written; the farthest is 256 mm, and metrics stop at 150."""
AVERAGE_CAMERA = (0.82, 1.02, 0.5, 0.5)
"""fx / width, fy / height, cx / width, cy / height: the mean of all calibrations, used where a sequence has none."""


def write_poses(path: Path, sequence: DataSequence, ending: str) -> None:
    """``poses.txt`` of the frames that have a pose; nothing for a sequence without any."""
    if sequence.world_from_camera is None:
        return
    lines = ["# file, then world_from_camera row by row; mm, x right, y down, z forward"]
    for name, pose in zip(sequence.frame_names, sequence.world_from_camera, strict=True):
        if np.isfinite(pose).all():
            lines.append(" ".join([name + ending, *(f"{value:.12g}" for value in pose.ravel())]))
    write_beside(path, ("\n".join(lines) + "\n").encode())


def write_intrinsics(target: Path, sequence: DataSequence) -> list[str]:
    """``intrinsics.json`` of a sequence; returns what to know about its camera, in words."""
    said: list[str] = []
    height, width = sequence.size
    matrix, source = sequence.intrinsics, "calibration of the sequence, moved to the corner of the first pixel"
    if matrix is None:
        matrix, source = _average_camera(height, width), "none found; the mean of SCARED's calibrations"
        said.append("no calibration (frame_data or endoscope_calibration.yaml); the mean of all is written")
    notes = list(sequence.notes)
    if dataset_number(sequence.name) in WRONG_CALIBRATION:
        said.append("calibration known to be wrong (data sets 4 and 5)")
    values: dict[str, Any] = {
        "width": width,
        "height": height,
        "fx": matrix[0, 0],
        "fy": matrix[1, 1],
        "cx": matrix[0, 2],
        "cy": matrix[1, 2],
        "pixel_origin": "(0,0) is the top-left corner of the top-left pixel",
        "intrinsics_source": source,
        "depth": "uint16 PNG, z along the optical axis; depth_mm = value * depth_scale; 0 = nothing",
        "depth_scale": DEPTH_SCALE_MM,
        "depth_unit": "mm",
        "pose_unit": "mm" if sequence.world_from_camera is not None else None,
        "depth_valid": list(sequence.depth_range or (0, 150)),
        "notes": notes,
        "source": f"SCARED {sequence.name}, left eye, distorted and not rectified",
    }
    write_beside(target / "intrinsics.json", (json.dumps(values, indent=1) + "\n").encode())
    return said


def _average_camera(height: int, width: int) -> F64:
    fx, fy, cx, cy = AVERAGE_CAMERA
    return np.array([[fx * width, 0.0, cx * width], [0.0, fy * height, cy * height], [0.0, 0.0, 1.0]])


def encode_image(ending: str, image: NDArray[Any], options: list[int]) -> bytes:
    """An image file in memory; colours in OpenCV's order."""
    import cv2

    good, data = cv2.imencode(ending, np.ascontiguousarray(image), options)
    assert good
    return data.tobytes()


def write_beside(path: Path, data: bytes) -> None:
    """Write beside ``path`` and rename into place, so that a file that is there is whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    beside.write_bytes(data)
    beside.replace(path)
