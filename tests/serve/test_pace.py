"""Key frames: as far apart as the picture moves."""

from __future__ import annotations

import cv2
import numpy as np

from bathyscope_serve.engine_settings import PaceSettings
from bathyscope_serve.pace import paced
from bathyscope_serve.session import SmallFrame

SIZE = (96, 120)


def texture() -> np.ndarray:
    noise = np.random.default_rng(5).uniform(size=(SIZE[0], 400)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.asarray((smooth - smooth.min()) / np.ptp(smooth))


def keys(shifts: list[int], *, cut: int | None = None, black: tuple[int, ...] = ()) -> list[int]:
    """Numbers of the key frames of a picture that slides by whole pixels."""
    picture = texture()
    frames = [
        (SmallFrame(i, i / 25, np.repeat(picture[None, :, x : x + SIZE[1]], 3, 0) * (i not in black)), i == cut)
        for i, x in enumerate(shifts)
    ]
    settings = PaceSettings(motion=0.02, longest=5)
    return [frame.index for frame, _, key in paced(frames, settings, np.ones(SIZE, np.bool_)) if key]


def test_a_key_frame_follows_when_the_picture_has_moved_far_enough() -> None:
    """2 % of 120 pixels is 2.4: every frame at 3 pixels a frame, every third at 1."""
    assert keys([3 * i for i in range(7)]) == list(range(7))
    assert keys(list(range(10))) == [0, 3, 6, 9]


def test_a_still_camera_has_key_frames_too() -> None:
    assert keys([0] * 12) == [0, 5, 10]


def test_a_shot_begins_with_a_key_frame() -> None:
    assert keys([0] * 9, cut=3) == [0, 3, 8]


def test_black_frames_are_no_key_frames_but_for_the_first_of_a_shot_and_the_longest_wait() -> None:
    assert keys(list(range(10)), black=(2, 5)) == [0, 3, 6, 9]
    assert keys([0] * 9, black=(3, 5), cut=3) == [0, 3, 8]
    assert keys([0] * 12, black=tuple(range(12))) == [0, 5, 10]
