"""Years of publication, for the column that the paper's first table has."""

from __future__ import annotations

import re

YEARS = {"endodac": 2024, "vda": 2025, "endodav": 2025, "anysplat": 2025, "vggt": 2025, "endomust": 2025}
"""By the first word of a system's name."""


def year_of(system: str) -> str:
    """The year, or two dashes for what is not published."""
    word = re.match(r"[a-z]*", system.lower())
    return str(YEARS.get(word.group() if word else "", "--"))
