"""The fast renderer for processors: the splatter of ``bathyscope.splat`` with gradients.

Float32 on any number of threads. The way back works out order, projection and blending again, one view at a time, so
that of a rendering only its images are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from bathyscope.errors import GeometryError, SettingsError
from bathyscope.gaussians import Gaussians
from bathyscope.splat import PreparedScene, SplatSettings, prepare, render
from bathyscope.splat.view import make_view
from bathyscope_train.model.gaussian_parameters import GaussianBatch
from bathyscope_train.model.unprojection import invert_rigid
from bathyscope_train.render.contract import Rendering, check_batch

FIELDS = ("means", "rotations", "scales", "opacities", "harmonics")
PLANES = 5
"""Opacity, accumulated depth and RGB."""

Item = TypeVar("Item")
Result = TypeVar("Result")
F32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class CpuRenderer:
    """A :class:`~bathyscope_train.render.contract.Renderer` for tensors in main memory.

    Gradients reach means, rotations, scales, opacities, harmonics, poses and intrinsics. With one number of threads,
    one batch gives the same bits every time; another number changes the order of additions, that is rounding.
    """

    settings: SplatSettings = field(default_factory=SplatSettings)
    """Constants of the formulas."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """RGB behind what is not opaque."""
    threads: int | None = None
    """Views worked on at the same time; ``torch.get_num_threads()`` if not given."""
    spare_memory: int = 1 << 30
    """Bytes that threads after the first may spend on gradients of their own; fewer of them run if it is not enough."""

    def __call__(
        self,
        scene: GaussianBatch,
        world_from_camera: Float[Tensor, "b t 4 4"],
        intrinsics: Float[Tensor, "b t 3 3"],
        size: tuple[int, int],
    ) -> Rendering:
        """Render ``scene``, see :class:`~bathyscope_train.render.contract.Renderer`.

        Raises:
            GeometryError: If the batches of scene, poses and intrinsics differ, or numbers are not finite or out of
                range.
            SettingsError: If a tensor is not float32 in main memory, or numba is not installed.
        """
        return self.from_cameras(scene, invert_rigid(world_from_camera), intrinsics, size)

    def from_cameras(
        self,
        scene: GaussianBatch,
        camera_from_world: Float[Tensor, "b t 4 4"],
        intrinsics: Float[Tensor, "b t 3 3"],
        size: tuple[int, int],
    ) -> Rendering:
        """The same for poses that are inverted already: gradients reach their entries."""
        check_batch(scene, camera_from_world, intrinsics)
        tensors = (*(getattr(scene, name) for name in FIELDS), camera_from_world, intrinsics)
        _check_tensors(tensors)
        planes: Tensor = _Splat.apply(self, size, *tensors)  # type: ignore[no-untyped-call]
        return Rendering.of(planes, self.background)

    def workers(self, views: int, bytes_each: int) -> int:
        """How many threads share ``views``, each after the first with so many bytes of its own."""
        wanted = torch.get_num_threads() if self.threads is None else self.threads
        return max(1, min(wanted, views, 1 + self.spare_memory // max(1, bytes_each)))


class _Splat(torch.autograd.Function):
    """(b, t, 5, h, w) opacity, accumulated depth and RGB without a background."""

    @staticmethod
    def forward(ctx: Any, renderer: CpuRenderer, size: tuple[int, int], *tensors: Tensor) -> Tensor:
        *_, poses, intrinsics = tensors
        clips, frames = poses.shape[:2]
        planes = np.empty((clips, frames, PLANES, *size), np.float32)
        for clip in range(clips):
            scene = prepare(_gaussians(tensors, clip))

            def fill(frame: int, clip: int = clip, scene: PreparedScene = scene) -> None:
                camera = _numpy(poses[clip, frame]), _numpy(intrinsics[clip, frame])
                view = render(scene, *camera, size, settings=renderer.settings)
                assert view.image is not None
                planes[clip, frame, 0], planes[clip, frame, 1] = view.opacity, view.accumulated
                planes[clip, frame, 2:] = view.image.transpose(2, 0, 1)

            _in_parallel(fill, range(frames), renderer.workers(frames, 0))
        out = torch.from_numpy(planes)
        ctx.renderer = renderer
        ctx.save_for_backward(*tensors, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        *tensors, planes = ctx.saved_tensors
        out = [torch.empty_like(tensor) for tensor in tensors]
        for clip in range(len(gradient)):
            parts = _clip_backward(ctx.renderer, tensors, clip, _numpy(planes[clip]), _numpy(gradient[clip]))
            for whole, part in zip(out, parts, strict=True):
                whole[clip] = torch.from_numpy(part)
        return None, None, *out


def _clip_backward(
    renderer: CpuRenderer, tensors: Sequence[Tensor], clip: int, planes: F32, gradients: F32
) -> tuple[F32, ...]:
    """Gradients of the tensors of one clip, in their order; views are dealt out to threads in turn."""
    from bathyscope.splat.backward import SceneGradient
    from bathyscope.splat.compiled import CompiledScene

    gaussians, settings = _gaussians(tensors, clip), renderer.settings
    scene = CompiledScene.of(gaussians)
    degree = gaussians.degree if settings.degree is None else settings.degree
    poses, intrinsics = _numpy(tensors[-2][clip]), _numpy(tensors[-1][clip])
    by_pose, by_intrinsics = np.zeros(poses.shape, np.float32), np.zeros(intrinsics.shape, np.float32)
    frames = len(poses)
    threads = renderer.workers(frames, SceneGradient.bytes_for(scene))

    def one_thread(number: int) -> SceneGradient:
        found = SceneGradient(scene, degree)
        for frame in range(number, frames, threads):
            view = make_view(poses[frame], intrinsics[frame], gradients.shape[-2:])
            camera = found.add_view(view, settings, planes[frame], gradients[frame])
            by_pose[frame], by_intrinsics[frame] = camera.camera_from_world, camera.intrinsics
        return found

    first, *others = _in_parallel(one_thread, range(threads), threads)
    for other in others:
        first.add(other)
    found = first.of(gaussians)
    return (*(np.asarray(getattr(found, name)) for name in FIELDS), by_pose, by_intrinsics)


def _in_parallel(work: Callable[[Item], Result], items: Sequence[Item], threads: int) -> list[Result]:
    if threads == 1:
        return [work(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, items))


def _gaussians(tensors: Sequence[Tensor], clip: int) -> Gaussians:
    return Gaussians(*(_numpy(tensor[clip]) for tensor in tensors[: len(FIELDS)]))


def _numpy(tensor: Tensor) -> F32:
    array: F32 = tensor.detach().contiguous().numpy()
    return array


def _check_tensors(tensors: Sequence[Tensor]) -> None:
    for name, tensor in zip((*FIELDS, "poses", "intrinsics"), tensors, strict=True):
        if tensor.device.type != "cpu" or tensor.dtype != torch.float32:
            raise SettingsError(
                f"the cpu renderer works on float32 in main memory, got {name} as {tensor.dtype} on {tensor.device}; "
                "move it, or use the reference renderer (any precision) or the gsplat one (CUDA)"
            )
        if not torch.isfinite(tensor).all():
            raise GeometryError(f"{name} that are to be rendered have values that are not finite")
