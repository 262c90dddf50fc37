"""The named domains: where training starts, the wide one it goes on with, and one kept for tests."""

from types import MappingProxyType

from bathyscope_train.data.synthetic.domain import (
    AirRanges,
    CameraRanges,
    Domain,
    LifeRanges,
    LightRanges,
    MaterialRanges,
    Palette,
    SensorRanges,
)

SOURCE = Domain(name="source")
"""Narrow: pink mucosa, inverse-square light, little noise. A small model learns it within minutes."""

BROAD = Domain(
    name="broad",
    families={"lumen": 0.3, "cavity": 0.22, "sinus": 0.16, "larynx": 0.1, "closeup": 0.1, "indoor": 0.12},
    light=LightRanges(
        falloff=(0.8, 2.3),
        spot=(0.0, 3.0),
        offset_mm=(0.5, 6.0),
        second_light=0.4,
        ambient=(0.0, 0.05),
        tilt_deg=(0.0, 12.0),
        coned=0.2,
    ),
    material=MaterialRanges(
        red=(0.35, 0.95),
        green_over_red=(0.12, 0.62),
        blue_over_green=(0.4, 1.0),
        palettes=(
            Palette(red=(0.45, 0.85), green_over_red=(0.25, 0.5), blue_over_green=(0.75, 1.0)),
            Palette(red=(0.6, 0.95), green_over_red=(0.45, 0.62), blue_over_green=(0.55, 0.8)),
            Palette(red=(0.55, 0.95), green_over_red=(0.3, 0.45), blue_over_green=(0.8, 1.0)),
            Palette(red=(0.5, 0.9), green_over_red=(0.15, 0.4), blue_over_green=(0.6, 0.95)),
            Palette(red=(0.3, 0.8), green_over_red=(0.8, 0.98), blue_over_green=(0.85, 1.0)),
        ),
        variety=(0.0, 0.8),
        specular=(0.05, 1.2),
        shininess=(12.0, 90.0),
        bump=(0.0, 0.11),
        mottle=(0.0, 0.2),
        spots=(0.0, 0.25),
        vessels=(0.0, 70.0),
        vessel_contrast=(0.1, 0.75),
        fading=True,
        regions=(0.0, 1.8),
        banded=0.2,
        bloody=0.15,
        slimy=0.15,
        foamy=0.12,
        coated=0.55,
        fine=(0.0, 1.2),
        capillaries=(0.0, 0.7),
    ),
    air=AirRanges(smoky=0.12),
    camera=CameraRanges(
        fov_deg=(35.0, 120.0),
        distorted=0.35,
        speed=(0.3, 1.2),
        motions={"forward": 0.28, "sideways": 0.2, "turning": 0.2, "still": 0.04, "orbit": 0.16, "parallel": 0.12},
        slow=0.35,
        slow_speed=(0.04, 0.35),
        trembling=0.35,
        tremor_deg=(0.02, 0.3),
        pausing=0.12,
    ),
    life=LifeRanges(instruments=0.2, breathing=0.07, peristalsis=0.05, amplitude=(0.01, 0.06), period=(14.0, 60.0)),
    sensor=SensorRanges(
        gamma=(1.6, 2.5),
        exposure=(0.27, 0.62),
        metering=(40.0, 88.0),
        lag=(0.0, 0.7),
        vignette=(0.0, 0.9),
        clipping=(0.85, 1.4),
        shoulder=(0.0, 1.0),
        noise=(0.001, 0.02),
        blur_px=(0.0, 1.2),
        blurred=0.5,
        round_view=0.4,
        views={"round": 0.55, "corners": 0.25, "rectangle": 0.2},
        view_offset=(-0.08, 0.08),
        compressed=0.4,
        quality=(35.0, 95.0),
        held=0.3,
        unfocused=0.3,
        smeared=0.3,
        interlaced=0.05,
        glaring=0.4,
        fringed=0.15,
        tinted=0.5,
        grainy=0.35,
        shot=(0.005, 0.03),
        read=(0.0003, 0.003),
        sharpened=0.4,
        overlay=0.3,
    ),
)
"""Wide ranges of everything; what a model should have seen before it meets a real endoscope."""

SHIFTED = Domain(
    name="shifted",
    light=LightRanges(
        falloff=(1.0, 1.5), spot=(1.0, 3.0), offset_mm=(3.0, 5.0), second_light=0.0, ambient=(0.02, 0.06)
    ),
    material=MaterialRanges(
        red=(0.7, 0.95),
        green_over_red=(0.63, 0.8),
        blue_over_green=(0.5, 0.75),
        variety=(0.1, 0.5),
        specular=(0.6, 1.5),
        shininess=(20.0, 60.0),
        bump=(0.05, 0.1),
        mottle=(0.1, 0.2),
        spots=(0.25, 0.5),
        vessels=(0.0, 15.0),
    ),
    sensor=SensorRanges(
        gamma=(1.7, 1.7),
        exposure=(0.35, 0.5),
        noise=(0.006, 0.02),
        blurred=0.5,
        blur_px=(0.3, 0.9),
        vignette=(0.2, 0.7),
    ),
)
"""Never trained on: pale and yellowish, spotted, slow fall-off, narrow beam, strong highlights."""

DOMAINS = MappingProxyType({domain.name: domain for domain in (SOURCE, BROAD, SHIFTED)})
