"""Gradients of the numba splatter against finite differences of the numpy one in double precision."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bathyscope.errors import GeometryError
from bathyscope.gaussians import Gaussians
from bathyscope.splat import SplatSettings, render
from bathyscope.splat.backward import CameraGradient, SceneGradient
from bathyscope.splat.compiled import CompiledScene
from bathyscope.splat.view import make_view

SIZE = (9, 11)
FIELDS = ("means", "rotations", "scales", "opacities", "harmonics")
# No pixel comes near a threshold, so that the image is smooth.
SMOOTH = {"alpha_threshold": 1e-7, "transmittance_cutoff": 0.0}
Array = NDArray[np.floating[Any]]


def scene(count: int = 7, degree: int = 2) -> Gaussians:
    random = np.random.default_rng(1)
    means = random.uniform((-0.5, -0.5, 1.5), (0.5, 0.5, 2.5), (count, 3))
    arrays = (
        means,
        random.normal(size=(count, 4)),
        random.uniform(0.1, 0.3, (count, 3)),
        random.uniform(0.2, 0.8, count),
        0.2 * random.normal(size=(count, (degree + 1) ** 2, 3)),
    )
    return Gaussians(*(array.astype(np.float32) for array in arrays))


def camera() -> tuple[Array, Array]:
    pose = np.eye(4)
    angle = 0.2
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = 0.1, -0.05, 0.2
    return pose, np.array([[9.0, 0, 5.2], [0, 8, 4.6], [0, 0, 1]])


def weights() -> Array:
    return np.random.default_rng(2).normal(size=(5, *SIZE))


def loss(gaussians: Gaussians, pose: Array, intrinsics: Array, settings: SplatSettings) -> float:
    found = render(gaussians, pose, intrinsics, SIZE, settings=settings, backend="numpy")
    assert found.image is not None
    planes = np.concatenate([found.opacity[None], found.accumulated[None], found.image.transpose(2, 0, 1)])
    return float((weights() * planes).sum())


def gradients(settings: SplatSettings) -> tuple[Gaussians, CameraGradient]:
    gaussians, (pose, intrinsics) = scene(), camera()
    packed = CompiledScene.of(gaussians)
    view = make_view(pose, intrinsics, SIZE)
    shown = packed.render(view, settings, gaussians.degree, None)
    assert shown.image is not None
    planes = np.concatenate([shown.opacity[None], shown.accumulated[None], shown.image.transpose(2, 0, 1)])
    total = SceneGradient(packed, gaussians.degree)
    found = total.add_view(view, settings, np.ascontiguousarray(planes, np.float32), weights().astype(np.float32))
    return total.of(gaussians), found


def differences(value: Array, scored: Any) -> Array:
    """Central differences of ``scored`` by every number of ``value``."""
    out = np.zeros(value.shape)
    for place in np.ndindex(value.shape):
        ends = []
        for step in (1e-5, -1e-5):
            moved = value.astype(np.float64)
            moved[place] += step
            ends.append(scored(moved))
        out[place] = (ends[0] - ends[1]) / 2e-5
    return out


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", FIELDS)
def test_gradients_of_gaussians_are_finite_differences(name: str, antialiased: bool) -> None:
    settings = SplatSettings(antialiased=antialiased, **SMOOTH)
    exact = replace(settings, precision="float64")
    gaussians, (pose, intrinsics) = scene(), camera()
    expected = differences(
        getattr(gaussians, name), lambda moved: loss(replace(gaussians, **{name: moved}), pose, intrinsics, exact)
    )
    found = getattr(gradients(settings)[0], name)
    assert np.linalg.norm(found - expected) <= 2e-4 * np.linalg.norm(expected)


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_of_the_camera_are_finite_differences(antialiased: bool) -> None:
    settings = SplatSettings(antialiased=antialiased, **SMOOTH)
    exact = replace(settings, precision="float64")
    gaussians, (pose, intrinsics) = scene(), camera()
    found = gradients(settings)[1]
    expected = differences(pose, lambda moved: loss(gaussians, moved, intrinsics, exact))
    expected[3] = 0
    assert np.linalg.norm(found.camera_from_world - expected) <= 2e-4 * np.linalg.norm(expected)
    used = [0, 1, 0, 1], [0, 1, 2, 2]

    def with_numbers(numbers: Array) -> Array:
        made = intrinsics.copy()
        made[used] = numbers
        return made

    expected = differences(intrinsics[used], lambda moved: loss(gaussians, pose, with_numbers(moved), exact))
    assert np.linalg.norm(found.intrinsics[used] - expected) <= 2e-4 * np.linalg.norm(expected)


def test_views_add_up() -> None:
    gaussians, (pose, intrinsics) = scene(), camera()
    packed, view = CompiledScene.of(gaussians), make_view(pose, intrinsics, SIZE)
    planes, asked = np.zeros((5, *SIZE), np.float32), weights().astype(np.float32)
    twice, one, other = (SceneGradient(packed, 2) for _ in range(3))
    for gradient in (twice, twice, one, other):
        gradient.add_view(view, SplatSettings(), planes, asked)
    one.add(other)
    for name in FIELDS:
        np.testing.assert_allclose(getattr(one.of(gaussians), name), getattr(twice.of(gaussians), name), rtol=1e-5)


def test_gradients_that_are_not_finite_are_refused() -> None:
    gaussians, (pose, intrinsics) = scene(), camera()
    asked = np.full((5, *SIZE), np.inf, np.float32)
    with pytest.raises(GeometryError, match="not finite"):
        SceneGradient(CompiledScene.of(gaussians), 2).add_view(
            make_view(pose, intrinsics, SIZE), SplatSettings(), np.zeros_like(asked), asked
        )
