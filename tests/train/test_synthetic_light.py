"""Light and material of the rendered world against closed forms, what lies on tissue, and the held-out domain."""

from math import log
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from bathyscope_train.data.synthetic import DOMAINS, render_clip
from bathyscope_train.data.synthetic.domain import LightRanges, MaterialRanges, Palette
from bathyscope_train.data.synthetic.films import Patch, coat_surface
from bathyscope_train.data.synthetic.kernels import render
from bathyscope_train.data.synthetic.light import draw_lamp
from bathyscope_train.data.synthetic.scene import FIELD, Tissue, make_surface
from bathyscope_train.data.synthetic.shading import STRAY, Lamp
from bathyscope_train.data.synthetic.tissue import make_tissue, settle_palette

SIZE = (56, 70)
K = np.array([[40.0, 0.0, 35.0], [0.0, 40.0, 28.0], [0.0, 0.0, 1.0]])
LAMP = Lamp(np.zeros((1, 3)), falloff=2.0, spot=0.0, ambient=0.0, soft_mm=0.0)
PATCH = Patch((40.0, 60.0), wrap=False)
OFF = MaterialRanges()

Array = npt.NDArray[np.float64]


def slopes() -> Array:
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.stack([(columns + 0.5 - 35) / 40, (rows + 0.5 - 28) / 40, np.ones(SIZE)], axis=-1)


@pytest.fixture(scope="module")
def matt() -> Tissue:
    grey = np.full((200, 200, 3), 0.5, np.float32)
    tissue = make_tissue(np.random.default_rng(0), DOMAINS["source"].material, grey, (40.0, 40.0), wrap=False)
    return tissue._replace(mottle=0.0, bump=0.0, specular=0.0, vessel_tint=(1.0, 1.0, 1.0))


def seen(tissue: Tissue, lamp: Lamp = LAMP, distance: float = 30.0) -> Array:
    heights = np.full((200, 200), distance, np.float32)
    surface = make_surface(FIELD, heights, first=(-100.0, -100.0), step=(1.0, 1.0), stride_mm=2.0, feature_mm=3.0)
    return np.asarray(render(surface, tissue, lamp, np.eye(4), K, SIZE).radiance, np.float64)


def test_a_tilted_beam_is_brightest_along_its_axis(matt: Tissue) -> None:
    axis = np.array([0.2, -0.1, np.sqrt(0.95)])
    rays = slopes() / np.linalg.norm(slopes(), axis=-1, keepdims=True)
    spot = LAMP._replace(spot=3.0, axis=tuple(axis))
    np.testing.assert_allclose(seen(matt, spot)[..., 0] / seen(matt)[..., 0], (rays @ axis) ** 3, rtol=1e-3)


def test_a_beam_with_an_edge_is_whole_inside_and_stray_outside(matt: Tissue) -> None:
    inner, outer = np.cos(np.radians([15.0, 25.0]))
    share = seen(matt, LAMP._replace(cone=(inner, outer)))[..., 1] / seen(matt)[..., 1]
    cosine = 1 / np.linalg.norm(slopes(), axis=-1)
    ramp = np.clip((cosine - outer) / (inner - outer), 0, 1)
    np.testing.assert_allclose(share, STRAY + (1 - STRAY) * ramp**2 * (3 - 2 * ramp), rtol=1e-3)
    assert share.max() == pytest.approx(1.0)
    assert share.min() == pytest.approx(STRAY, rel=1e-3)


def test_a_wet_film_mirrors_the_lamp_with_its_own_lobe(matt: Tissue) -> None:
    wet = matt._replace(coat=2.0, coat_shininess=20.0, coat_bump=0.0, dry=-20.0)
    cosine = 1 / np.linalg.norm(slopes(), axis=-1)
    reach = 30.0 / cosine
    expected = 7.0 * 2.0 * (20.0 / reach) ** 2 * np.where(cosine > 0.9, cosine**200, 0.0)
    flat = expected < 0.15  # elsewhere a pixel is the mean of four rays
    np.testing.assert_allclose((seen(wet) - seen(matt))[flat], np.repeat(expected[flat][:, None], 3, 1), atol=1e-3)
    assert (seen(matt._replace(coat=2.0, dry=20.0)) == seen(matt)).all()  # dry everywhere


def test_gloss_multiplies_highlights_and_nothing_else(matt: Tissue) -> None:
    shiny = matt._replace(specular=0.005, shininess=30.0)  # too weak to be supersampled
    glossy = shiny._replace(gloss=np.full((200, 200), 3.0, np.float32))
    even = shiny._replace(gloss=np.ones((200, 200), np.float32))
    np.testing.assert_array_equal(seen(even), seen(shiny))
    np.testing.assert_allclose(seen(glossy) - seen(matt), 3 * (seen(shiny) - seen(matt)), atol=1e-5)


def test_regions_darken_by_their_contrast_at_any_depth(matt: Tissue) -> None:
    for distance in (20.0, 60.0):
        dark = matt._replace(regions=log(4.0), region_edge=20.0, solid_step_mm=0.05 * distance / 20)
        share = seen(dark, distance=distance)[..., 0] / seen(matt, distance=distance)[..., 0]
        assert share.min() == pytest.approx(0.25, rel=1e-3)
        assert share.max() == pytest.approx(1.0, rel=1e-3)
        assert np.mean((share < 0.26) | (share > 0.99)) > 0.7


def test_the_finest_octave_and_capillaries_show_near_and_vanish_far(matt: Tissue) -> None:
    plain = matt._replace(
        mottle=0.2, bump=0.05, vessel_tint=(0.7, 0.4, 0.4), vessels=tuple(0 * v for v in matt.vessels)
    )
    for change in ({"fine": 1.0}, {"capillaries": 0.8}):
        near, far = (
            np.abs(seen(plain._replace(**change), distance=d) / seen(plain, distance=d) - 1).max() for d in (6.0, 100.0)
        )
        assert near > 0.05
        assert far == 0.0


def grey(value: float = 0.4) -> npt.NDArray[np.float32]:
    return np.broadcast_to(np.array([value, 0.5 * value, 0.4 * value], np.float32), (100, 150, 3)).copy()


def coated(**changes: object) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    ranges = OFF.model_copy(update=changes)
    coating = coat_surface(np.random.default_rng(5), ranges, grey(), PATCH)
    again = coat_surface(np.random.default_rng(5), ranges, grey(), PATCH)
    np.testing.assert_array_equal(coating.albedo, again.albedo)
    return coating.albedo, coating.gloss


def test_bare_tissue_keeps_its_colour_and_gloss() -> None:
    albedo, gloss = coated()
    np.testing.assert_array_equal(albedo, grey())
    assert (gloss == 1.0).all()


def test_bands_change_brightness_alone_and_cover_a_part() -> None:
    albedo, gloss = coated(banded=1.0)
    factor = albedo / grey()
    np.testing.assert_allclose(factor[..., 0], factor[..., 2], rtol=1e-5)
    assert (gloss == 1.0).all()
    assert np.abs(np.log(factor)).max() > log(1.4)
    assert 0.05 < np.mean(np.abs(np.log(factor[..., 0])) < 0.01) < 0.99


def test_blood_is_dark_red_and_glossy_where_it_lies() -> None:
    albedo, gloss = coated(bloody=1.0)
    wet = gloss > 1.2
    assert 0.005 < wet.mean() < 0.3
    assert (albedo[wet][:, 1] / albedo[wet][:, 0]).mean() < 0.35  # 0.5 without
    np.testing.assert_array_equal(albedo[gloss == 1.0], grey()[gloss == 1.0])


def test_bubbles_are_bright_and_glossy_and_small() -> None:
    albedo, gloss = coated(foamy=1.0)
    assert 0.0 < np.mean(gloss > 1.0) < 0.6
    assert (albedo >= grey() - 1e-6).all()
    assert albedo.max() > 0.8


def test_a_scene_keeps_to_one_of_its_palettes() -> None:
    other = Palette(red=(0.1, 0.2), green_over_red=(0.9, 0.95), blue_over_green=(0.9, 1.0))
    random = np.random.default_rng(0)
    assert settle_palette(random, OFF) is OFF
    chosen = [settle_palette(random, OFF.model_copy(update={"palettes": (other,)})).red for _ in range(40)]
    assert set(chosen) == {OFF.red, other.red}


def test_without_tilt_and_edge_the_beam_is_the_old_one() -> None:
    lamp = draw_lamp(np.random.default_rng(0), LightRanges(), soft_mm=4.0)
    assert lamp.axis == (0.0, 0.0, 1.0)
    assert lamp.cone[1] < -1
    tilted = draw_lamp(np.random.default_rng(0), LightRanges(tilt_deg=(10.0, 10.0), coned=1.0), soft_mm=4.0)
    assert tilted.axis[2] == pytest.approx(np.cos(np.radians(10.0)))
    assert tilted.cone[0] > tilted.cone[1] > 0
    assert tilted._replace(axis=lamp.axis, cone=lamp.cone, offsets=lamp.offsets) == lamp._replace(offsets=lamp.offsets)


def test_the_held_out_domain_lies_outside_what_training_sees() -> None:
    broad, shifted = DOMAINS["broad"].material, DOMAINS["shifted"].material
    for palette in (broad, *broad.palettes):
        apart = [
            mine[1] < theirs[0] or theirs[1] < mine[0]
            for mine, theirs in (
                (palette.green_over_red, shifted.green_over_red),
                (palette.blue_over_green, shifted.blue_over_green),
            )
        ]
        assert any(apart)
    assert broad.spots[1] <= shifted.spots[0]


def test_light_without_red_is_what_the_narrowband_domain_adds() -> None:
    narrow, shifted, broad = (DOMAINS[name] for name in ("narrowband", "shifted", "broad"))
    assert (narrow.material, narrow.light, narrow.camera) == (shifted.material, shifted.light, shifted.camera)
    assert narrow.sensor.tinted == 1
    assert narrow.sensor.warmth[1] < broad.sensor.warmth[0]
    clip = render_clip(0, narrow, frames=1, size=(28, 36))
    red, green, blue = clip.frames[0][clip.valid[0]].mean(0)
    assert red < 0.8 * green
    assert red < 0.8 * blue


def test_the_typical_domain_lies_within_the_broad_one() -> None:
    def ranges(values: dict[str, Any], prefix: str = "") -> dict[str, tuple[float, float]]:
        found: dict[str, tuple[float, float]] = {}
        for name, value in values.items():
            if isinstance(value, dict):
                found |= ranges(value, f"{prefix}{name}.")
            elif isinstance(value, tuple) and len(value) == 2 and isinstance(value[0], float):
                found[prefix + name] = value
        return found

    typical, broad = ranges(DOMAINS["typical"].model_dump()), ranges(DOMAINS["broad"].model_dump())
    assert len(typical) > 50
    outside = [name for name, (low, high) in typical.items() if low < broad[name][0] or high > broad[name][1]]
    assert outside == ["camera.slow_speed"]  # that of the broad domain is slower as a whole
    assert set(DOMAINS["typical"].material.palettes) <= set(DOMAINS["broad"].material.palettes)
    assert set(DOMAINS["typical"].families) == set(DOMAINS["broad"].families)
