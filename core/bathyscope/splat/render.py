"""One view of a scene of Gaussians, by either backend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import Size
from bathyscope.errors import GeometryError, SettingsError
from bathyscope.gaussians import Gaussians
from bathyscope.splat.harmonics import MAX_DEGREE
from bathyscope.splat.plain import PlainScene
from bathyscope.splat.rendering import Floats, Projection, Rendering
from bathyscope.splat.settings import Backend, SplatSettings
from bathyscope.splat.view import make_view

if TYPE_CHECKING:
    from bathyscope.splat.compiled import CompiledScene

Matrix = NDArray[np.floating[Any]]
DEFAULTS = SplatSettings()


@dataclass(frozen=True, slots=True)
class PreparedScene:
    """A checked scene with all worked out that does not depend on the camera; read-only, safe to share by threads."""

    gaussians: Gaussians
    backend: Backend
    engine: PlainScene | CompiledScene

    def __len__(self) -> int:
        return len(self.gaussians)


def prepare(scene: Gaussians, *, settings: SplatSettings = DEFAULTS, backend: Backend = "numba") -> PreparedScene:
    """Check a scene and get it ready to be rendered from many cameras.

    Args:
        scene: The Gaussians. The harmonics are not looked at.
        settings: Only the precision is used.
        backend: ``numba`` (fast, float32) or ``numpy`` (the readable reference, float32 or float64).

    Raises:
        GeometryError: If values are not finite, a scale is negative, an opacity is outside [0, 1], or a
            quaternion has no direction.
        SettingsError: If the backend is unknown, not installed, or cannot compute in the precision.
    """
    _check_scene(scene)
    if backend == "numpy":
        return PreparedScene(scene, backend, PlainScene.of(scene, settings))
    if backend != "numba":
        raise SettingsError(f"splat backends are 'numba' and 'numpy', got {backend!r}")
    _check_precision(backend, settings)
    try:
        from bathyscope.splat.compiled import CompiledScene
    except (ImportError, RuntimeError) as error:  # numba raises RuntimeError where it cannot keep its cache
        raise SettingsError(
            f"the numba splat backend cannot be used ({error}); install bathyscope[serve], point NUMBA_CACHE_DIR to "
            "a folder that can be written, or pass backend='numpy'"
        ) from error
    return PreparedScene(scene, backend, CompiledScene.of(scene))


def render(
    scene: Gaussians | PreparedScene,
    camera_from_world: Matrix,
    intrinsics: Matrix,
    size: Size,
    *,
    settings: SplatSettings = DEFAULTS,
    colour: bool = True,
    background: Matrix | None = None,
    backend: Backend | None = None,
) -> Rendering:
    """Depth, opacity and colour of a scene as one camera sees it.

    Runs on one thread and lets others run beside it: render several views by calling it from several threads.

    Args:
        scene: The Gaussians; several views are cheaper after :func:`prepare`.
        camera_from_world: (4, 4).
        intrinsics: (3, 3) in pixels of ``size``.
        size: (height, width) of the image.
        settings: Constants of the formulas.
        colour: Whether to blend colour; without it the harmonics are never read.
        background: (3,) RGB behind what is not opaque; black if not given. Depth never has one.
        backend: ``numba`` unless given; a prepared scene has its own.

    Returns:
        Arrays of ``size``: float32, or the precision of the numpy backend.

    Raises:
        GeometryError: If a shape is wrong, or a number that is needed is not finite or out of range.
        SettingsError: If the settings or the backend do not fit.
    """
    prepared, degree = _ready(scene, settings, colour, backend)
    view = make_view(camera_from_world, intrinsics, size)
    if background is not None and not colour:
        raise GeometryError("a background needs colour=True")
    return prepared.engine.render(view, settings, degree, _check_background(background))


def project(
    scene: Gaussians | PreparedScene,
    camera_from_world: Matrix,
    intrinsics: Matrix,
    size: Size,
    *,
    settings: SplatSettings = DEFAULTS,
    colour: bool = True,
    backend: Backend | None = None,
) -> Projection:
    """Where each Gaussian of a scene lies in the image of one camera; arguments and errors as :func:`render`."""
    prepared, degree = _ready(scene, settings, colour, backend)
    return prepared.engine.project(make_view(camera_from_world, intrinsics, size), settings, degree)


def _ready(
    scene: Gaussians | PreparedScene, settings: SplatSettings, colour: bool, backend: Backend | None
) -> tuple[PreparedScene, int | None]:
    if not isinstance(scene, PreparedScene):
        scene = prepare(scene, settings=settings, backend=backend or "numba")
    if backend is not None and backend != scene.backend:
        raise SettingsError(f"the scene was prepared for the {scene.backend} backend, asked for {backend}")
    _check_precision(scene.backend, settings)
    if not colour:
        return scene, None
    stored = scene.gaussians.degree
    degree = stored if settings.degree is None else settings.degree
    if degree > stored:
        raise GeometryError(f"harmonics of degree {degree} were asked for, the scene has degree {stored}")
    if degree > MAX_DEGREE:
        raise GeometryError(f"harmonics of degree {degree} are not supported; set degree={MAX_DEGREE} or lower")
    return scene, degree


def _check_precision(backend: Backend, settings: SplatSettings) -> None:
    if backend == "numba" and settings.precision != "float32":
        raise SettingsError(f"the numba backend computes in float32, not {settings.precision}; use backend='numpy'")


def _check_background(background: Matrix | None) -> Floats | None:
    if background is None:
        return None
    checked = np.asarray(background, np.float64)
    if checked.shape != (3,) or not np.isfinite(checked).all():
        raise GeometryError(f"a background is 3 finite RGB values, got {background!r}")
    return checked


def _check_scene(scene: Gaussians) -> None:
    for name in ("means", "rotations", "scales", "opacities"):
        finite = np.isfinite(getattr(scene, name))
        if not finite.all():
            bad = np.flatnonzero(~finite.reshape(len(scene), -1).all(-1))
            raise GeometryError(f"{name} of {len(bad)} Gaussians are not finite, the first is number {bad[0]}")
    lengths = np.einsum("ni,ni->n", scene.rotations, scene.rotations)
    wrong = {
        "a negative scale": scene.scales < 0,
        "an opacity outside [0, 1]": (scene.opacities < 0) | (scene.opacities > 1),
        "a rotation of length 0": lengths <= 0,
    }
    for what, mask in wrong.items():
        if mask.any():
            bad = np.flatnonzero(mask.reshape(len(scene), -1).any(-1))
            raise GeometryError(f"{len(bad)} Gaussians have {what}, the first is number {bad[0]}")
