"""Points that are followed, in pictures whose motion is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from bathyscope.model_spec import InputSpec
from bathyscope.vision.field_of_view import find_field_of_view
from bathyscope.vision.grid import Grid
from bathyscope_serve.engine_settings import TrackSettings
from bathyscope_serve.placed import Sight
from bathyscope_serve.refine.tracks import PointTracker

SIZE = (200, 260)
WANTED = InputSpec(patch=14, pixels=15_680, window=8, overlap=2)
SCALE = np.array(SIZE[::-1]) / (140, 112)
"""From the network's pixels to the source's."""


def texture() -> NDArray[np.uint8]:
    noise = np.random.default_rng(0).uniform(0, 255, (60, 80, 3)).astype(np.float32)
    return np.asarray(cv2.resize(noise, (400, 300), interpolation=cv2.INTER_CUBIC).clip(20, 180), np.uint8)


def view(left: float, top: float) -> NDArray[np.uint8]:
    """The texture, moved by fractions of pixels."""
    motion = np.array([[1, 0, -left], [0, 1, -top]], np.float32)
    return np.asarray(cv2.warpAffine(texture(), motion, SIZE[::-1], flags=cv2.INTER_CUBIC), np.uint8)


def tracker(**settings: int) -> PointTracker:
    grid = Grid.fit(find_field_of_view(np.full((*SIZE, 3), 200, np.uint8).max(2)), WANTED)
    return PointTracker(grid, TrackSettings(**settings))


def shared(first: Sight, second: Sight) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    _, a, b = np.intersect1d(first.ids, second.ids, return_indices=True)
    return first.places[a], second.places[b]


def test_points_go_with_the_picture_to_a_twentieth_of_a_pixel() -> None:
    follow = tracker()
    first = follow.sight(view(20, 20))
    second = follow.sight(view(22.4, 19))
    before, after = shared(first, second)
    assert len(before) > 100
    np.testing.assert_allclose(np.median(SCALE * (after - before), 0), (-2.4, 1.0), atol=0.05)
    assert (np.diff(second.ids) > 0).all()


def test_places_are_pixels_of_the_networks_image() -> None:
    """The corner of a bright square lies where it is, scaled, with pixel centres at a half."""
    picture = np.full((*SIZE, 3), 60, np.uint8)
    picture[100:140, 130:180] = 150
    sight = tracker().sight(picture)
    distance = np.linalg.norm(SCALE * sight.places - (130.0, 100.0), axis=1)
    assert distance.min() < 1.5


def test_a_new_shot_and_a_highlight_end_points_for_good() -> None:
    follow = tracker()
    first = follow.sight(view(20, 20))
    bright = view(20, 20)
    bright[60:120, 60:140] = 255
    second = follow.sight(bright)
    inside = (np.abs(SCALE * second.places - (100, 90)) < (40, 30)).all(1)
    assert not inside.any()
    assert len(shared(first, second)[0]) > 15
    follow.forget()
    assert not set(follow.sight(view(20, 20)).ids.tolist()) & {*first.ids.tolist(), *second.ids.tolist()}


def test_large_frames_are_followed_at_the_size_asked_for() -> None:
    follow = tracker(pixels=13_000)
    sight = follow.sight(view(20, 20))
    assert len(sight.ids) > 20
    after = follow.sight(view(24, 20))
    before, moved = shared(sight, after)
    np.testing.assert_allclose(np.median(SCALE * (moved - before), 0), (-4, 0), atol=0.15)


def test_a_black_picture_has_no_points() -> None:
    assert len(tracker().sight(np.zeros((*SIZE, 3), np.uint8)).ids) == 0


@pytest.mark.parametrize("frames", [1, 2])
def test_points_come_back_after_frames_that_show_nothing(frames: int) -> None:
    """Heavily blurred or black ones, in the middle of a motion; nothing is kept of what was followed in them."""
    follow = tracker()
    first = follow.sight(view(20, 20))
    blurred = np.asarray(cv2.GaussianBlur(view(22, 20), (0, 0), 12), np.uint8)
    for picture in (blurred, np.zeros_like(blurred))[:frames]:
        assert len(shared(first, follow.sight(picture))[0]) < 0.1 * len(first.ids)
    again = follow.sight(view(24, 19))
    before, after = shared(first, again)
    assert len(before) > 0.7 * len(first.ids)
    np.testing.assert_allclose(np.median(SCALE * (after - before), 0), (-4, 1), atol=0.05)
    assert (np.diff(again.ids) > 0).all()
    assert len(again.ids) <= TrackSettings().points


def test_points_that_stay_away_are_given_up() -> None:
    follow = tracker()
    first = follow.sight(view(20, 20))
    for _ in range(7):
        follow.sight(np.zeros((*SIZE, 3), np.uint8))
    assert not len(shared(first, follow.sight(view(20, 20)))[0])
