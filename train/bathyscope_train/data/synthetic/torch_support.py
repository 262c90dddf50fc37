"""What the renderer in torch knows of a clip's description: anything else is refused, not left out in silence."""

from collections.abc import Sequence
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

import numpy as np

from bathyscope.errors import SettingsError
from bathyscope_train.data.synthetic.clip import ClipPlan

_KNOWN = {
    "ClipPlan": "scene lamp sensor scene_from_camera intrinsics size name distortion instruments swell",
    "Scene": "family surface tissue solids stage",
    "Surface": "kind heights centre first step density stride_mm core leap_mm feature_mm waves",
    "Tissue": "albedo vessels vessel_step_mm vessel_tint solid solid_step_mm mottle spots bump specular shininess "
    "gloss coat coat_shininess coat_bump dry fine capillaries regions region_level region_edge",
    "Solids": "kind local_from_scene size bound look mover lights reach_mm sky lamp_share",
    "Lamp": "offsets falloff spot ambient soft_mm axis cone",
    "Sensor": "gamma exposure metering lag vignette clipping shoulder noise blur_px quality view haze aperture_mm "
    "focus shutter interlaced glare fringe_px balance drift shot read grain_px chroma sharpen sharpen_px hold overlay",
    "Haze": "opacity veil wisps waves",
    "Distortion": "k1 k2",
    "Instruments": "solids scene_from_mover",
    "Swell": "kind waves centre first step scene_from_world",
}
_PARTS = {name: frozenset(known.split()) for name, known in _KNOWN.items()}


def check_plans(plans: Sequence[ClipPlan]) -> None:
    """Make sure that nothing of these plans is unknown here.

    Raises:
        SettingsError: If a plan has a feature that this renderer does not render.
    """
    for plan in plans:
        for feature in unknown_features(plan):
            raise SettingsError(
                f"clip {plan.name}: the torch renderer does not render {feature}; switch it off in the domain, or "
                "render with numba"
            )


def unknown_features(part: Any) -> list[str]:
    """Names of the fields, here and in all parts, that this renderer does not know and that are not at their default.

    A field without a default counts whatever it holds.
    """
    kind = type(part).__name__
    if kind not in _PARTS:
        return []
    found = []
    for name, default in _defaults(part).items():
        value = getattr(part, name)
        if name not in _PARTS[kind]:
            found += [f"{kind}.{name}"] if default is MISSING or not _same(value, default) else []
        else:
            found += unknown_features(value)
    return found


def _defaults(part: Any) -> dict[str, Any]:
    """The fields of a dataclass or named tuple, with their defaults."""
    if is_dataclass(part):
        return {field.name: field.default for field in fields(part)}
    return {name: part._field_defaults.get(name, MISSING) for name in part._fields}


def _same(value: Any, default: Any) -> bool:
    if value is default:
        return True
    if isinstance(value, np.ndarray) or isinstance(default, np.ndarray):
        return np.array_equal(value, default)
    return bool(value == default)
