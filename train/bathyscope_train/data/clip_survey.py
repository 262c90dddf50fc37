"""A first pass over a video: which frames can be trained on, where scenes are cut, how far the camera moves.

The pass looks at small pictures of the field of view. It drops frames that cannot be read, are of another size or
black, and frames that show nothing new since the last one kept: motion is the median length of dense optical flow, as
a share of the picture's width. What it finds can be kept in a folder, so a run that goes on does not look again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import Size
from bathyscope.errors import DatasetError
from bathyscope.vision.cuts import CutDetector
from bathyscope.vision.field_of_view import DARK, FieldOfView, find_field_of_view
from bathyscope.vision.grid import Grid, choose_size
from bathyscope.vision.motion import MotionMeter
from bathyscope_train.data.clip_pictures import to_model_quickly
from bathyscope_train.data.datasets.sequence import DataSequence, Image
from bathyscope_train.data.survey_files import (
    ClipSurvey,
    SurveySettings,
    read_survey,
    survey_fingerprint,
    write_survey,
)

_SAMPLES = 24
"""Frames from all over the video that the field of view is read from."""
_LIT_SHARE = 0.01
"""Of the pixels inside the field of view, that must not be black."""
_NAMED = 5


def survey_clip(
    sequence: DataSequence, settings: SurveySettings | None = None, cache: Path | None = None
) -> ClipSurvey:
    """Look at every frame of a video once.

    Args:
        sequence: The video.
        settings: What counts as usable.
        cache: Folder in which the result is kept, under a name that changes with the files and the settings.

    Raises:
        DatasetError: If not one frame can be read, or all are black.
    """
    settings = settings or SurveySettings()
    if cache is None:
        return _survey(sequence, settings)
    path = cache / f"survey_{survey_fingerprint(sequence, settings)}.npz"
    known = read_survey(path) if path.is_file() else None
    if known is None:
        known = _survey(sequence, settings)
        write_survey(path, known)
    return known


def survey_clips(
    sequences: Sequence[DataSequence],
    settings: SurveySettings | None = None,
    cache: Path | None = None,
    workers: int = 2,
) -> tuple[list[tuple[DataSequence, ClipSurvey]], list[str]]:
    """Survey several videos; those that cannot be used are left out, with the reason in the second list."""

    def look(sequence: DataSequence) -> ClipSurvey | str:
        try:
            return survey_clip(sequence, settings, cache)
        except DatasetError as error:
            return str(error)

    with ThreadPoolExecutor(max(workers, 1)) as pool:
        found = list(pool.map(look, sequences))
    good = [
        (sequence, result) for sequence, result in zip(sequences, found, strict=True) if isinstance(result, ClipSurvey)
    ]
    return good, [result for result in found if isinstance(result, str)]


def _survey(sequence: DataSequence, settings: SurveySettings) -> ClipSurvey:
    size, view = _first_look(sequence)
    top, left, bottom, right = view.box
    grid = Grid.of(view, choose_size((bottom - top, right - left), 4, settings.pixels))
    walk = _Walk(grid, settings)
    for index, image in _readable(sequence, walk):
        if image.shape[:2] != size:
            walk.other_size.append(f"{sequence.frames.where(index)} ({image.shape[1]}x{image.shape[0]})")
        else:
            walk.see(index, image)
    if not walk.kept:
        raise DatasetError(f"{sequence.name}: no frame can be used: {'; '.join(walk.said()) or 'it holds none'}")
    return ClipSurvey(
        name=sequence.name,
        size=size,
        view=view,
        kept=np.array(walk.kept, np.intp),
        motion=np.array(walk.motion),
        shots=np.array([*walk.starts, len(walk.kept)], np.intp),
        notes=tuple(walk.said()),
    )


class _Walk:
    """Goes through a video and keeps what is of use."""

    def __init__(self, grid: Grid, settings: SurveySettings) -> None:
        self.kept: list[int] = []
        self.motion: list[float] = []
        self.starts: list[int] = []
        self.unreadable: list[str] = []
        self.other_size: list[str] = []
        self._black: list[int] = []
        self._still = 0
        self._grid, self._settings = grid, settings
        self._cuts = CutDetector(settings.cuts, grid.inside)
        self._flow = MotionMeter(grid.inside)

    def see(self, index: int, image: Image) -> None:
        """Judge the next frame."""
        small = to_model_quickly(self._grid, image)
        if float((small.max(0)[self._grid.inside] * 255 > DARK).mean()) < _LIT_SHARE:
            self._black.append(index)
            return
        begins = self._cuts.is_cut(small) or not self.kept
        moved = 0.0 if begins else self._flow.since(small)
        if not begins and moved < self._settings.still:
            self._still += 1
            return
        self._flow.keep(small)
        if begins:
            self.starts.append(len(self.kept))
        self.kept.append(index)
        self.motion.append(moved)

    def said(self) -> list[str]:
        """What was left out, in words."""
        found = []
        if self.unreadable:
            found.append(f"{len(self.unreadable)} frames cannot be read: {_some(self.unreadable)}")
        if self.other_size:
            found.append(f"{len(self.other_size)} frames of another size are left out: {_some(self.other_size)}")
        if self._black:
            found.append(f"{len(self._black)} black frames are left out, first number {self._black[0]}")
        if self._still:
            found.append(f"{self._still} frames show nothing new and are left out")
        return found


def _readable(sequence: DataSequence, walk: _Walk) -> Iterator[tuple[int, Image]]:
    for index in range(len(sequence)):
        try:
            image = sequence.frames.read(index)
        except DatasetError as error:
            walk.unreadable.append(str(error))
            continue
        yield index, image


def _samples(sequence: DataSequence) -> Iterator[Image]:
    for index in sorted(set(np.linspace(0, len(sequence) - 1, _SAMPLES).astype(int).tolist())):
        try:
            yield sequence.frames.read(index)
        except DatasetError:
            continue  # named in the pass over all frames


def _first_look(sequence: DataSequence) -> tuple[Size, FieldOfView]:
    """The size that most of the sampled frames have, and the field of view of these."""
    counts: Counter[Size] = Counter()
    brightest: dict[Size, NDArray[np.uint8]] = {}
    for image in _samples(sequence):
        size, level = (image.shape[0], image.shape[1]), image.max(-1)
        counts[size] += 1
        brightest[size] = np.maximum(brightest[size], level) if size in brightest else level
    if not counts:
        image = _first_readable(sequence)
        counts[image.shape[:2]], brightest[image.shape[:2]] = 1, image.max(-1)
    usual = counts.most_common(1)[0][0]
    inside = sequence.inside
    if inside is not None and inside.shape == usual and inside.any():
        return usual, FieldOfView(inside, "hull")
    return usual, find_field_of_view(brightest[usual])


def _first_readable(sequence: DataSequence) -> Image:
    """The first frame that can be read.

    Raises:
        DatasetError: If there is none; with the reason of the first.
    """
    problem: DatasetError | None = None
    for index in range(len(sequence)):
        try:
            return sequence.frames.read(index)
        except DatasetError as error:
            problem = problem or error
    raise DatasetError(f"{sequence.name}: none of its {len(sequence)} frames can be read; first: {problem}")


def _some(names: list[str]) -> str:
    return "; ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
