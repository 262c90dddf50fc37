"""The model card of a bundle, for people."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bathyscope_train.model.presets import NetworkPreset

if TYPE_CHECKING:
    from bathyscope_export.writer import BundleSettings


def write_card(
    path: Path,
    preset: NetworkPreset,
    settings: "BundleSettings",
    *,
    training: Mapping[str, Any],
    parity: Sequence[Mapping[str, Any]],
) -> None:
    """Write ``card.md``: what the model is, what it was trained on, how exact the export is, what it is not for."""
    lines = [
        f"# {settings.name} {settings.version}",
        "",
        f"Depth, confidence, camera poses and 3-D Gaussians from a clip of endoscopic video; network {preset.name!r}.",
        "Depth and translation are right up to one factor a clip. Not a medical device.",
        "",
        f"* Licence: {settings.licence}" + ("; for research only" if settings.research_only else ""),
        f"* Works best at {settings.input.pixels} pixels a frame, windows of {settings.input.window} frames",
        f"* Largest difference from PyTorch: depth {_worst(parity, 'depth'):.1e} of its standard deviation, "
        f"rotation {_worst(parity, 'rotation'):.1e} rad, translation {_worst(parity, 'translation'):.1e}",
        "",
        "## Training",
        "",
        *items(training),
        "",
        "## Accuracy",
        "",
        *items(settings.accuracy),
        "",
    ]
    path.write_text("\n".join(lines), encoding="utf-8")


def items(record: Mapping[str, Any]) -> list[str]:
    """Lines of a list, for a card."""
    return [f"* {key}: {value}" for key, value in record.items()] or ["Nothing is recorded."]


def _worst(parity: Sequence[Mapping[str, Any]], name: str) -> float:
    return max((float(record[name]) for record in parity), default=0.0)
