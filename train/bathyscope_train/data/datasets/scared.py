"""SCARED (MICCAI EndoVis 2019): sequences for training and evaluation, from the official tree or a prepared one.

Depth is in millimetres and absolute; images and depth are those of the left eye, distorted and not rectified. Only a
keyframe was measured: the depth of all other frames is the keyframe's, moved by the robot's kinematics.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.scared_corrected import read_corrections
from bathyscope_train.data.datasets.scared_sequence import open_keyframe, open_sequence
from bathyscope_train.data.datasets.scared_splits import frame_counts, scared_split, sequence_order
from bathyscope_train.data.datasets.scared_tree import find_scared
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.evaluation.sequences import EvaluationSet, Gap

FrameChoice = Literal["all", "keyframes", "corrected"]


def open_scared(
    root: Path, split: str = "video-test", *, frames: FrameChoice = "all", corrected: Path | None = None
) -> EvaluationSet:
    """SCARED as an evaluation runs over it.

    Args:
        root: Any of the trees of :mod:`~bathyscope_train.data.datasets.scared_tree`.
        split: One of :func:`~bathyscope_train.data.datasets.scared_splits.scared_splits`.
        frames: ``keyframes`` keeps the measured frames alone: the keyframe's own images and depth where they are
            there, else the first frame of each sequence. ``corrected`` keeps those that ``corrected`` has.
        corrected: Folder with poses and depth of SCARED-C, laid over the tree; see
            :mod:`~bathyscope_train.data.datasets.scared_corrected`.

    Raises:
        DatasetError: If the root holds no SCARED, or nothing of the split.
    """
    if frames == "corrected" and corrected is None:
        raise DatasetError("corrected frames are asked for, but no folder of SCARED-C's poses and depth is given")
    chosen, found = scared_split(split), find_scared(root)
    corrections = {} if corrected is None else read_corrections(corrected)
    sequences: list[DataSequence] = []
    gaps: list[Gap] = []
    for name in sorted(chosen.frames, key=sequence_order):
        folder = found.get(name)
        if folder is None or (folder.layout == "still" and frames != "keyframes"):
            reason = "no such folder" if folder is None else "no video or frames, only the keyframe"
            gaps.append(Gap(name, "", f"{root}: {reason}"))
            continue
        still = open_keyframe(folder) if frames == "keyframes" else None
        if still is not None:
            sequences.append(still)
            continue
        opened = open_sequence(folder, corrections.get(name))
        gaps += [Gap(name, "", problem) for problem in opened.problems]
        picked, missing = _pick(opened.sequence, chosen.frames[name], frames)
        gaps += missing
        if len(picked):
            sequences.append(picked)
    if not sequences:
        reasons = "; ".join(f"{gap.sequence}: {gap.reason}" for gap in gaps[:4])
        raise DatasetError(f"{root}: nothing of the {chosen.words}, {frames} frames ({reasons})")
    words = chosen.words if frames == "all" else f"{chosen.words}, {frames} frames only"
    return EvaluationSet("scared", tuple(sequences), words, tuple(gaps))


def published_shortfall(name: str, found: int) -> str | None:
    """What a sequence lacks or has too much against the published count; ``None`` if it agrees."""
    published = frame_counts().get(name)
    if published is None or found == published:
        return None
    return f"{found} frames, published are {published} ({found - published:+d})"


def _pick(sequence: DataSequence, wanted: Sequence[int] | None, choice: FrameChoice) -> tuple[DataSequence, list[Gap]]:
    gaps: list[Gap] = []
    shortfall = published_shortfall(sequence.name, len(sequence)) if wanted is None else None
    if shortfall is not None:
        gaps.append(Gap(sequence.name, "", shortfall))
    if wanted is not None:
        index = {name: number for number, name in enumerate(sequence.frame_names)}
        names = [f"{number:06d}" for number in wanted]
        absent = [name for name in names if name not in index]
        gaps += [Gap(sequence.name, name, "the split names this frame; it is not there") for name in absent]
        sequence = sequence.select([index[name] for name in names if name in index])
    if choice != "all":
        group = sequence.groups.get(choice, np.zeros(len(sequence), np.bool_))
        if not group.any():
            gaps.append(Gap(sequence.name, "", f"none of its frames is among the {choice} ones"))
        sequence = sequence.select(np.flatnonzero(group).tolist())
    return sequence, gaps
