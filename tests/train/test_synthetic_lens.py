"""Lens distortion: both directions against each other and against OpenCV."""

import cv2
import numpy as np
import pytest

from bathyscope.errors import GeometryError
from bathyscope_train.data.synthetic.domain import CameraRanges
from bathyscope_train.data.synthetic.lens import PINHOLE, distort, draw_distortion, unbend, undistort

LENSES = [(-0.08, 0.004), (-0.2, 0.03), (0.05, 0.002), (-0.25, 0.06)]


def grid(reach: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    axis = np.linspace(-reach, reach, 15)
    return np.stack(np.meshgrid(axis, axis * 0.8), axis=-1)


@pytest.mark.parametrize("k", LENSES)
def test_undistort_is_the_inverse_of_distort(k: tuple[float, float]) -> None:
    points = grid(1.6)
    np.testing.assert_allclose(undistort(distort(points, k), k), points, atol=1e-9)
    np.testing.assert_allclose(distort(undistort(points, k), k), points, atol=1e-9)


@pytest.mark.parametrize("k", LENSES)
def test_distortion_is_that_of_opencv(k: tuple[float, float]) -> None:
    points = grid(0.8)
    lens = np.array([k[0], k[1], 0.0, 0.0, 0.0])
    rays = np.concatenate([points.reshape(-1, 2), np.ones((points.size // 2, 1))], axis=1)
    shown = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), lens)[0].reshape(points.shape)
    np.testing.assert_allclose(distort(points, k), shown, atol=1e-12)
    back = cv2.undistortPoints(0.5 * shown.reshape(-1, 1, 2), np.eye(3), lens)
    np.testing.assert_allclose(undistort(0.5 * shown, k), back.reshape(points.shape), atol=2e-4)  # OpenCV: 5 rounds


@pytest.mark.parametrize("k", LENSES)
def test_the_kernel_unbends_as_the_array_does(k: tuple[float, float]) -> None:
    points = grid(1.9).reshape(-1, 2)
    np.testing.assert_allclose([unbend(a, b, *k) for a, b in points], undistort(points, k), atol=1e-11)
    assert all(unbend(a, b, *PINHOLE) == (a, b) for a, b in points)


def test_a_lens_that_folds_back_is_refused_with_its_cure() -> None:
    with pytest.raises(GeometryError, match=r"folds back .* k2 > 0\.45"):
        undistort(np.array([[1.3, 0.0]]), (-0.25, 0.0))


def test_drawn_lenses_bend_the_corner_within_their_range_and_give_every_pixel_a_ray() -> None:
    random = np.random.default_rng(3)
    ranges = CameraRanges(distorted=0.75)
    lenses = [draw_distortion(random, ranges, reach=2.0) for _ in range(200)]
    bends = np.array([lens.k1 * 4.0 for lens in lenses])
    assert ((bends >= -0.22) & (bends <= 0.06)).all()
    assert 0.65 < np.mean(bends != 0) < 0.85
    for lens in lenses:
        undistort(grid(1.5), lens)


def test_without_distorted_lenses_all_are_pinholes() -> None:
    assert draw_distortion(np.random.default_rng(0), CameraRanges(), reach=1.0) == PINHOLE
