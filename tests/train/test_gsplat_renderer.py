"""The gsplat backend without gsplat: what is asked of the library, and what is made of its answer.

The library itself needs CUDA. A stand-in with its signature draws with the reference renderer, so that what is
checked here is the assembly of arguments and answers, and the gradient of the intrinsics; not gsplat's own drawing.
"""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from bathyscope.errors import SettingsError
from bathyscope.splat import SplatSettings
from bathyscope_train.model.gaussian_parameters import GaussianBatch
from bathyscope_train.render import GsplatRenderer, ReferenceRenderer
from bathyscope_train.render import gsplat as backend

SIZE = (7, 10)
Calls = list[dict[str, Any]]


def stand_in(calls: Calls, version: str = "1.5.3") -> SimpleNamespace:
    """Something with the face of gsplat."""

    def rasterization(  # noqa: PLR0917 - the library's own arguments
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        near_plane: float,
        far_plane: float,
        radius_clip: float,
        eps2d: float,
        sh_degree: int,
        packed: bool,
        tile_size: int,
        backgrounds: Tensor | None,
        render_mode: str,
        sparse_grad: bool,
        absgrad: bool,
        rasterize_mode: str,
        channel_chunk: int,
        distributed: bool,
        camera_model: str,
        covars: Tensor | None,
    ) -> tuple[Tensor, Tensor, dict[str, Any]]:
        calls.append(dict(locals()))
        settings = SplatSettings(
            near_plane=near_plane,
            far_plane=far_plane,
            eps2d=eps2d,
            radius_clip=radius_clip,
            degree=sh_degree,
            antialiased=rasterize_mode == "antialiased",
        )
        scene = GaussianBatch(means[None], quats[None], scales[None], opacities[None], colors[None])
        found = ReferenceRenderer(settings).from_cameras(scene, viewmats[None], Ks[None], (height, width))
        drawn = torch.cat((found.image[0].permute(0, 2, 3, 1), found.accumulated[0, ..., None]), -1)
        return drawn, found.opacity[0, ..., None], {}

    return SimpleNamespace(__version__=version, rasterization=rasterization)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    made: Calls = []
    install(monkeypatch, stand_in(made))
    return made


def install(monkeypatch: pytest.MonkeyPatch, module: SimpleNamespace) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", module)
    monkeypatch.setattr(backend, "_has_cuda", lambda: True)
    monkeypatch.setattr(backend, "_check_device", lambda means: None)


def leaves(clips: int = 2, frames: int = 3) -> dict[str, Tensor]:
    random = torch.Generator().manual_seed(1)
    count = 15
    means = 0.5 * torch.rand(clips, count, 3, generator=random, dtype=torch.float64) - 0.25
    means[..., 2] += 2
    poses = torch.eye(4, dtype=torch.float64).repeat(clips, frames, 1, 1)
    poses[..., :3, 3] = 0.03 * torch.randn(clips, frames, 3, generator=random, dtype=torch.float64)
    made = {
        "means": means,
        "rotations": torch.randn(clips, count, 4, generator=random, dtype=torch.float64),
        "scales": 0.05 + 0.1 * torch.rand(clips, count, 3, generator=random, dtype=torch.float64),
        "opacities": 0.2 + 0.6 * torch.rand(clips, count, generator=random, dtype=torch.float64),
        "harmonics": 0.3 * torch.randn(clips, count, 4, 3, generator=random, dtype=torch.float64),
        "poses": poses,
        "intrinsics": torch.tensor([[10.0, 0, 5], [0, 11, 3.5], [0, 0, 1]], dtype=torch.float64).repeat(
            clips, frames, 1, 1
        ),
    }
    return {name: leaf.requires_grad_() for name, leaf in made.items()}


def scene_of(ready: dict[str, Tensor]) -> GaussianBatch:
    return GaussianBatch(*(ready[name] for name in ("means", "rotations", "scales", "opacities", "harmonics")))


def test_all_cameras_of_a_clip_go_in_one_call(calls: Calls) -> None:
    ready = leaves(clips=2, frames=3)
    GsplatRenderer().from_cameras(scene_of(ready), ready["poses"], ready["intrinsics"], SIZE)
    assert [tuple(call["viewmats"].shape) for call in calls] == [(3, 4, 4)] * 2
    assert torch.equal(calls[1]["means"], ready["means"][1])


def test_every_default_that_versions_change_is_passed(calls: Calls) -> None:
    settings = SplatSettings(near_plane=0.02, radius_clip=0.1, antialiased=True, eps2d=0.4, degree=1)
    ready = leaves()
    GsplatRenderer(settings).from_cameras(scene_of(ready), ready["poses"], ready["intrinsics"], SIZE)
    expected = {
        "near_plane": 0.02,
        "far_plane": 1e10,
        "radius_clip": 0.1,
        "eps2d": 0.4,
        "sh_degree": 1,
        "packed": False,
        "backgrounds": None,
        "render_mode": "RGB+D",
        "rasterize_mode": "antialiased",
        "camera_model": "pinhole",
        "covars": None,
        "width": SIZE[1],
        "height": SIZE[0],
    }
    assert {name: calls[0][name] for name in expected} == expected


@pytest.mark.parametrize("antialiased", [False, True])
def test_pictures_and_gradients_are_those_of_the_reference(calls: Calls, antialiased: bool) -> None:
    """Also of the intrinsics, which the library gives none for; no slope lies outside the image here.

    Colours do not depend on the direction here: a camera's centre, which the stand-in gets from a transposed rotation
    and the library from an inverted matrix, has another gradient where rotations are no longer rotations.
    """
    settings, background = SplatSettings(antialiased=antialiased), (0.9, 0.5, 0.2)
    gradients, pictures = [], []
    for renderer in (GsplatRenderer(settings, background), ReferenceRenderer(settings, background)):
        ready = leaves()
        ready["harmonics"] = ready["harmonics"].detach()[:, :, :1].requires_grad_()
        found = renderer.from_cameras(scene_of(ready), ready["poses"], ready["intrinsics"], SIZE)
        weight = torch.linspace(-1, 1, found.depth.numel(), dtype=torch.float64).reshape(found.depth.shape)
        ((found.image.sum(2) + found.depth + found.opacity) * weight).sum().backward()
        pictures.append(found)
        gradients.append({name: leaf.grad for name, leaf in ready.items()})
    for name in ("image", "depth", "accumulated", "opacity"):
        torch.testing.assert_close(getattr(pictures[0], name), getattr(pictures[1], name))
    for name, expected in gradients[1].items():
        torch.testing.assert_close(gradients[0][name], expected, rtol=1e-9, atol=1e-9)


def test_settings_that_are_compiled_in_are_refused_otherwise(calls: Calls, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SettingsError, match=r"max_alpha is 0.99, gsplat 1.5 has 0.999"):
        GsplatRenderer(SplatSettings(max_alpha=0.99))
    install(monkeypatch, stand_in([], version="1.6.0"))
    GsplatRenderer(SplatSettings(max_alpha=0.99))
    with pytest.raises(SettingsError, match=r"gsplat 1.6 has 0.99"):
        GsplatRenderer()


def test_an_old_version_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, stand_in([], version="1.3.0"))
    with pytest.raises(SettingsError, match=r"install gsplat>=1.4"):
        GsplatRenderer()


def test_without_the_library_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(SettingsError, match=r"pip install 'gsplat>=1.5.3'"):
        GsplatRenderer()


def test_without_cuda_the_message_names_the_other_renderers(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, stand_in([]))
    monkeypatch.setattr(backend, "_has_cuda", lambda: False)
    with pytest.raises(SettingsError, match=r"finds no CUDA device; use renderer 'cpu'"):
        GsplatRenderer()


def test_a_scene_in_main_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", stand_in([]))
    monkeypatch.setattr(backend, "_has_cuda", lambda: True)
    ready = leaves()
    with pytest.raises(SettingsError, match="float32 on CUDA"):
        GsplatRenderer().from_cameras(scene_of(ready), ready["poses"], ready["intrinsics"], SIZE)
