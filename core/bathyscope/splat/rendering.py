"""What the splatter hands back: images of a view, and the projected Gaussians behind them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True, slots=True)
class Rendering:
    """One view of a scene, (h, w)."""

    image: Floats | None
    """(h, w, 3) RGB over the background, black without one; not clamped above. ``None`` if rendered without colour."""
    depth: Floats
    """(h, w) expected z-depth: blended depth over blended opacity; 0 where opacity is 0."""
    accumulated: Floats
    """(h, w) blended z-depth, not divided: pulled towards 0 where opacity is below 1."""
    opacity: Floats
    """(h, w) blended opacity in [0, 1]."""


@dataclass(frozen=True, slots=True)
class Projection:
    """The n Gaussians of a scene as one camera sees them; NaN (radii: 0) where not visible."""

    means: Floats
    """(n, 2) centres in pixels (u, v)."""
    conics: Floats
    """(n, 3) inverse covariances (a, b, c) of [[a, b], [b, c]], 1 / px^2."""
    depths: Floats
    """(n,) camera z of the centres."""
    compensations: Floats
    """(n,) factor on the opacity; 1 unless antialiased."""
    radii: NDArray[np.int32]
    """(n, 2) half sizes of the box that holds every pixel with alpha at the threshold or above."""
    visible: NDArray[np.bool_]
    """(n,) what is between the planes, opaque enough, large enough and reaches into the image."""
    colours: Floats | None
    """(n, 3) RGB towards the camera, not below 0; ``None`` if projected without colour."""
