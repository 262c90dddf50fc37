"""One keyframe's folder of SCARED as a sequence: frames, depth, poses and camera of the left eye, paired by number."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bathyscope.camera import F64, Size
from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.depth_files import DepthCode, DepthFiles, FloatDepth, GreyDepth, PointDepth
from bathyscope_train.data.datasets.frame_files import ImageFiles, by_number, image_size
from bathyscope_train.data.datasets.frame_videos import VideoFrames
from bathyscope_train.data.datasets.scared_corrected import Correction, OverlaidDepth
from bathyscope_train.data.datasets.scared_frame_data import (
    FrameData,
    pose_array,
    read_calibration_yaml,
    read_frame_data,
)
from bathyscope_train.data.datasets.scared_splits import WRONG_CALIBRATION, dataset_number
from bathyscope_train.data.datasets.scared_tree import ScaredFolder
from bathyscope_train.data.datasets.sequence import DataSequence, DepthReader, FrameReader
from bathyscope_train.data.datasets.tar_members import TarDepth
from bathyscope_train.evaluation.calibration import read_calibration

DEPTH_RANGE_MM = (1e-3, 150.0)
TOOLKIT_SCALE = 128.0
"""Steps of one millimetre in depth maps of scared_toolkit's script for sequences; its other functions use 256."""
MOVED_DEPTH = "only keyframes were measured; other depth is the keyframe's moved by kinematics, worse with every frame"
_DEPTH_ENDINGS = (".tiff", ".tif", ".npy", ".png")


@dataclass(frozen=True)
class OpenedScared:
    """A sequence and what did not fit."""

    sequence: DataSequence
    problems: tuple[str, ...]


def open_sequence(folder: ScaredFolder, correction: Correction | None = None) -> OpenedScared:
    """One sequence with everything that is there.

    Raises:
        DatasetError: If its frames cannot be read at all.
    """
    problems: list[str] = []
    reader, numbers, size = _frames(folder)
    poses = _poses(folder, problems)
    depth_numbers = _depth_numbers(folder)
    shift = _first_number(folder, numbers, depth_numbers, list(poses), problems)
    numbers = [number - shift for number in numbers]
    problems += _unpaired(folder, numbers, depth_numbers)
    depth = _depth(folder, numbers, size)
    intrinsics = next((data.intrinsics for data in poses.values() if data.intrinsics is not None), None)
    groups = {"keyframes": np.array([number == 0 for number in numbers])}
    notes = [MOVED_DEPTH]
    world_from_camera = pose_array(poses, numbers)
    if correction is not None:
        groups["corrected"] = np.array([number in correction for number in numbers])
        notes.append("frames of the group `corrected` have SCARED-C's poses and depth, the others the official ones")
        world_from_camera = correction.over(world_from_camera, numbers)
        depth = OverlaidDepth(depth, correction, tuple(numbers), size)
    return OpenedScared(
        DataSequence(
            name=folder.name,
            frames=reader,
            frame_names=[f"{number:06d}" for number in numbers],
            size=size,
            depth=depth,
            depth_unit="mm",
            depth_range=DEPTH_RANGE_MM,
            intrinsics=_or_yaml(intrinsics, folder),
            world_from_camera=world_from_camera,
            pose_unit=None if world_from_camera is None else "mm",
            groups=groups,
            notes=(*notes, *_calibration_notes(folder.name)),
        ),
        tuple(problems),
    )


def open_keyframe(folder: ScaredFolder) -> DataSequence | None:
    """The keyframe alone, as it was measured; ``None`` where its image or depth map is not there."""
    image, depth = folder.path / "Left_Image.png", folder.path / "left_depth_map.tiff"
    code: DepthCode = PointDepth("all")
    if folder.layout == "prepared":
        still = folder.path.parents[1] / "keyframes" / folder.path.name
        image, depth = still / "frames/000000.png", still / "depth/000000.png"
        code = GreyDepth(_depth_scale(folder))
    if not (image.is_file() and depth.is_file()):
        return None
    size = image_size(image)
    return DataSequence(
        name=folder.name,
        frames=ImageFiles((image,)),
        frame_names=["keyframe"],
        size=size,
        depth=DepthFiles({0: depth}, code, size),
        depth_unit="mm",
        depth_range=DEPTH_RANGE_MM,
        intrinsics=_or_yaml(None, folder),
        groups={"keyframes": np.ones(1, np.bool_)},
        notes=_calibration_notes(folder.name),
    )


def _frames(folder: ScaredFolder) -> tuple[FrameReader, list[int], Size]:
    if folder.layout == "official":
        video = VideoFrames(folder.video, upper_half=True)
        return video, list(range(len(video))), video.size
    if folder.layout == "still":
        raise DatasetError(f"{folder.path}: no video or frames, only the keyframe")
    images = folder.images
    height, width = image_size(next(iter(images.values())))
    stacked = height > 1.2 * width  # 2048 x 1280 holds both eyes; one eye is wider than high
    return (
        ImageFiles(tuple(images.values()), upper_half=stacked),
        list(images),
        (height // 2 if stacked else height, width),
    )


def _poses(folder: ScaredFolder, problems: list[str]) -> dict[int, FrameData]:
    source = folder.frame_data
    if source is None:
        return {}
    poses, broken = read_frame_data(source)
    problems += broken
    return poses


def _depth_numbers(folder: ScaredFolder) -> list[int] | None:
    """Numbers of the depth files; ``None`` where there is none, or an archive would have to be read for them."""
    place = folder.points
    return None if place is None or place[0] == "tar" else list(_depth_paths(place[1]))


def _depth_paths(folder: Path) -> dict[int, Path]:
    return by_number([path for path in folder.iterdir() if path.suffix.lower() in _DEPTH_ENDINGS])


def _first_number(
    folder: ScaredFolder, images: list[int], depth: list[int] | None, poses: list[int], problems: list[str]
) -> int:
    """What to take from an image's number for its number in the archives, where frames count from 0."""
    if folder.layout in {"official", "prepared", "AF-SfMLearner"}:
        return int(folder.layout == "AF-SfMLearner")
    others = depth or poses
    if not others:
        return 1 if images[0] == 1 and 0 not in images else 0
    candidates = sorted({0, 1, images[0] - others[0]}, key=abs)
    overlaps = {shift: len({number - shift for number in images} & set(others)) for shift in candidates}
    best = max(candidates, key=lambda shift: overlaps[shift])
    if len(images) != len(others):
        problems.append(
            f"{len(images)} images, but {len(others)} {'depth maps' if depth else 'poses'}; "
            f"paired by number ({overlaps[best]} pairs)"
        )
    return best


def _unpaired(folder: ScaredFolder, numbers: list[int], depth: list[int] | None) -> list[str]:
    if depth is None:
        return [] if folder.points is not None else [f"{folder.path}: no true depth (no scene_points); frames only"]
    without, alone = sorted(set(numbers) - set(depth)), sorted(set(depth) - set(numbers))
    said = [f"{len(without)} frames have no depth file, first {without[0]:06d}"] if without else []
    return said + ([f"{len(alone)} depth files have no frame, first {alone[0]:06d}"] if alone else [])


def _depth(folder: ScaredFolder, numbers: list[int], size: Size) -> DepthReader | None:
    place = folder.points
    if place is None:
        return None
    kind, path = place
    if kind == "tar":
        return TarDepth(path, PointDepth("upper"), size)
    paths = _depth_paths(path)
    code: DepthCode
    if kind == "prepared":
        code = GreyDepth(_depth_scale(folder))
    elif kind == "depthmap":
        code = GreyDepth(1 / TOOLKIT_SCALE)
    elif kind == "left npy":
        code = FloatDepth()
    else:
        in_file_order = next(iter(paths.values())).suffix.lower() == ".npy"
        code = PointDepth("upper", axis=2 if in_file_order else 0)
    return DepthFiles({i: paths[n] for i, n in enumerate(numbers) if n in paths}, code, size)


def _depth_scale(folder: ScaredFolder) -> float:
    scale = read_calibration(folder.path / "intrinsics.json").depth_scale
    if scale is None:
        raise DatasetError(f"{folder.path / 'intrinsics.json'}: depth/ needs depth_scale")
    return scale


def _or_yaml(intrinsics: F64 | None, folder: ScaredFolder) -> F64 | None:
    if folder.layout == "prepared":
        return read_calibration(folder.path / "intrinsics.json").matrix
    return intrinsics if intrinsics is not None else read_calibration_yaml(folder.path / "endoscope_calibration.yaml")


def _calibration_notes(name: str) -> tuple[str, ...]:
    if dataset_number(name) not in WRONG_CALIBRATION:
        return ()
    return (f"the calibration of data set {dataset_number(name)} is known to be wrong: depth and image do not agree",)
