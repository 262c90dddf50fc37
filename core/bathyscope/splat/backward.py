"""Gradients of what the numba backend renders: by the Gaussians, the poses and the intrinsics.

Nothing is kept from the way there but the images: order, projection and blending are worked out again, a chunk of
Gaussians at a time, so that a further view costs no more memory than its images.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import GeometryError
from bathyscope.gaussians import Gaussians
from bathyscope.splat.compiled import CompiledScene
from bathyscope.splat.kernel_blend import PIXELS
from bathyscope.splat.kernel_blend_backward import (
    BACKWARD,
    PLANES,
    BackwardScratch,
    backward_tiles,
    blend_backward,
)
from bathyscope.splat.kernel_order import TILE, nearest_first
from bathyscope.splat.kernel_pack_backward import pack_backward
from bathyscope.splat.kernel_project import (
    CAMERA,
    CENTRE,
    FOCAL,
    LOWER,
    PRINCIPAL,
    RECORD,
    ROTATION,
    SIZE,
    TRANSLATION,
    UPPER,
    camera_numbers,
)
from bathyscope.splat.settings import SplatSettings
from bathyscope.splat.view import View

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CameraGradient:
    """Gradients of one camera; the entries of the matrices count as independent."""

    camera_from_world: F64
    """(4, 4), the last row zero."""
    intrinsics: F64
    """(3, 3); zero but for fx, fy, cx, cy."""


class SceneGradient:
    """Gradients of a scene, added up over views; one thread at a time may add.

    Args:
        scene: What was rendered.
        degree: Degree of the harmonics that were evaluated.
    """

    def __init__(self, scene: CompiledScene, degree: int) -> None:
        self._scene = scene
        self._degree = degree
        self._records = np.zeros((scene.count, RECORD), np.float32)
        self._harmonics = np.zeros(scene.harmonics.shape, np.float32)

    @staticmethod
    def bytes_for(scene: CompiledScene) -> int:
        """Memory that the gradients of a scene take."""
        return 4 * (scene.count * RECORD + scene.harmonics.size)

    def add_view(self, view: View, settings: SplatSettings, planes: F32, gradients: F32) -> CameraGradient:
        """Add what one view asks for.

        Args:
            view: The camera.
            settings: Constants of the rendering.
            planes: (5, h, w) opacity, accumulated depth and RGB without a background, as rendered.
            gradients: (5, h, w) their gradients.

        Returns:
            The gradients of the camera.

        Raises:
            GeometryError: If gradients are not finite.
        """
        height, width = view.size
        assert planes.shape == gradients.shape == (PLANES, height, width)
        if not np.isfinite(gradients).all():
            raise GeometryError("the gradients of a rendered view are not finite; the loss divides by zero somewhere")
        scene, camera = self._scene, camera_numbers(view, settings)
        order, count, boxes = nearest_first(scene.columns, camera)
        rows, columns = -(-height // TILE), -(-width // TILE)
        alive = np.empty(rows * columns, np.uint64)
        state = np.empty((rows * columns, BACKWARD, PIXELS), np.float32)
        backward_tiles(planes, gradients, columns, alive, state)
        by_camera = np.zeros(CAMERA)
        blend_backward(
            order,
            count,
            boxes,
            scene.records,
            scene.harmonics,
            self._degree,
            camera,
            settings.antialiased,
            alive,
            columns,
            state,
            BackwardScratch.of(rows * columns),
            (self._records, self._harmonics, by_camera),
        )
        return _camera_gradient(by_camera, view)

    def add(self, other: SceneGradient) -> None:
        """Add what another one has gathered."""
        self._records += other._records
        self._harmonics += other._harmonics

    def of(self, scene: Gaussians) -> Gaussians:
        """The gradients of the fields of ``scene``, which the views were rendered from, float32."""
        rotations, scales, opacities = (
            np.ascontiguousarray(a, np.float32) for a in (scene.rotations, scene.scales, scene.opacities)
        )
        means, by_rotations, by_scales = (np.empty((len(scene), side), np.float32) for side in (3, 4, 3))
        by_opacities = np.empty(len(scene), np.float32)
        pack_backward(rotations, scales, opacities, self._records, means, by_rotations, by_scales, by_opacities)
        return Gaussians(means, by_rotations, by_scales, by_opacities, self._harmonics)


def _camera_gradient(numbers: F64, view: View) -> CameraGradient:
    """From the numbers of ``camera_numbers`` to the matrices that they were made of."""
    by_rotation = numbers[ROTATION:TRANSLATION].reshape(3, 3).copy()
    by_translation = numbers[TRANSLATION:FOCAL].copy()
    by_centre = numbers[CENTRE:CAMERA]
    # The centre is -R^T t.
    by_rotation -= np.outer(view.translation, by_centre)
    by_translation -= view.rotation @ by_centre
    by_focal, by_principal = numbers[FOCAL:PRINCIPAL].copy(), numbers[PRINCIPAL:LOWER].copy()
    # The bounds of the slopes are -(c + margin) / f and (side - c + margin) / f.
    by_lower, by_upper = numbers[LOWER:UPPER], numbers[UPPER:SIZE]
    by_focal -= (by_lower * view.lower + by_upper * view.upper) / view.focal
    by_principal -= (by_lower + by_upper) / view.focal
    pose, intrinsics = np.zeros((4, 4)), np.zeros((3, 3))
    pose[:3, :3], pose[:3, 3] = by_rotation, by_translation
    intrinsics[0, 0], intrinsics[1, 1] = by_focal
    intrinsics[:2, 2] = by_principal
    return CameraGradient(pose, intrinsics)
