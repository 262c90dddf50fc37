"""The model card of a bundle, for people."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bathyscope_train.model.presets import NetworkPreset

if TYPE_CHECKING:
    from bathyscope_export.writer import BundleSettings

USE = [
    "* Made for: relative depth and camera motion in video of rigid or slowly moving scenes, in research and as a part",
    "  of software; to begin training on other videos.",
    "* Not made for: measuring lengths (one factor a clip is unknown), diagnosis, navigation, or any decision about a",
    "  patient. It is not a medical device and was not validated as one.",
]


def write_card(
    path: Path,
    preset: NetworkPreset,
    settings: "BundleSettings",
    *,
    training: Mapping[str, Any],
    parity: Sequence[Mapping[str, Any]],
) -> None:
    """Write ``card.md``: what the model is and is not for, what it was trained on, how good and how exact it is."""
    lines = [
        f"# {settings.name} {settings.version}",
        "",
        f"Depth, confidence, camera poses and 3-D Gaussians from a clip of endoscopic video; network `{preset.name}`.",
        f"It works best at {settings.input.pixels} pixels a frame, in windows of {settings.input.window} frames.",
        "",
        "## Use",
        "",
        *USE,
        "",
        "## Licence",
        "",
        f"{settings.licence}" + ("; **for research only**" if settings.research_only else ""),
        "",
        "## Training",
        "",
        *items(training),
        "",
        "## Accuracy",
        "",
        *items(settings.accuracy),
        "",
        "## Export",
        "",
        f"Largest difference from PyTorch: depth {_worst(parity, 'depth'):.1e} of its standard deviation, rotation "
        f"{_worst(parity, 'rotation'):.1e} rad, translation {_worst(parity, 'translation'):.1e}.",
        "",
    ]
    path.write_text("\n".join(lines), encoding="utf-8")


def items(record: Mapping[str, Any]) -> list[str]:
    """A record as nested lists; mappings of equal keys become tables."""
    return _outline(record, 0) or ["Nothing is recorded."]


def _outline(record: Mapping[str, Any], level: int) -> list[str]:
    lines = []
    for name, value in record.items():
        head = f"{'  ' * level}* {name.replace('_', ' ')}"
        if _is_table(value):
            lines += [f"{head}:", "", *_table(value), ""]
        elif isinstance(value, Mapping) and value:
            lines += [f"{head}:", *_outline(value, level + 1)]
        elif isinstance(value, list | tuple) and value and all(isinstance(each, str) for each in value):
            lines += [f"{head}:", *(f"{'  ' * (level + 1)}* {each}" for each in value)]
        elif isinstance(value, list | tuple) and value and all(isinstance(each, Mapping) for each in value):
            lines += [f"{head}:", *(f"{'  ' * (level + 1)}* {_one_line(each)}" for each in value)]
        else:
            lines.append(f"{head}: {value}")
    return lines


def _is_table(value: Any) -> bool:
    """Two rows or more with numbers in the same columns."""
    if not isinstance(value, Mapping) or len(value) < 2:
        return False
    rows = list(value.values())
    return all(isinstance(row, Mapping) and row and list(row) == list(rows[0]) for row in rows)


def _table(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    columns = list(next(iter(rows.values())))
    return [
        f"| | {' | '.join(column.replace('_', ' ') for column in columns)} |",
        f"| --- |{' --- |' * len(columns)}",
        *(f"| {name} | {' | '.join(str(row[column]) for column in columns)} |" for name, row in rows.items()),
    ]


def _one_line(record: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in record.items() if value is not None)


def _worst(parity: Sequence[Mapping[str, Any]], name: str) -> float:
    return max((float(record[name]) for record in parity), default=0.0)
