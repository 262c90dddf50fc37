"""The named domains: where training starts, the wide one it goes on with, and one kept for tests."""

from types import MappingProxyType

from bathyscope_train.data.synthetic.domain import CameraRanges, Domain, LightRanges, MaterialRanges, SensorRanges

SOURCE = Domain(name="source")
"""Narrow: pink mucosa, inverse-square light, little noise. A small model learns it within minutes."""

BROAD = Domain(
    name="broad",
    families={"lumen": 0.4, "cavity": 0.4, "sinus": 0.2},
    light=LightRanges(falloff=(0.8, 2.2), spot=(0.0, 3.0), offset_mm=(0.5, 6.0), second_light=0.4, ambient=(0.0, 0.05)),
    material=MaterialRanges(
        red=(0.5, 0.95),
        green_over_red=(0.15, 0.62),
        blue_over_green=(0.4, 1.0),
        variety=(0.0, 0.7),
        specular=(0.1, 1.2),
        shininess=(12.0, 90.0),
        bump=(0.0, 0.11),
        mottle=(0.0, 0.2),
        spots=(0.0, 0.25),
        vessels=(0.0, 70.0),
        vessel_contrast=(0.1, 0.75),
    ),
    camera=CameraRanges(fov_deg=(40.0, 110.0), speed=(0.3, 1.2)),
    sensor=SensorRanges(
        gamma=(1.6, 2.5),
        exposure=(0.3, 0.6),
        metering=(35.0, 80.0),
        lag=(0.0, 0.7),
        vignette=(0.0, 0.9),
        clipping=(0.9, 1.25),
        shoulder=(0.0, 1.0),
        noise=(0.002, 0.025),
        blur_px=(0.0, 1.2),
        blurred=0.6,
        round_view=0.35,
        compressed=0.35,
        quality=(45.0, 95.0),
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
