"""Both splatting backends against the brute-force float64 reference data (``splatting/case_*.npz``)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bathyscope.gaussians import Gaussians
from bathyscope.splat import PreparedScene, Projection, Rendering, SplatSettings, prepare, project, render

REFERENCE = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference"))
CASES = sorted((REFERENCE / "splatting").glob("case_*.npz"))
BACKENDS = [("numba", "float32"), ("numpy", "float32"), ("numpy", "float64")]

pytestmark = pytest.mark.skipif(not CASES, reason=f"no splatting/case_*.npz under {REFERENCE}")


@dataclass(frozen=True)
class Views:
    """All views of one case by one backend, beside what was expected."""

    expected: dict[str, Any]
    precision: str
    renderings: list[Rendering]
    projections: list[Projection]

    @property
    def exact(self) -> bool:
        return self.precision == "float64"


def case_settings(data: dict[str, Any], precision: str) -> SplatSettings:
    names = ("near_plane", "far_plane", "eps2d", "alpha_threshold", "transmittance_cutoff", "max_alpha", "radius_clip")
    numbers = {name: float(data[name]) for name in names}
    return SplatSettings(
        **numbers, antialiased=bool(data["antialiased"]), degree=int(data["sh_degree"]), precision=precision
    )


def case_scene(data: dict[str, Any]) -> Gaussians:
    return Gaussians(*(data[name] for name in ("means", "quats", "scales", "opacities", "sh")))


@cache
def views(path: Path, backend: str, precision: str) -> Views:
    data = dict(np.load(path))
    settings = case_settings(data, precision)
    scene: PreparedScene = prepare(case_scene(data), settings=settings, backend=backend)
    size = int(data["height"]), int(data["width"])
    renderings, projections = [], []
    for pose, k in zip(data["viewmats"], data["Ks"], strict=True):
        renderings.append(render(scene, pose, k, size, settings=settings, background=data.get("background")))
        projections.append(project(scene, pose, k, size, settings=settings))
    return Views(data, precision, renderings, projections)


@pytest.fixture(params=CASES, ids=lambda path: path.stem)
def path(request: pytest.FixtureRequest) -> Path:
    return request.param


@pytest.fixture(params=BACKENDS, ids="-".join)
def found(path: Path, request: pytest.FixtureRequest) -> Views:
    return views(path, *request.param)


IMAGES = {
    "out_rgb": "image",
    "out_alpha": "opacity",
    "out_depth_accum": "accumulated",
    "out_depth_expected": "depth",
}


@pytest.mark.parametrize("name", IMAGES)
def test_pixels_that_rounding_cannot_turn_agree(found: Views, name: str) -> None:
    tolerance = 1e-9 if found.exact else 1e-5
    solid = ~found.expected["out_fragile"]
    assert solid.any()
    for camera, rendering in enumerate(found.renderings):
        difference = np.abs(getattr(rendering, IMAGES[name]) - found.expected[name][camera])[solid[camera]]
        assert difference.max() <= tolerance


@pytest.mark.parametrize("name", IMAGES)
def test_pixels_at_a_threshold_stay_close(found: Views, name: str) -> None:
    difference = np.stack(
        [np.abs(getattr(r, IMAGES[name]) - found.expected[name][i]) for i, r in enumerate(found.renderings)]
    )
    assert (difference <= 2e-3).mean() >= 0.999
    assert difference.max() <= 2e-2


def test_the_same_gaussians_are_visible(found: Views) -> None:
    for camera, projection in enumerate(found.projections):
        np.testing.assert_array_equal(projection.visible, found.expected["out_visible"][camera])


def test_radii_agree(found: Views) -> None:
    for camera, projection in enumerate(found.projections):
        difference = np.abs(projection.radii - found.expected["out_radii"][camera])
        # A radius is a ceiling: single precision may fall on the other side of a whole number.
        assert difference.max() <= (0 if found.exact else 1)
        assert (difference == 0).mean() >= 0.999


@pytest.mark.parametrize(
    ("name", "field", "tolerance"),
    [
        ("out_means2d", "means", 1e-5),
        ("out_conics", "conics", 1e-4),
        ("out_depths", "depths", 1e-5),
        ("out_compensations", "compensations", 1e-4),
        ("out_colors", "colours", 1e-5),
    ],
)
def test_projected_gaussians_agree(found: Views, name: str, field: str, tolerance: float) -> None:
    exact_tolerance = 1e-6 if name == "out_colors" else 1e-9
    for camera, projection in enumerate(found.projections):
        seen = found.expected["out_visible"][camera]
        expected = found.expected[name][camera][seen].astype(np.float64)
        observed = getattr(projection, field)[seen].astype(np.float64)
        # Relative to the largest of a Gaussian's numbers: one of them may pass through zero.
        scale = np.abs(expected).reshape(len(expected), -1).max(1).reshape(-1, *[1] * (expected.ndim - 1))
        error = np.abs(observed - expected) / np.maximum(scale, 1e-3)
        assert error.max() <= (exact_tolerance if found.exact else tolerance)


def test_gaussians_that_are_not_visible_have_no_numbers(found: Views) -> None:
    for camera, projection in enumerate(found.projections):
        hidden = ~found.expected["out_visible"][camera]
        for field in ("means", "conics", "depths", "compensations", "colours"):
            assert np.isnan(getattr(projection, field)[hidden]).all()
        assert (projection.radii[hidden] == 0).all()
