"""The renderer for CUDA: the gsplat library behind the contract of all renderers.

gsplat is imported when a renderer is made, not before. It compiles itself at the first rendering, which takes minutes
and needs ``nvcc``. It gives no gradient to intrinsics; they get one here from that of the poses, see
:class:`_Camera`.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from math import isclose
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from bathyscope.errors import SettingsError
from bathyscope.splat import SplatSettings
from bathyscope_train.model.gaussian_parameters import GaussianBatch
from bathyscope_train.model.unprojection import invert_rigid
from bathyscope_train.render.contract import Rendering, check_batch

OLDEST = (1, 4)
"""Version of gsplat whose arguments are known."""
TIGHT_BOUND = (1, 6)
"""Version since when alpha is bounded at 0.99 instead of 0.999."""

_COMPILED_IN = {"alpha_threshold": 1 / 255, "transmittance_cutoff": 1e-4}
# Passed if this gsplat knows them; later versions may change what they are by default.
_BY_VERSION: dict[str, Any] = {
    "absgrad": False,
    "camera_model": "pinhole",
    "channel_chunk": 32,
    "covars": None,
    "distributed": False,
    "segmented": False,
    "with_eval3d": False,
    "with_ut": False,
}


@dataclass(frozen=True, slots=True)
class GsplatRenderer:
    """A :class:`~bathyscope_train.render.contract.Renderer` on CUDA, float32; all cameras of a clip in one call.

    Gradients reach what they reach in the other renderers. Those of the intrinsics leave out one thing: that the
    bounds of slopes far outside the image move with them, which changes them by about one percent.

    Raises:
        SettingsError: If gsplat or CUDA is missing, or a setting is not what this gsplat has compiled in.
    """

    settings: SplatSettings = field(default_factory=SplatSettings)
    """Constants of the formulas; ``max_alpha`` has to be that of the installed gsplat."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """RGB behind what is not opaque."""
    rasterization: Callable[..., Any] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        module = _gsplat()
        _check_settings(self.settings, _version(module))
        object.__setattr__(self, "rasterization", module.rasterization)

    def __call__(
        self,
        scene: GaussianBatch,
        world_from_camera: Float[Tensor, "b t 4 4"],
        intrinsics: Float[Tensor, "b t 3 3"],
        size: tuple[int, int],
    ) -> Rendering:
        """Render ``scene``, see :class:`~bathyscope_train.render.contract.Renderer`.

        Raises:
            GeometryError: If the batches of scene, poses and intrinsics differ.
            SettingsError: If a tensor is not float32 on a CUDA device.
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
        _check_device(scene.means)
        planes = [
            self._clip(scene, clip, camera_from_world[clip], intrinsics[clip], size)
            for clip in range(len(camera_from_world))
        ]
        return Rendering.of(torch.stack(planes), self.background)

    def _clip(
        self, scene: GaussianBatch, clip: int, poses: Tensor, intrinsics: Tensor, size: tuple[int, int]
    ) -> Float[Tensor, "t 5 h w"]:
        """Opacity, accumulated depth and colour of all views of one clip."""
        count = scene.harmonics.shape[-2]
        degree = round(count**0.5) - 1 if self.settings.degree is None else self.settings.degree
        known = inspect.signature(self.rasterization).parameters
        colours_and_depth, opacity, _ = self.rasterization(
            means=scene.means[clip],
            quats=scene.rotations[clip],
            scales=scene.scales[clip],
            opacities=scene.opacities[clip],
            colors=scene.harmonics[clip],
            viewmats=_Camera.apply(poses, intrinsics),  # type: ignore[no-untyped-call]
            Ks=intrinsics.detach(),
            width=size[1],
            height=size[0],
            near_plane=self.settings.near_plane,
            far_plane=self.settings.far_plane,
            radius_clip=self.settings.radius_clip,
            eps2d=self.settings.eps2d,
            sh_degree=degree,
            packed=False,
            tile_size=16,
            backgrounds=None,
            render_mode="RGB+D",
            sparse_grad=False,
            rasterize_mode="antialiased" if self.settings.antialiased else "classic",
            **{name: value for name, value in _BY_VERSION.items() if name in known},
        )
        planes = torch.cat((opacity, colours_and_depth[..., 3:], colours_and_depth[..., :3]), dim=-1)
        return planes.permute(0, 3, 1, 2)


class _Camera(torch.autograd.Function):
    r"""The poses as they are, with a gradient for the intrinsics as well.

    Stretching the camera's x axis by 1 + e does to an image what stretching fx does, and adding e z to x what adding
    e fx to cx does; neither moves the camera's centre. With g the gradient of the pose V, entries independent:
    dL/dfx = (V_0 . g_0) / fx and dL/dcx = (V_2 . g_0) / fx, rows of the matrices; likewise for y.
    """

    @staticmethod
    def forward(ctx: Any, poses: Tensor, intrinsics: Tensor) -> Tensor:
        ctx.save_for_backward(poses, intrinsics)
        return poses.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        poses, intrinsics = ctx.saved_tensors
        by_intrinsics = torch.zeros_like(intrinsics)
        for axis in range(2):
            asked, focal = gradient[..., axis, :], intrinsics[..., axis, axis]
            by_intrinsics[..., axis, axis] = (poses[..., axis, :] * asked).sum(-1) / focal
            by_intrinsics[..., axis, 2] = (poses[..., 2, :] * asked).sum(-1) / focal
        return gradient, by_intrinsics


def _gsplat() -> Any:
    try:
        module = importlib.import_module("gsplat")
    except ImportError as error:
        raise SettingsError(
            f"the gsplat renderer needs the gsplat package ({error}): pip install 'gsplat>=1.5.3', with the CUDA "
            "toolkit (nvcc) of this torch; or use renderer 'cpu' or 'reference'"
        ) from error
    if not _has_cuda():
        raise SettingsError(
            f"gsplat {module.__version__} draws on CUDA only and torch {torch.__version__} finds no CUDA device; use "
            "renderer 'cpu' or 'reference', or install a CUDA build of torch"
        )
    return module


def _has_cuda() -> bool:
    return torch.cuda.is_available()


def _check_device(means: Tensor) -> None:
    if not means.is_cuda or means.dtype != torch.float32:
        raise SettingsError(
            f"the gsplat renderer works on float32 on CUDA, got {means.dtype} on {means.device}; move the scene, or "
            "use renderer 'cpu' or 'reference'"
        )


def _version(module: Any) -> tuple[int, int]:
    major, minor = (int(part) for part in str(module.__version__).split(".")[:2])
    if (major, minor) < OLDEST:
        needed = ".".join(map(str, OLDEST))
        raise SettingsError(f"gsplat {module.__version__} is too old; install gsplat>={needed}")
    return major, minor


def _check_settings(settings: SplatSettings, version: tuple[int, int]) -> None:
    """Refuse what gsplat has compiled in with another value."""
    fixed = _COMPILED_IN | {"max_alpha": 0.99 if version >= TIGHT_BOUND else 0.999}
    wrong = [
        f"{name} is {getattr(settings, name):g}, gsplat {version[0]}.{version[1]} has {value:g}"
        for name, value in fixed.items()
        if not isclose(getattr(settings, name), value, rel_tol=1e-6)
    ]
    if wrong:
        raise SettingsError(f"settings that gsplat cannot follow: {'; '.join(wrong)}; change them or the renderer")
