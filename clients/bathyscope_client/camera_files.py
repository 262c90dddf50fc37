"""``NAME_poses.txt`` (TUM, camera to world) and ``NAME_intrinsics.json``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from bathyscope.result import FrameDepth, ResultMeta
from bathyscope.result_files import NpzReader
from bathyscope.tum import tum_lines


def write_camera_files(reader: NpzReader, poses: Path, intrinsics: Path) -> None:
    """Write both files in one pass over a result that has cameras."""
    entries: list[dict[str, Any]] = []
    segment: int | None = None
    with poses.open("w") as file:
        file.write("# timestamp_s tx ty tz qx qy qz qw, camera to world; x right, y down, z forward\n")
        for frame in reader:
            if frame.segment != segment:
                segment = frame.segment
                file.write(f"# segment {segment}: a world and a scale of its own\n")
            assert frame.world_from_camera is not None
            file.writelines(tum_lines(np.array([frame.timestamp_s]), frame.world_from_camera[None]))
            entries.append(_entry(frame))
    intrinsics.write_text(json.dumps(_described(reader.size, reader.meta, entries), indent=1) + "\n")


def _entry(frame: FrameDepth) -> dict[str, Any]:
    k = frame.intrinsics
    assert k is not None
    return {
        "timestamp_s": frame.timestamp_s,
        "fx": float(k[0, 0]),
        "fy": float(k[1, 1]),
        "cx": float(k[0, 2]),
        "cy": float(k[1, 2]),
    }


def _described(size: tuple[int, int], meta: ResultMeta, entries: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "height": size[0],
        "width": size[1],
        "pixel_origin": "top-left corner of the top-left pixel; the centre of pixel (0, 0) is (0.5, 0.5)",
        "depth": "z along the optical axis; 0 = nothing there",
        "scale": meta.scale,
        **{name: float(np.median([entry[name] for entry in entries])) for name in ("fx", "fy", "cx", "cy")},
        "frames": entries,
    }
