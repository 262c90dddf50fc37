"""Pictures of a training run: every logged number against the step."""

import json
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_CONTEXT = ("step", "elapsed_s", "progress", "validation")
_COLUMNS = 4


def read_curves(metrics: Path) -> dict[str, dict[str, list[tuple[int, float]]]]:
    """Curves of ``metrics.jsonl``: name of the number, then where it was measured ("training" or the folder)."""
    curves: dict[str, dict[str, list[tuple[int, float]]]] = defaultdict(lambda: defaultdict(list))
    for line in metrics.read_text(encoding="utf-8").splitlines():
        values: Mapping[str, Any] = json.loads(line)
        where = str(values.get("validation", "training"))
        for name, value in values.items():
            if name not in _CONTEXT and isinstance(value, int | float):
                curves[name][where].append((int(values["step"]), float(value)))
    return {name: dict(lines) for name, lines in curves.items()}


def draw_curves(metrics: Path, picture: Path) -> None:
    """Draw the curves of ``metrics.jsonl``, validation first, as a PNG."""
    import matplotlib.figure

    curves = read_curves(metrics)
    names = sorted(curves, key=lambda name: ("training" in curves[name], name))
    rows = -(-len(names) // _COLUMNS)
    figure = matplotlib.figure.Figure(figsize=(4 * _COLUMNS, 2.6 * rows), layout="constrained")
    for place, name in enumerate(names, 1):
        axes = figure.add_subplot(rows, _COLUMNS, place)
        for where, points in curves[name].items():
            steps, values = zip(*points, strict=True)
            axes.plot(steps, values, marker="." if len(points) < 30 else "", label=where, linewidth=1)
        axes.set_title(name, fontsize=9)
        if "training" not in curves[name]:
            axes.legend(fontsize=6)
    figure.savefig(picture, dpi=90)
