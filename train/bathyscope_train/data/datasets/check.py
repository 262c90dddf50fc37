"""``bathyscope data check``: what a folder holds, what is missing, and which known pitfall applies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel

from bathyscope.errors import DatasetError
from bathyscope_train.data.clip_survey import survey_clips
from bathyscope_train.data.datasets.catalogue import KINDS, recognise
from bathyscope_train.data.datasets.own_folder import open_own_folder, own_folders
from bathyscope_train.data.datasets.pitfalls import pitfalls
from bathyscope_train.data.datasets.pose_agreement import pose_agreement
from bathyscope_train.data.datasets.scared import published_shortfall
from bathyscope_train.data.datasets.scared_sequence import open_keyframe, open_sequence
from bathyscope_train.data.datasets.scared_splits import frame_counts
from bathyscope_train.data.datasets.scared_tree import find_scared
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.data.datasets.tar_members import TarDepth
from bathyscope_train.data.datasets.videos import open_videos
from bathyscope_train.evaluation.folder_sequences import FolderSequence
from bathyscope_train.evaluation.folders import DatasetFolder
from bathyscope_train.evaluation.sequences import EvaluationSequence

Level = Literal["missing", "unreadable", "pitfall", "note"]
Progress = Callable[[str, int, int], None]


class Finding(BaseModel, frozen=True):
    """One thing to know about a data set."""

    level: Level
    where: str
    """The sequence or file; empty for the whole set."""
    what: str


class SequenceCheck(BaseModel, frozen=True):
    """One sequence that was found."""

    name: str
    frames: int
    size: tuple[int, int]
    """(height, width)."""
    looked_at: int
    """Frames that were read."""
    depth_coverage: float | None
    """Mean share of pixels with a usable true depth over the frames looked at; ``None`` without depth."""
    poses: int


class CheckReport(BaseModel, frozen=True):
    """What was found."""

    kind: str
    """The data set, ``folders`` for our own layout, or ``videos``."""
    root: Path
    sequences: tuple[SequenceCheck, ...]
    findings: tuple[Finding, ...]

    @property
    def complete(self) -> bool:
        """Whether nothing is missing or unreadable."""
        return not any(finding.level in {"missing", "unreadable"} for finding in self.findings)


def check_data(
    root: Path, *, kind: str | None = None, every_frame: bool = False, progress: Progress = lambda *_: None
) -> CheckReport:
    """Look at a folder.

    Args:
        root: The folder.
        kind: Name of the data set; found out unless given.
        every_frame: Read every frame and depth map, not three of each sequence.
        progress: Told the sequence, and how many of how many are done.

    Raises:
        DatasetError: If the folder is not there, or holds nothing that can be used.
    """
    if kind is not None and kind not in {*KINDS, "videos"}:
        raise DatasetError(f"no data set {kind!r}; known are {', '.join(KINDS)}, videos")
    name = kind or _recognised(root)
    if name == "videos":
        return _check_videos(root, every_frame, progress)
    opened, findings = _open(root, name)
    checks: list[SequenceCheck] = []
    for done, sequence in enumerate(opened, 1):
        check, said = _check_sequence(sequence, every_frame)
        checks.append(check)
        findings += said
        progress(sequence.name, done, len(opened))
    known = [sequence for sequence in opened if isinstance(sequence, DataSequence)]
    findings += [Finding(level="pitfall", where=where, what=what) for where, what in pitfalls(name, root, known)]
    return CheckReport(kind=name, root=root, sequences=tuple(checks), findings=tuple(findings))


def _recognised(root: Path) -> str:
    if root.is_file():
        return "videos"
    kind = recognise(root)
    return "videos" if kind is None else kind.name


def _open(root: Path, name: str) -> tuple[list[EvaluationSequence], list[Finding]]:
    if name == "scared":
        return _open_scared(root)
    if name == "folders":
        return _open_folders(root)
    kind = KINDS[name]
    opened = kind.open(root, "all" if "all" in kind.splits else "", "all", None)
    gaps = [Finding(level="missing", where=f"{g.sequence} {g.what}".strip(), what=g.reason) for g in opened.gaps]
    return list(opened.sequences), gaps


def _open_folders(root: Path) -> tuple[list[EvaluationSequence], list[Finding]]:
    """Folders in our own layout; those without true depth can be trained on."""
    sequences: list[EvaluationSequence] = []
    findings: list[Finding] = []
    for path in own_folders(root):
        try:
            sequences.append(FolderSequence(DatasetFolder.open(path), path.resolve().name))
        except DatasetError as error:
            findings.append(Finding(level="missing", where=path.resolve().name, what=str(error)))
            try:
                sequences.append(open_own_folder(path))
            except DatasetError as problem:
                findings.append(Finding(level="unreadable", where=path.resolve().name, what=str(problem)))
    if not sequences:
        raise DatasetError(f"{root}: no folder can be used: {'; '.join(finding.what for finding in findings)}")
    return sequences, findings


def _open_scared(root: Path) -> tuple[list[EvaluationSequence], list[Finding]]:
    found = find_scared(root)
    sequences: list[EvaluationSequence] = []
    findings = [
        Finding(level="missing", where=name, what=f"not there; published are {count} frames")
        for name, count in frame_counts().items()
        if name not in found
    ]
    for name, folder in found.items():
        if folder.layout == "still":
            still = open_keyframe(folder)
            sequences += [still] if still is not None else []
            level: Level = "missing" if name in frame_counts() else "note"
            findings.append(Finding(level=level, where=name, what="only the keyframe, no data/ with a sequence"))
            continue
        try:
            opened = open_sequence(folder)
        except DatasetError as error:
            findings.append(Finding(level="unreadable", where=name, what=str(error)))
            continue
        sequences.append(opened.sequence)
        findings += [Finding(level="missing", where=name, what=problem) for problem in opened.problems]
        shortfall = published_shortfall(name, len(opened.sequence))
        findings += [Finding(level="missing", where=name, what=shortfall)] if shortfall else []
    return sequences, findings


def _check_sequence(sequence: EvaluationSequence, every_frame: bool) -> tuple[SequenceCheck, list[Finding]]:
    findings: list[Finding] = [Finding(level="note", where=sequence.name, what=note) for note in sequence.notes]
    frames = len(sequence.frame_names)
    chosen = range(frames) if every_frame else _few(sequence, frames)
    coverage: list[float] = []
    empty = 0
    for index in chosen:
        for problem, share in _look(sequence, index):
            if problem is not None:
                findings.append(Finding(level="unreadable", where=sequence.name, what=problem))
            elif share is not None:
                coverage.append(share)
                empty += share == 0
    if empty:
        what = f"{empty} of {len(coverage)} frames looked at have depth files without one usable pixel"
        findings.append(Finding(level="pitfall", where=sequence.name, what=what))
    findings += _poses_and_depth(sequence)
    poses = sequence.world_from_camera
    check = SequenceCheck(
        name=sequence.name,
        frames=frames,
        size=sequence.size,
        looked_at=len(chosen),
        depth_coverage=float(np.mean(coverage)) if coverage else None,
        poses=0 if poses is None else int(np.isfinite(poses).all((1, 2)).sum()),
    )
    return check, findings


def _few(sequence: EvaluationSequence, frames: int) -> list[int]:
    """First, middle and last frame; of an archive, which is read from its beginning, the first alone."""
    if isinstance(sequence, DataSequence) and isinstance(sequence.depth, TarDepth):
        return [0]
    return sorted({0, frames // 2, frames - 1})


def _look(sequence: EvaluationSequence, index: int) -> Iterator[tuple[str | None, float | None]]:
    """Problems of a frame, and the share of its pixels with usable depth."""
    try:
        sequence.image(index)
    except DatasetError as error:
        yield str(error), None
    try:
        depth = sequence.truth(index)
    except DatasetError as error:
        yield str(error), None
        return
    if depth is not None:
        low, high = sequence.depth_range or (0.0, np.inf)
        yield None, float(((depth > max(low, 0)) & (depth < high)).mean())


def _poses_and_depth(sequence: EvaluationSequence) -> list[Finding]:
    try:
        agreement = pose_agreement(sequence)
    except DatasetError as error:
        return [Finding(level="unreadable", where=sequence.name, what=str(error))]
    if agreement is None:
        return []
    if agreement.wrong_way:
        what = f"{agreement}: the poses look inverted"
        return [Finding(level="pitfall", where=sequence.name, what=what)]
    return [Finding(level="note", where=sequence.name, what=str(agreement))]


def _check_videos(root: Path, every_frame: bool, progress: Progress) -> CheckReport:
    """Videos and frames: what training would use of them; every frame is looked at if asked for."""
    found = open_videos(root)
    findings = [Finding(level="unreadable", where=gap.sequence, what=gap.reason) for gap in found.gaps]
    checks = []
    for done, sequence in enumerate(found.sequences, 1):
        check, said = _check_sequence(sequence, every_frame=False)
        checks.append(check)
        findings += said
        progress(sequence.name, done, len(found.sequences))
    if every_frame:
        surveyed, refused = survey_clips(found.sequences)
        for sequence, survey in surveyed:
            shots = len(survey.shots) - 1
            moving = f"{len(survey.kept)} frames in which the camera moves, in {shots} shot{'s' * (shots > 1)}"
            findings.append(Finding(level="note", where=sequence.name, what=moving))
            findings += [Finding(level="note", where=sequence.name, what=note) for note in survey.notes]
        findings += [Finding(level="unreadable", where="", what=reason) for reason in refused]
    return CheckReport(kind="videos", root=root, sequences=tuple(checks), findings=tuple(findings))
