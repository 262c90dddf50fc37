"""Borders and masks drawn in closed form, and the way from source pixels to the network's and back."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from bathyscope.model_spec import InputSpec
from bathyscope.vision.field_of_view import FieldOfView, find_field_of_view
from bathyscope.vision.grid import Grid, choose_size
from bathyscope_serve.isolation import open_source

SIZE = (240, 320)
DATA = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference")).parent / "data"


def tissue(size: tuple[int, int] = SIZE, seed: int = 0) -> np.ndarray:
    """Bright and uneven, never black."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(70, 220, (9, 12)).astype(np.float32)
    return np.asarray(cv2.resize(coarse, size[::-1], interpolation=cv2.INTER_CUBIC)).clip(50, 255).astype(np.uint8)


def with_outside(picture: np.ndarray, inside: np.ndarray, seed: int = 1) -> np.ndarray:
    """Black with a little noise where ``inside`` is false."""
    noise = np.random.default_rng(seed).integers(0, 16, picture.shape).astype(np.uint8)
    return np.where(inside, picture, noise)


def disc(size: tuple[int, int], x: float, y: float, radius: float) -> np.ndarray:
    rows, columns = np.mgrid[: size[0], : size[1]] + 0.5
    return (columns - x) ** 2 + (rows - y) ** 2 < radius**2


def overlap(found: np.ndarray, truth: np.ndarray) -> float:
    return float((found & truth).sum() / (found | truth).sum())


def assert_close_and_not_outside(found: FieldOfView, truth: np.ndarray, least: float = 0.93) -> None:
    assert overlap(found.mask, truth) > least
    assert (found.mask & ~truth).sum() <= 0.002 * truth.sum()


def test_a_picture_without_border_is_all_inside() -> None:
    found = find_field_of_view(tissue())
    assert found.shape == "full"
    assert found.mask.all()


def test_black_bars_are_cut_off_exactly() -> None:
    inside = np.zeros(SIZE, bool)
    inside[20:230, 35:300] = True
    found = find_field_of_view(with_outside(tissue(), inside))
    assert found.shape == "rectangle"
    assert found.box == (20, 35, 230, 300)
    np.testing.assert_array_equal(found.mask, inside)


@pytest.mark.parametrize(
    ("x", "y", "radius"),
    [(160, 120, 100), (170.3, 118.6, 110.4), (160, 120, 150), (165, 100, 135)],
    ids=["whole", "off_centre", "cut_top_and_bottom", "cut_top"],
)
def test_a_round_mask_becomes_its_circle(x: float, y: float, radius: float) -> None:
    truth = disc(SIZE, x, y, radius)
    found = find_field_of_view(with_outside(tissue(), truth))
    assert found.shape == "round"
    assert_close_and_not_outside(found, truth)


@pytest.mark.parametrize("place", [(160, 120), (90, 130), (160, 60)], ids=["middle", "side", "top"])
def test_a_dark_lumen_stays_inside(place: tuple[int, int]) -> None:
    picture = tissue()
    lumen = disc(SIZE, *place, 50)
    picture[lumen] = 3
    assert find_field_of_view(picture).mask.all()
    truth = disc(SIZE, 160, 120, 105)
    found = find_field_of_view(with_outside(picture, truth))
    assert found.shape == "round"
    assert_close_and_not_outside(found, truth)


def test_a_lumen_on_the_edge_of_the_frame_is_no_border() -> None:
    picture = tissue()
    picture[disc(SIZE, 320, 120, 60)] = 2
    assert find_field_of_view(picture).mask.all()


def test_cut_corners_become_their_hull() -> None:
    truth = np.zeros(SIZE, np.uint8)
    cv2.fillConvexPoly(
        truth, np.array([[60, 0], [260, 0], [319, 60], [319, 180], [260, 239], [60, 239], [0, 180], [0, 60]]), 1
    )
    found = find_field_of_view(with_outside(tissue(), truth > 0))
    assert found.shape == "hull"
    assert_close_and_not_outside(found, truth > 0)


def test_text_beside_the_picture_stays_outside() -> None:
    truth = disc((240, 400), 120, 120, 100)
    picture = with_outside(tissue((240, 400)), truth)
    cv2.putText(picture, "NAME 12:30", (245, 40), cv2.FONT_HERSHEY_SIMPLEX, 0.7, 255, 2)
    found = find_field_of_view(picture)
    assert_close_and_not_outside(found, truth)


@pytest.mark.parametrize("level", [0, 5])
def test_a_black_clip_has_no_outside(level: int) -> None:
    assert find_field_of_view(np.full(SIZE, level, np.uint8)).mask.all()


@pytest.mark.parametrize("size", [(16, 16), (17, 33), (480, 31)])
def test_small_and_narrow_frames_work(size: tuple[int, int]) -> None:
    assert find_field_of_view(tissue(size)).mask.all()


@pytest.mark.skipif(not (DATA / "sinus").is_dir(), reason="no sample data beside the repository")
def test_the_sinus_mask_of_its_authors_is_found() -> None:
    with open_source(DATA / "sinus" / "clip.mp4") as source:
        found = find_field_of_view(source.survey().brightest)
    published = cv2.imread(str(DATA / "sinus" / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    assert found.shape == "round"
    assert overlap(found.mask, published) > 0.93


@pytest.mark.skipif(not (DATA / "laparoscopy").is_dir(), reason="no sample data beside the repository")
def test_the_round_picture_of_the_laparoscope_is_found() -> None:
    with open_source(DATA / "laparoscopy" / "cholecystectomy.mp4") as source:
        found = find_field_of_view(source.survey().brightest)
    assert found.shape == "round"
    assert not found.mask[:, :40].any()
    assert not found.mask[:, -80:].any()
    assert 0.75 < found.mask.mean() < 0.85


WANTED = InputSpec(patch=14, pixels=224 * 280, window=8, overlap=2)


@pytest.mark.parametrize("crop", [(1080, 1920), (400, 426), (1000, 300), (50, 60), (720, 1137)])
def test_the_networks_size_is_whole_patches_of_its_area_and_the_crops_shape(crop: tuple[int, int]) -> None:
    h, w = choose_size(crop, 14, WANTED.pixels)
    assert h % 14 == 0
    assert w % 14 == 0
    assert 0.85 < h * w / WANTED.pixels < 1.18
    assert abs(np.log((w / h) / np.clip(crop[1] / crop[0], 1 / 3, 3))) < 0.08


def circle_grid() -> Grid:
    return Grid.fit(FieldOfView(disc((300, 420), 200, 150, 130), "round"), WANTED)


def test_a_point_keeps_its_direction_from_the_network_to_the_source() -> None:
    grid = circle_grid()
    (h, w), (top, left, bottom, right) = grid.size, grid.field_of_view.box
    k = np.array([[200, 0, w / 2], [0, 210, h / 2], [0, 0, 1.0]])
    point = np.array([0.3, -0.2, 1.0])
    seen = k @ point
    expected = left + seen[0] * (right - left) / w, top + seen[1] * (bottom - top) / h
    np.testing.assert_allclose((grid.intrinsics_to_source(k) @ point)[:2], expected)


def test_the_picture_is_black_outside_and_untouched_inside() -> None:
    grid = circle_grid()
    small = grid.to_model(np.full((300, 420, 3), (255, 51, 0), np.uint8))
    np.testing.assert_allclose(
        small[:, grid.inside], np.array([[1], [0.2], [0]]) * np.ones(grid.inside.sum()), atol=1e-3
    )
    assert small[:, 0, 0].max() == 0


def test_a_slanted_plane_comes_back_at_source_size() -> None:
    """Linear in pixel coordinates, so linear interpolation is exact away from the rim."""
    grid = circle_grid()
    (h, w), (top, left, bottom, right) = grid.size, grid.field_of_view.box
    rows, columns = np.mgrid[:h, :w] + 0.5
    values = (1 + columns / w + 2 * rows / h).astype(np.float32)
    values[~grid.inside] = 1e6
    full, valid = grid.to_source(values, grid.inside)
    y, x = np.mgrid[:300, :420] + 0.5
    expected = 1 + (x - left) / (right - left) + 2 * (y - top) / (bottom - top)
    np.testing.assert_array_equal(valid, grid.field_of_view.mask)
    np.testing.assert_allclose(full[valid], expected[valid], atol=0.03)
    core = disc((300, 420), 200, 150, 122)
    np.testing.assert_allclose(full[core], expected[core], atol=2e-4)
    assert (full[~valid] == 0).all()


def test_a_hole_in_what_is_known_never_mixes_with_what_is_not() -> None:
    grid = Grid.fit(FieldOfView(np.ones((112, 140), np.bool_), "full"), WANTED)
    known = np.ones(grid.size, np.bool_)
    known[:, : grid.size[1] // 2] = False
    values = np.where(known, 2.0, 500.0).astype(np.float32)
    full, valid = grid.to_source(values, known)
    np.testing.assert_allclose(full[valid], 2.0, rtol=1e-5)
    assert not valid[:, :66].any()
    assert valid[:, 72:].all()
