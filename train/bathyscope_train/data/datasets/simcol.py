"""SimCol3D: rendered colonoscopy, depth in centimetres.

::

    ROOT/SyntheticColon_{I,II,III}/Frames_{S,B,O}n/FrameBuffer_NNNN.png   475x475
                                                  /Depth_NNNN.png         uint16, depth_cm = value / 255 / 256 * 20
                                  /SavedPosition_Sn.txt                   cm, x y z, left-handed with y up
                                  /SavedRotationQuaternion_Sn.txt         x y z w
                                  /cam.txt
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from bathyscope.camera import F64, Size, quaternion_to_matrix
from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.depth_files import DepthFiles, GreyDepth
from bathyscope_train.data.datasets.frame_files import ImageFiles, by_number, image_size
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.evaluation.sequences import EvaluationSet, Gap

DEPTH_CM = 20 / 255 / 256
TEST_TRAJECTORIES = ("S5", "S10", "S15", "B5", "B10", "B15", "O1", "O2", "O3")
PUBLISHED_FRAMES = {"S": 601, "B": 1201}
"""Of every trajectory in scenes I and II; none is stated for III."""
_FOCAL, _CENTRE, _SIDE = 227.60416, 237.5, 475
_NAME = re.compile(r"Frames_([SBO]\d+)")


def simcol_trajectories(root: Path) -> dict[str, Path]:
    """Folders ``Frames_S1`` and so on below ``root``, by trajectory, in order."""
    found: dict[str, Path] = {}
    for pattern in ("Frames_*", "*/Frames_*", "*/*/Frames_*"):
        for path in root.glob(pattern):
            match = _NAME.fullmatch(path.name)
            if match and path.is_dir():
                found[match[1]] = path
    return dict(sorted(found.items(), key=lambda item: ("SBO".index(item[0][0]), int(item[0][1:]))))


def is_simcol(root: Path) -> bool:
    """Whether a folder looks like SimCol3D."""
    return bool(simcol_trajectories(root))


def open_simcol(root: Path, split: str = "test") -> EvaluationSet:
    """Trajectories of the split ``test``, ``train`` (all others) or ``all``.

    Raises:
        DatasetError: If there is no such split, or nothing of it is there.
    """
    if split not in {"test", "train", "all"}:
        raise DatasetError(f"SimCol3D has no split {split!r}; known are test, train, all")
    found = simcol_trajectories(root)
    if not found:
        raise DatasetError(f"{root}: no SimCol3D here; expected SyntheticColon_I/Frames_S1/FrameBuffer_0000.png")
    in_test = set(TEST_TRAJECTORIES)
    chosen = [t for t in found if split == "all" or (t in in_test) == (split == "test")]
    absent = [] if split == "train" else [t for t in TEST_TRAJECTORIES if t not in found]
    gaps = [Gap(trajectory, "", f"{root}: no folder Frames_{trajectory}") for trajectory in absent]
    opened = [_open(trajectory, found[trajectory]) for trajectory in chosen]
    if not opened:
        raise DatasetError(f"{root}: none of the {split} trajectories; there are {', '.join(found)}")
    gaps += [gap for _, problems in opened for gap in problems]
    return EvaluationSet("simcol", tuple(sequence for sequence, _ in opened), f"SimCol3D, {split}", tuple(gaps))


def _open(trajectory: str, folder: Path) -> tuple[DataSequence, list[Gap]]:
    images, depth = by_number(list(folder.glob("FrameBuffer_*.png"))), by_number(list(folder.glob("Depth_*.png")))
    if not images:
        raise DatasetError(f"{folder}: no FrameBuffer_NNNN.png")
    size = image_size(next(iter(images.values())))
    gaps = [Gap(trajectory, f"{n:04d}", "no depth file of this number") for n in images if n not in depth]
    published = PUBLISHED_FRAMES.get(trajectory[0])
    if published is not None and len(images) != published:
        off = len(images) - published
        gaps.append(Gap(trajectory, "", f"{len(images)} frames, published are {published} ({off:+d})"))
    poses, problem = _poses(folder, trajectory, list(images))
    gaps += [Gap(trajectory, "poses", problem)] if problem else []
    sequence = DataSequence(
        name=trajectory,
        frames=ImageFiles(tuple(images.values())),
        frame_names=[f"{n:04d}" for n in images],
        size=size,
        depth=DepthFiles({i: depth[n] for i, n in enumerate(images) if n in depth}, GreyDepth(DEPTH_CM), size),
        depth_unit="cm",
        depth_range=(0.0, 20.0),
        intrinsics=_intrinsics(size),
        world_from_camera=poses,
        pose_unit=None if poses is None else "cm",
    )
    return sequence, gaps


def _intrinsics(size: Size) -> F64:
    """The published camera: ``cam.txt`` is not read, for a public script writes its numbers into the wrong places."""
    y, x = size[0] / _SIDE, size[1] / _SIDE
    return np.array([[_FOCAL * x, 0.0, _CENTRE * x], [0.0, _FOCAL * y, _CENTRE * y], [0.0, 0.0, 1.0]])


def _poses(folder: Path, trajectory: str, numbers: list[int]) -> tuple[F64 | None, str | None]:
    """``world_from_camera`` (t, 4, 4) of the frames of these numbers; and what does not fit."""
    places = (folder.parent, folder)
    names = f"SavedPosition_{trajectory}.txt", f"SavedRotationQuaternion_{trajectory}.txt"
    place = next((place for place in places if all((place / name).is_file() for name in names)), None)
    if place is None:
        return None, f"{folder.parent}: no {names[0]} with {names[1]}; no poses"
    positions, quaternions = _table(place / names[0], 3), _table(place / names[1], 4)
    if len(positions) != len(quaternions):
        raise DatasetError(f"{place}: {len(positions)} positions, {len(quaternions)} rotations of {trajectory}")
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3] = quaternion_to_matrix(quaternions[:, [3, 0, 1, 2]])
    poses[:, :3, 3] = positions
    flip = np.diag([1.0, -1.0, 1.0, 1.0])  # y up to y down, in the world and in the camera
    poses = flip @ poses @ flip
    chosen = np.stack([poses[n] if n < len(poses) else np.full((4, 4), np.nan) for n in numbers])
    short = len(poses) <= max(numbers)
    return chosen, f"{place}: {len(poses)} poses of {trajectory}, frames up to {max(numbers)}" if short else None


def _table(path: Path, columns: int) -> F64:
    try:
        table = np.loadtxt(path, np.float64, ndmin=2)
    except ValueError as error:
        raise DatasetError(f"{path}: not a table of numbers ({error})") from error
    if table.shape[1] != columns:
        raise DatasetError(f"{path}: {table.shape[1]} numbers a line, expected {columns}")
    return table
