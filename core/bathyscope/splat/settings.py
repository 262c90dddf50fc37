"""The constants of the splatting formulas, and how to compute with them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from bathyscope.errors import SettingsError

Backend = Literal["numba", "numpy"]
Precision = Literal["float32", "float64"]


@dataclass(frozen=True, slots=True)
class SplatSettings:
    """Constants of EWA splatting; the defaults are those of gsplat 1.4 and 1.5.

    Raises:
        SettingsError: If a value is out of range.
    """

    near_plane: float = 0.01
    """Gaussians whose centre is nearer (camera z) are left out, world units."""
    far_plane: float = 1e10
    """Gaussians whose centre is farther are left out, world units."""
    eps2d: float = 0.3
    """Added to both variances of the projected Gaussian, px^2: nothing is thinner than about a pixel."""
    alpha_threshold: float = 1 / 255
    """A Gaussian adds nothing to a pixel where its alpha is below this."""
    transmittance_cutoff: float = 1e-4
    """A pixel is finished when the light that would be left is at or below this; that Gaussian is not added."""
    max_alpha: float = 0.999
    """Upper bound of alpha. gsplat up to 1.5 has 0.999, INRIA's renderer and gsplat 1.6 have 0.99."""
    radius_clip: float = 0.0
    """Gaussians with both radii at or below this are left out, px."""
    antialiased: bool = False
    """Whether the opacity is lowered by as much as ``eps2d`` enlarges the footprint."""
    degree: int | None = None
    """Highest degree of the harmonics that is evaluated; ``None`` is the scene's."""
    precision: Precision = "float32"
    """What the numpy backend computes in; the numba backend has float32 only."""

    def __post_init__(self) -> None:
        checks = {
            "near_plane": 0 < self.near_plane < self.far_plane,
            "far_plane": self.far_plane < 1e30,
            "eps2d": 0 <= self.eps2d < 1e6,
            "alpha_threshold": 0 < self.alpha_threshold < 1,
            "transmittance_cutoff": 0 <= self.transmittance_cutoff < 1,
            "max_alpha": self.alpha_threshold <= self.max_alpha < 1,
            "radius_clip": self.radius_clip >= 0,
            "degree": self.degree is None or self.degree >= 0,
            "precision": self.precision in ("float32", "float64"),
        }
        wrong = [f"{name}={getattr(self, name)!r}" for name, fits in checks.items() if not fits]
        if wrong:
            raise SettingsError(f"splat settings out of range: {', '.join(wrong)}; see the fields of SplatSettings")
