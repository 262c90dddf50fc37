"""Windows of videos without ground truth: n frames of one shot, far enough apart that the camera moves.

Which frames, which crop and which changes follow from the seed, the step and the place in the batch alone, so a run
that goes on after a crash draws the windows that the first would have drawn, in whatever process. Numpy only: worker
processes do not load torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, PositiveFloat, PositiveInt, model_validator

from bathyscope.camera import F64, crop_intrinsics, rebase, scale_intrinsics
from bathyscope.errors import DatasetError
from bathyscope.vision.field_of_view import FieldOfView
from bathyscope.vision.grid import Grid, choose_size
from bathyscope_train.data.clip_changes import (
    F32,
    ClipChanges,
    DrawnChanges,
    crop_view,
    draw_changes,
    mirror_frames,
    mirror_intrinsics,
    mirror_poses,
    recolour,
)
from bathyscope_train.data.clip_pictures import to_model_quickly
from bathyscope_train.data.clip_survey import survey_clips
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.data.survey_files import ClipSurvey, SurveySettings


class WindowSettings(BaseModel, frozen=True, extra="forbid"):
    """What a window is. The paper states 16 frames; the rest is ours."""

    frames: PositiveInt = 16
    size: tuple[PositiveInt, PositiveInt] | None = Field(
        default=None, description="Height and width for all windows; else each video's own proportions."
    )
    pixels: PositiveInt = Field(default=62720, description="Area where no size is given: 224 x 280.")
    patch: PositiveInt = Field(default=14, description="Height and width are multiples of this.")
    motion: PositiveFloat = Field(
        default=0.01, description="Wanted motion between neighbouring frames, as a share of the picture's width."
    )
    motion_jitter: float = Field(default=2.0, ge=1, description="The wanted motion is drawn within this factor.")
    max_stride: PositiveInt = Field(default=8, description="Largest step between frames of a window.")
    changes: ClipChanges = ClipChanges()
    survey: SurveySettings = SurveySettings()

    @model_validator(mode="after")
    def _whole_patches(self) -> Self:
        if self.size is not None and (self.size[0] % self.patch or self.size[1] % self.patch):
            raise ValueError(f"size {self.size} is not made of whole patches of {self.patch} pixels")
        return self


@dataclass(frozen=True, slots=True)
class FrameWindow:
    """One window as the network sees it."""

    frames: F32
    """(t, 3, h, w) RGB in [0, 1]; 0 outside the field of view."""
    inside: NDArray[np.bool_]
    """(h, w) pixels wholly inside the field of view."""
    name: str
    """Of the video."""
    indices: tuple[int, ...]
    """Numbers of the frames in their video, in the order of the window."""
    intrinsics: F64 | None
    """(3, 3) for (h, w), where the data set has them."""
    world_from_camera: F64 | None
    """(t, 4, 4) in the data set's unit, frame 0 the identity; where all frames have poses."""


@dataclass(frozen=True)
class ClipWindows:
    """Draws windows from videos.

    Attributes:
        clips: Videos and what a first pass found in them.
        settings: What a window is.
        seed: Of everything that is drawn.
        shares: How often each video is drawn, relative to its length.
        notes: What was left out, in words, for the log.
    """

    clips: tuple[tuple[DataSequence, ClipSurvey], ...]
    settings: WindowSettings
    seed: int
    shares: tuple[float, ...]
    notes: tuple[str, ...] = ()

    @classmethod
    def survey(
        cls,
        sequences: Sequence[DataSequence],
        settings: WindowSettings | None = None,
        *,
        seed: int = 0,
        shares: Sequence[float] | None = None,
        cache: Path | None = None,
        workers: int = 2,
    ) -> Self:
        """Look at every video once and keep those that hold a window.

        Args:
            sequences: Videos.
            settings: What a window is.
            seed: Of everything that is drawn.
            shares: How often each video is drawn, relative to its length; 1 unless given.
            cache: Folder that keeps what the pass found, for the next run.
            workers: Videos looked at at the same time.

        Raises:
            DatasetError: If no video holds a window; says why for each.
        """
        settings = settings or WindowSettings()
        weight = {id(sequence): share for sequence, share in zip(sequences, shares or [], strict=shares is not None)}
        found, notes = survey_clips(sequences, settings.survey, cache, workers)
        good: list[tuple[DataSequence, ClipSurvey]] = []
        for sequence, survey in found:
            notes += [f"{sequence.name}: {note}" for note in survey.notes]
            longest = int(np.diff(survey.shots).max())
            if longest < settings.frames:
                notes.append(
                    f"{sequence.name}: left out: its longest shot has {longest} frames in which the camera moves, a "
                    f"window has {settings.frames}"
                )
            else:
                good.append((sequence, survey))
        if not good:
            raise DatasetError(f"no video holds a window of {settings.frames} frames: {'; '.join(notes[:8])}")
        return cls(tuple(good), settings, seed, tuple(weight.get(id(s), 1.0) for s, _ in good), tuple(notes))

    def draw(self, step: int, slot: int = 0) -> FrameWindow:
        """The window of one place in the batch of one step; always the same.

        Raises:
            DatasetError: If a frame that could be read before cannot be read now.
        """
        random = np.random.default_rng([self.seed, step, slot])
        sequence, survey = self.clips[int(random.choice(len(self.clips), p=self._chances()))]
        indices = choose_frames(survey, self.settings, random)
        drawn = draw_changes(self.settings.changes, random)
        return self._cut(sequence, survey, indices[::-1] if drawn.reverse else indices, drawn)

    def whole(self, clip: int, start: int = 0, stride: int = 1) -> FrameWindow:
        """Frames of one video from ``start`` on, unchanged: to look at, or to validate on."""
        sequence, survey = self.clips[clip]
        chosen = survey.kept[start : start + stride * self.settings.frames : stride]
        unchanged = draw_changes(ClipChanges.none(), np.random.default_rng(0))
        return self._cut(sequence, survey, [int(index) for index in chosen], unchanged)

    def _chances(self) -> NDArray[np.float64]:
        weight = np.array(
            [share * len(survey.kept) for share, (_, survey) in zip(self.shares, self.clips, strict=True)]
        )
        return np.asarray(weight / weight.sum())

    def _cut(self, sequence: DataSequence, survey: ClipSurvey, indices: list[int], drawn: DrawnChanges) -> FrameWindow:
        grid = self._grid(survey.view, drawn)
        frames = np.stack([to_model_quickly(grid, image) for image in _read(sequence, survey, indices)])
        size = grid.size
        intrinsics = None if sequence.intrinsics is None else intrinsics_at(sequence.intrinsics, grid)
        poses = None if sequence.world_from_camera is None else sequence.world_from_camera[indices]
        known = poses is not None and bool(np.isfinite(poses).all())
        return FrameWindow(
            frames=np.ascontiguousarray(mirror_frames(recolour(frames, drawn), drawn), np.float32),
            inside=np.ascontiguousarray(mirror_frames(grid.inside, drawn), np.bool_),
            name=sequence.name,
            indices=tuple(indices),
            intrinsics=None if intrinsics is None else mirror_intrinsics(intrinsics, size, drawn),
            world_from_camera=mirror_poses(rebase(poses), drawn) if known and poses is not None else None,
        )

    def _grid(self, view: FieldOfView, drawn: DrawnChanges) -> Grid:
        wanted = self.settings.size
        cropped = crop_view(view, drawn, None if wanted is None else wanted[1] / wanted[0])
        if wanted is None:
            top, left, bottom, right = view.box  # of the whole view, so that all windows of a video have one size
            wanted = choose_size((bottom - top, right - left), self.settings.patch, self.settings.pixels)
        return Grid.of(cropped, wanted)


def choose_frames(survey: ClipSurvey, settings: WindowSettings, random: np.random.Generator) -> list[int]:
    """Numbers of a window's frames: from one shot, in order, with the stride at which the camera moves enough.

    The motion that is asked for is drawn about the wanted one; the stride is the smallest that gives it on average from
    a random start on, at most ``max_stride``, and less where the shot is too short.
    """
    wanted = settings.motion * float(settings.motion_jitter ** random.uniform(-1, 1))
    lengths = np.diff(survey.shots)
    rooms = np.maximum(lengths - settings.frames + 1, 0)
    place = int(random.integers(rooms.sum()))
    shot = int(np.searchsorted(np.cumsum(rooms), place, side="right"))
    start = int(place - rooms[:shot].sum())
    motion = survey.motion[survey.shots[shot] : survey.shots[shot + 1]]
    ahead = motion[start + 1 : start + 1 + settings.frames * settings.max_stride]
    mean = float(ahead.mean()) if len(ahead) else 0.0
    longest = (len(motion) - 1) // max(settings.frames - 1, 1) if settings.frames > 1 else 1
    stride = settings.max_stride if mean <= 0 else int(np.ceil(wanted / mean))
    stride = max(min(stride, settings.max_stride, longest), 1)
    start = min(start, len(motion) - 1 - stride * (settings.frames - 1))
    first = int(survey.shots[shot]) + start
    return [int(survey.kept[first + stride * k]) for k in range(settings.frames)]


def _read(sequence: DataSequence, survey: ClipSurvey, indices: list[int]) -> list[NDArray[np.uint8]]:
    """Frames in the order of ``indices``, read in the order of the file, which a video needs."""
    images = {}
    for index in sorted(set(indices)):
        image = sequence.frames.read(index)
        if image.shape[:2] != survey.size:
            raise DatasetError(f"{sequence.frames.where(index)}: its size has changed since the first pass")
        images[index] = image
    return [images[index] for index in indices]


def intrinsics_at(intrinsics: F64, grid: Grid) -> F64:
    """Intrinsics (3, 3) at source size for the network's image."""
    top, left, _, _ = grid.field_of_view.box
    return scale_intrinsics(crop_intrinsics(intrinsics, left, top), grid.crop_size, grid.size)
