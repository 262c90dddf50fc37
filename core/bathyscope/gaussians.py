"""A scene of 3-D Gaussian primitives: the P of the paper's section 2.1."""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import GeometryError

FloatArray = NDArray[np.floating]


@dataclass(frozen=True, slots=True)
class Gaussians:
    """Gaussian primitives in world coordinates; n primitives, k = (degree + 1)^2 harmonics.

    Raises:
        GeometryError: If the shapes do not belong together.
    """

    means: FloatArray
    """(n, 3) centres, world units."""
    rotations: FloatArray
    """(n, 4) quaternions (w, x, y, z), turning the primitive's axes into the world's; need not be unit length."""
    scales: FloatArray
    """(n, 3) standard deviations along the primitive's axes, world units."""
    opacities: FloatArray
    """(n,) in [0, 1]."""
    harmonics: FloatArray
    """(n, k, 3) spherical harmonics of the colour; ``[:, 0]`` is the constant term."""

    def __post_init__(self) -> None:
        n = len(self.means)
        wanted = {"means": (n, 3), "rotations": (n, 4), "scales": (n, 3), "opacities": (n,)}
        for name, shape in wanted.items():
            found = getattr(self, name).shape
            if found != shape:
                raise GeometryError(f"{name} of {n} Gaussians must have shape {shape}, got {found}")
        shape = self.harmonics.shape
        if len(shape) != 3 or shape[0] != n or shape[2] != 3 or isqrt(shape[1]) ** 2 != shape[1] or shape[1] == 0:
            raise GeometryError(f"harmonics must have shape ({n}, (degree+1)^2, 3), got {shape}")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return isqrt(self.harmonics.shape[1]) - 1

    def select(self, index: NDArray[np.bool_] | NDArray[np.integer] | slice) -> Gaussians:
        """The primitives that ``index`` picks, in its order."""
        return Gaussians(
            self.means[index],
            self.rotations[index],
            self.scales[index],
            self.opacities[index],
            self.harmonics[index],
        )


def concatenate(scenes: list[Gaussians]) -> Gaussians:
    """One scene of all primitives of several scenes of the same degree, in order.

    Raises:
        GeometryError: If there is no scene, or the degrees differ.
    """
    degrees = {scene.degree for scene in scenes}
    if len(degrees) != 1:
        raise GeometryError(f"scenes of one harmonics degree are needed to concatenate, got degrees {sorted(degrees)}")
    names = ("means", "rotations", "scales", "opacities", "harmonics")
    return Gaussians(*(np.concatenate([getattr(scene, name) for scene in scenes]) for name in names))
