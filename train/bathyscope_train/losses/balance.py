"""Weights of loss terms from how large the terms were measured to be."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite

from bathyscope.errors import SettingsError


def measured_weights(sizes: Mapping[str, float], shares: Mapping[str, float]) -> dict[str, float]:
    """Factors under which each term, at its measured size, adds as much as its share says.

    The paper weighs its three terms 1 : 1 : 1, but they are different things in different units: as measured on
    rendered clips, one is forty times another. Shares of 1 : 1 : 1 are then a statement about the sum. The first term
    with a share keeps it as its factor, so learning rates mean the same.

    Args:
        sizes: Values of the terms, say their means over the first steps of a run; keep them for the whole run.
        shares: Wanted contributions relative to each other; a term with share 0 gets the factor 0.

    Raises:
        SettingsError: If a term with a share has no positive, finite size.
    """
    wanted = {name: share for name, share in shares.items() if share > 0}
    bad = {name: sizes.get(name) for name in wanted if not isfinite(sizes.get(name, 0)) or sizes.get(name, 0) <= 0}
    if bad:
        raise SettingsError(f"terms need positive sizes to be balanced, measured {bad}; give them a share of 0")
    anchor = sizes[next(iter(wanted))] if wanted else 1.0
    return {name: share * anchor / sizes[name] if share > 0 else 0.0 for name, share in shares.items()}
