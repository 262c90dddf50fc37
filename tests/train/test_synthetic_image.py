"""The image side of a rendered clip: each effect against its closed form, and nothing when off."""

import numpy as np
import numpy.typing as npt
import pytest

from bathyscope_train.data.synthetic import DOMAINS
from bathyscope_train.data.synthetic.domain import AirRanges, SensorRanges
from bathyscope_train.data.synthetic.focus import blur_px, defocus
from bathyscope_train.data.synthetic.haze import CLEAR, Haze, add_haze, draw_haze
from bathyscope_train.data.synthetic.lens import PINHOLE, Distortion
from bathyscope_train.data.synthetic.optics import Sensor, develop, draw_sensor, form_image
from bathyscope_train.data.synthetic.processor import (
    colour_noise,
    hold_blocks,
    part_colours,
    scatter,
    sharpen,
    white_balance,
    writing,
)
from bathyscope_train.data.synthetic.shutter import advance, image_motion, interlace, smear
from bathyscope_train.data.synthetic.view import draw_view

SIZE = (40, 50)


def picture(seed: int = 0, size: tuple[int, int] = SIZE) -> npt.NDArray[np.float32]:
    return np.random.default_rng(seed).uniform(0.1, 1.0, (*size, 3)).astype(np.float32)


def sensor(**changes: object) -> Sensor:
    numbers = dict.fromkeys(("lag", "vignette", "shoulder", "noise", "blur_px"), 0.0)
    rest = {"gamma": 1.0, "exposure": 0.5, "metering": 50.0, "clipping": 1.0, "quality": None}
    return Sensor(**(numbers | rest | {"view": np.ones(SIZE, np.float32)} | changes))  # type: ignore[arg-type]


def shown(radiance: npt.NDArray[np.float32], **changes: object) -> npt.NDArray[np.float64]:
    return develop(np.random.default_rng(0), radiance, sensor(**changes)).astype(float)


def test_with_everything_off_the_lens_sees_the_radiance_itself() -> None:
    radiance, depth = picture()[None], np.full((1, *SIZE), 20.0, np.float32)
    assert form_image(radiance, depth, np.zeros((1, *SIZE, 2), np.float32), 40.0, sensor()) is radiance


@pytest.mark.parametrize("name", ["source", "shifted"])
def test_the_narrow_domains_have_no_effect_that_came_later(name: str) -> None:
    drawn = draw_sensor(np.random.default_rng(1), DOMAINS[name].sensor, SIZE)
    plain = sensor()
    for field in ("haze", "aperture_mm", "shutter", "interlaced", "glare", "fringe_px", "balance", "shot", "read"):
        assert getattr(drawn, field) == getattr(plain, field)
    for field in ("grain_px", "chroma", "sharpen", "hold", "overlay"):
        assert getattr(drawn, field) == getattr(plain, field)
    assert draw_haze(np.random.default_rng(1), DOMAINS[name].air) is CLEAR


def test_a_thin_lens_spreads_by_the_difference_of_the_inverse_depths() -> None:
    depth = np.array([[10.0, 20.0, 40.0, 0.0]], np.float32)
    expected = 0.25 * 0.5 * 100.0 * np.array([[0.05, 0.0, 0.025, 0.0]])  # sigma is a quarter of the diameter A f |..|
    np.testing.assert_allclose(blur_px(depth, 100.0, 0.5, 20.0), expected, rtol=1e-5)


@pytest.mark.parametrize("spread", [0.3, 0.9, 2.0])
def test_defocus_conserves_light_and_softens(spread: float) -> None:
    image = picture(size=(60, 140))
    blurred = defocus(image, np.full(image.shape[:2], spread, np.float32))
    assert blurred.mean() == pytest.approx(image.mean(), rel=5e-3)
    assert blurred.std() < 0.9 * image.std()


def test_a_point_out_of_focus_has_the_stated_second_moment() -> None:
    image = np.zeros((61, 141, 3), np.float32)
    image[30, 70] = 1.0
    spread = 3.5 * 141 / 140 * 0.5  # one of the four copies
    blurred = defocus(image, np.full((61, 141), spread, np.float32))[..., 0]
    u = np.arange(141) - 70.0
    assert (blurred.sum(axis=0) * u**2).sum() == pytest.approx(spread**2, rel=0.03)


def test_what_is_in_focus_stays_sharp_beside_what_is_not() -> None:
    image, spread = picture(size=(60, 140)), np.zeros((60, 140), np.float32)
    spread[:, 70:] = 2.0
    blurred = defocus(image, spread)
    np.testing.assert_allclose(blurred[:, :60], image[:, :60], atol=1e-6)
    assert blurred[:, 80:].std() < 0.5 * image[:, 80:].std()


def test_a_picture_advances_along_its_motion() -> None:
    image, motion = picture(), np.zeros((*SIZE, 2), np.float32)
    motion[..., 0], motion[..., 1] = 4.0, -2.0
    later = advance(image, motion, 0.5)
    np.testing.assert_allclose(later[:-1, 2:], image[1:, :-2], atol=1e-6)


def test_motion_blur_is_the_mean_over_the_open_shutter_and_centred() -> None:
    image, motion = np.zeros((*SIZE, 3), np.float32), np.zeros((*SIZE, 2), np.float32)
    image[:, 25] = 1.0
    motion[..., 0] = 10.0
    row = smear(image, motion, 0.5)[20, :, 0]  # 5 pixels
    u = np.arange(SIZE[1])
    assert row.sum() == pytest.approx(1.0, abs=1e-5)
    assert (row * u).sum() == pytest.approx(25.0, abs=1e-4)
    assert (row * (u - 25.0) ** 2).sum() == pytest.approx(25 / 12, rel=0.35)  # a box of 5, sampled by 7 taps
    assert smear(image, 0 * motion, 0.5) is image


def test_odd_rows_of_interlaced_video_come_from_half_a_frame_later() -> None:
    image, motion = picture(), np.zeros((*SIZE, 2), np.float32)
    motion[..., 0] = 6.0
    woven = interlace(image, motion)
    np.testing.assert_array_equal(woven[::2], image[::2])
    np.testing.assert_allclose(woven[1::2, 3:], image[1::2, :-3], atol=1e-6)


@pytest.mark.parametrize("lens", [PINHOLE, Distortion(-0.15, 0.02)], ids=["pinhole", "barrel"])
def test_image_motion_of_a_plane_approached_is_the_closed_form(lens: Distortion) -> None:
    poses = np.stack([np.eye(4)] * 3)
    poses[:, 2, 3] = [0.0, 2.0, 4.0]
    depth = np.stack([np.full(SIZE, 20.0 - z, np.float32) for z in poses[:, 2, 3]])
    intrinsics = np.array([[30.0, 0, 25], [0, 30.0, 20], [0, 0, 1]])
    motion = image_motion(depth, poses, intrinsics, lens)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    shown_at = np.stack([u - 25, v - 20], axis=-1) / 30
    radius = np.linalg.norm(shown_at, axis=-1)
    table = np.linspace(0, 2, 20_001)
    bent = table * (1 + lens.k1 * table**2 + lens.k2 * table**4)
    moved = np.interp(np.interp(radius, bent, table) * 20 / 18, table, bent)  # nearer: rays spread by z / (z - 2)
    np.testing.assert_allclose(motion[0], shown_at * ((moved / radius) - 1)[..., None] * 30, atol=1e-3)
    assert (np.sign(motion[2]) == np.sign(motion[0])).all()


def test_smoke_takes_the_stated_share_at_its_depth_and_squares_with_twice_the_way() -> None:
    radiance = np.full((1, 3, 3), 2.0, np.float32)
    depth = np.array([[10.0, 20.0, 1e-6]], np.float32)
    haze = Haze(opacity=0.4, veil=(0.5, 0.5, 1.0))
    hazy = add_haze(radiance, depth, haze, 0, depth_mm=10.0, metered=3.0)
    passed = np.array([0.6, 0.36, 1.0])[:, None]
    np.testing.assert_allclose(hazy[0], passed * 2.0 + (1 - passed) * 3.0 * np.array([0.5, 0.5, 1.0]), rtol=1e-4)


def test_smoke_is_drawn_as_often_as_its_share_and_moves() -> None:
    random = np.random.default_rng(0)
    airs = [draw_haze(random, AirRanges(smoky=0.5, wisps=(0.5, 0.6))) for _ in range(60)]
    assert 15 < sum(air is CLEAR for air in airs) < 45
    hazy = next(air for air in airs if air is not CLEAR)
    depth, dark = np.full(SIZE, 10.0, np.float32), np.zeros((*SIZE, 3), np.float32)
    first, later = (add_haze(dark, depth, hazy, frame, depth_mm=10.0, metered=1.0) for frame in (0, 8))
    assert first.std() > 0
    assert np.abs(first - later).max() > 1e-3


def test_white_balance_changes_colour_and_not_the_product() -> None:
    gains = white_balance(0.3, -0.1)
    assert np.log(gains[0] / gains[2]) == pytest.approx(0.3, abs=1e-6)
    assert np.log(gains[1] / np.sqrt(gains[0] * gains[2])) == pytest.approx(-0.1, abs=1e-6)
    assert gains.prod() == pytest.approx(1.0, abs=1e-6)


def test_a_grey_card_shows_the_balance_and_its_drift() -> None:
    grey = np.full((21, *SIZE, 3), 0.2, np.float32)
    frames = shown(grey, balance=(0.2, 0.0), drift=(0.1, 0.0, np.pi / 2), exposure=0.3)
    ratio = np.log(frames[:, 0, 0, 0] / frames[:, 0, 0, 2])
    assert ratio[0] == pytest.approx(0.3, abs=0.02)
    assert ratio[20] == pytest.approx(0.1, abs=0.02)  # half a period of 40 frames later


def test_photon_noise_grows_with_the_root_of_light_and_read_noise_does_not() -> None:
    steps = np.ones((1, *SIZE, 3), np.float32)
    steps[:, :, 25:] = 4.0
    for changes, ratio in (({"shot": 0.08}, 2.0), ({"read": 0.04}, 1.0)):
        frame = shown(steps, metering=10.0, exposure=0.2, **changes)[0]
        assert frame[:, 25:].std() / frame[:, :25].std() == pytest.approx(ratio, rel=0.1)


def test_demosaiced_noise_keeps_its_strength_and_gains_grain() -> None:
    white = np.random.default_rng(0).standard_normal((120, 140, 3)).astype(np.float32)
    coloured = colour_noise(white, 0.8, 0.5)
    assert coloured.mean(axis=-1).std() == pytest.approx(white.mean(axis=-1).std(), rel=0.05)
    chroma = (coloured - coloured.mean(axis=-1, keepdims=True)).std()
    assert chroma / (white - white.mean(axis=-1, keepdims=True)).std() == pytest.approx(0.5, rel=0.07)
    grey = coloured.mean(axis=-1)
    assert np.corrcoef(grey[:, 1:].ravel(), grey[:, :-1].ravel())[0, 1] > 0.5
    assert colour_noise(white, 0.0, 1.0) is white


def test_sharpening_overshoots_at_an_edge_and_leaves_the_flat_alone() -> None:
    level = np.full((*SIZE, 3), 0.3, np.float32)
    level[:, 25:] = 0.6
    sharp = sharpen(level, 1.0, 1.0)
    assert sharp.max() > 0.68
    assert sharp.min() < 0.22
    np.testing.assert_allclose(sharp[:, :15], 0.3, atol=1e-5)
    assert sharp.mean() == pytest.approx(level.mean(), rel=1e-3)


def test_glare_spreads_light_and_keeps_its_sum() -> None:
    light = np.zeros((*SIZE, 3), np.float32)
    light[20, 24] = 100.0
    spread = scatter(light, 0.2)
    assert spread.sum() == pytest.approx(light.sum(), rel=1e-3)
    assert spread[20, 24, 0] == pytest.approx(80.0, rel=0.05)
    assert spread[24, 27, 0] > 0


def test_red_and_blue_part_towards_the_sides() -> None:
    light = np.zeros((*SIZE, 3), np.float32)
    light[:, [2, 47]] = 1.0
    parted = part_colours(light, 1.0)
    u = np.arange(25)
    centres = [(parted[20, :25, c] * u).sum() / parted[20, :25, c].sum() for c in range(3)]
    assert centres[0] < centres[1] < centres[2]
    assert centres[1] - centres[0] == pytest.approx(0.9, abs=0.1)


def test_blocks_that_hardly_change_are_kept_from_the_frame_before() -> None:
    before = np.full((20, 27, 3), 100, np.uint8)
    frame = before + np.uint8(2)
    frame[:8, :8] = 150
    held = hold_blocks(frame, before, 3.0)
    assert (held[:8, :8] == 150).all()
    assert (held[8:] == 100).all()
    np.testing.assert_array_equal(hold_blocks(frame, before, 1.0), frame)


def test_writing_stays_outside_the_view() -> None:
    view = np.zeros(SIZE, np.float32)
    view[:, 15:35] = 1.0
    words = writing(np.random.default_rng(4), SIZE)
    assert words.max() > 0.3
    radiance = picture()[None]
    plain, written = (shown(radiance, view=view, overlay=overlay)[0] for overlay in (None, words))
    np.testing.assert_array_equal(written[:, 15:35], plain[:, 15:35])
    np.testing.assert_allclose(written[:, :15].max(axis=-1), np.floor(words[:, :15] * 255 + 0.5), atol=1)


@pytest.mark.parametrize("shape", ["round", "corners", "rectangle"])
def test_every_shape_of_view_is_centred_where_its_offset_says(shape: str) -> None:
    for seed in range(4):
        ranges = SensorRanges(views={shape: 1.0}, view_offset=(0.1, 0.1))  # type: ignore[dict-item]
        view = draw_view(np.random.default_rng(seed), ranges, (112, 140))
        assert 0.25 < view.mean() < 1.0
        middle = (56 + 14), (70 + 14)
        assert view[middle] == 1.0
        left = view[middle[0], : middle[1]][::-1]
        right = view[middle[0], middle[1] :]
        np.testing.assert_allclose(left[: len(right)], right, atol=0.01)


def test_the_same_seed_develops_the_same_broad_clip() -> None:
    ranges = DOMAINS["broad"].sensor
    frames = []
    for _ in range(2):
        drawn = draw_sensor(
            np.random.default_rng(5), ranges, SIZE, draw_haze(np.random.default_rng(2), AirRanges(smoky=1))
        )
        radiance = np.stack([picture(1), picture(2)])
        depth, motion = np.full((2, *SIZE), 30.0, np.float32), np.full((2, *SIZE, 2), 1.5, np.float32)
        frames.append(develop(np.random.default_rng(3), form_image(radiance, depth, motion, 40.0, drawn), drawn))
    np.testing.assert_array_equal(frames[0], frames[1])
