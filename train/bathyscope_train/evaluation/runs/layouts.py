"""The three shapes of the paper's tables: which columns stand left of the errors, and what is in them.

The tables of ablations read a system's name: words after ``+`` say what it was trained with, as in
``ours+rgb+3d+temp=FILE`` or ``vda+consistency=FILE``.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum

from bathyscope_train.evaluation.runs.years import year_of

YES, NO = "✓", "×"


class Layout(StrEnum):
    """Which table of the paper a summary is shaped like."""

    COMPARISON = "comparison"
    """Table 1: method and year."""
    COMPONENTS = "components"
    """Table 2: method, and which of the three losses it was trained with."""
    BACKBONES = "backbones"
    """Table 3: backbone, and whether it was trained for consistency."""


def _comparison(system: str) -> tuple[str, ...]:
    return system, year_of(system)


def _components(system: str) -> tuple[str, ...]:
    name, *words = system.split("+")
    return name, *(YES if loss in words else NO for loss in ("rgb", "3d", "temp"))


def _backbones(system: str) -> tuple[str, ...]:
    name, *words = system.split("+")
    return name, YES if "consistency" in words else NO


HEADS: dict[Layout, tuple[str, ...]] = {
    Layout.COMPARISON: ("Method", "Year"),
    Layout.COMPONENTS: ("Method", "L_rgb", "L_3D", "L_temp"),
    Layout.BACKBONES: ("Backbone", "Consistency"),
}
CELLS: dict[Layout, Callable[[str], tuple[str, ...]]] = {
    Layout.COMPARISON: _comparison,
    Layout.COMPONENTS: _components,
    Layout.BACKBONES: _backbones,
}
"""From a system's name to the cells left of the errors."""
