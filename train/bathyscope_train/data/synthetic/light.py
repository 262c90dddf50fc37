"""Draw the light at the tip of the endoscope."""

import numpy as np

from bathyscope_train.data.synthetic.domain import LightRanges, draw
from bathyscope_train.data.synthetic.shading import Lamp


def draw_lamp(random: np.random.Generator, ranges: LightRanges, soft_mm: float) -> Lamp:
    """One or two light guides beside the lens.

    Args:
        random: Source of every choice.
        ranges: Of the domain.
        soft_mm: Size of a light guide, which keeps near walls from burning out.
    """
    more = random.spawn(1)[0]
    angle, offset = random.uniform(0, 2 * np.pi), draw(random, ranges.offset_mm)
    arm = offset * np.array([np.cos(angle), np.sin(angle), 0.0])
    pair = random.uniform() < ranges.second_light
    return Lamp(
        offsets=np.stack([arm, -arm] if pair else [arm]),
        falloff=draw(random, ranges.falloff),
        spot=draw(random, ranges.spot),
        ambient=draw(random, ranges.ambient),
        soft_mm=soft_mm,
        axis=_beam(more, ranges),
        cone=_edge(more, ranges),
    )


def _beam(random: np.random.Generator, ranges: LightRanges) -> tuple[float, float, float]:
    tilt, side = np.radians(draw(random, ranges.tilt_deg)), random.uniform(0, 2 * np.pi)
    return float(np.sin(tilt) * np.cos(side)), float(np.sin(tilt) * np.sin(side)), float(np.cos(tilt))


def _edge(random: np.random.Generator, ranges: LightRanges) -> tuple[float, float]:
    edged, half, soft = random.uniform(), draw(random, ranges.cone_deg), draw(random, ranges.edge_deg)
    if edged >= ranges.coned:
        return -1.0, -2.0
    inner, outer = np.cos(np.radians([max(half - soft, 0.0), half + soft]))
    return float(inner), float(outer)
