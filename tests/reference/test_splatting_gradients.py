"""The torch renderers against golden images and golden gradients (``splatting/case_*.npz``)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from bathyscope.splat import SplatSettings
from bathyscope_train.model.gaussian_parameters import GaussianBatch
from bathyscope_train.render import CpuRenderer, ReferenceRenderer, Rendering

REFERENCE = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference"))
CASES = sorted((REFERENCE / "splatting").glob("case_*.npz"))
INPUTS = ("means", "quats", "scales", "opacities", "sh", "viewmats", "Ks")

pytestmark = pytest.mark.skipif(not CASES, reason=f"no splatting/case_*.npz under {REFERENCE}")


@dataclass(frozen=True)
class Pass:
    """A forward and a backward pass over all views of one case."""

    expected: dict[str, Any]
    rendering: Rendering
    loss: Tensor
    gradients: dict[str, np.ndarray]
    exact: bool


def renderer(data: dict[str, Any], kind: type[ReferenceRenderer | CpuRenderer]) -> ReferenceRenderer | CpuRenderer:
    names = ("near_plane", "far_plane", "eps2d", "alpha_threshold", "transmittance_cutoff", "max_alpha", "radius_clip")
    settings = SplatSettings(
        **{name: float(data[name]) for name in names},
        antialiased=bool(data["antialiased"]),
        degree=int(data["sh_degree"]),
    )
    background = tuple(float(value) for value in data.get("background", np.zeros(3)))
    return kind(settings, background)


def golden_loss(rendering: Rendering, data: dict[str, Any]) -> Tensor:
    solid = ~data["out_fragile"]
    masks = {
        "rgb": solid[..., None],
        "alpha": solid,
        "depth_accum": solid,
        "depth_expected": solid & (data["out_alpha"] > 0.05),
    }
    found = {
        "rgb": rendering.image[0].permute(0, 2, 3, 1),
        "alpha": rendering.opacity[0],
        "depth_accum": rendering.accumulated[0],
        "depth_expected": rendering.depth[0],
    }
    terms = [
        (torch.from_numpy(mask * data[f"loss_w_{name}"]).to(found[name]) * found[name]).sum()
        for name, mask in masks.items()
    ]
    return torch.stack(terms).sum()


@cache
def run(path: Path, kind: type[ReferenceRenderer | CpuRenderer], dtype: torch.dtype) -> Pass:
    data = dict(np.load(path))
    leaves = {name: torch.from_numpy(data[name]).to(dtype)[None].requires_grad_() for name in INPUTS}
    scene = GaussianBatch(*(leaves[name] for name in INPUTS[:5]))
    size = int(data["height"]), int(data["width"])
    rendering = renderer(data, kind).from_cameras(scene, leaves["viewmats"], leaves["Ks"], size)
    loss = golden_loss(rendering, data)
    loss.backward()
    gradients = {name: leaf.grad[0].numpy() for name, leaf in leaves.items() if leaf.grad is not None}
    return Pass(data, rendering, loss.detach(), gradients, dtype == torch.float64)


@pytest.fixture(params=CASES, ids=lambda path: path.stem)
def path(request: pytest.FixtureRequest) -> Path:
    return request.param


@pytest.fixture(
    params=[(ReferenceRenderer, torch.float32), (ReferenceRenderer, torch.float64), (CpuRenderer, torch.float32)],
    ids=["reference-float32", "reference-float64", "cpu"],
)
def found(path: Path, request: pytest.FixtureRequest) -> Pass:
    return run(path, *request.param)


def images(found: Pass) -> dict[str, np.ndarray]:
    rendering = found.rendering
    planes = {
        "out_rgb": rendering.image[0].permute(0, 2, 3, 1),
        "out_alpha": rendering.opacity[0],
        "out_depth_accum": rendering.accumulated[0],
        "out_depth_expected": rendering.depth[0],
    }
    return {name: plane.detach().numpy() for name, plane in planes.items()}


def test_images_agree_where_rounding_cannot_turn_a_decision(found: Pass) -> None:
    solid = ~found.expected["out_fragile"]
    for name, plane in images(found).items():
        assert np.abs(plane - found.expected[name])[solid].max() <= (1e-9 if found.exact else 1e-5), name


def test_images_stay_close_everywhere(found: Pass) -> None:
    for name, plane in images(found).items():
        difference = np.abs(plane - found.expected[name])
        assert (difference <= 2e-3).mean() >= 0.999, name
        assert difference.max() <= 2e-2, name


def test_the_loss_agrees(found: Pass) -> None:
    assert float(found.loss) == pytest.approx(float(found.expected["loss"]), rel=1e-9 if found.exact else 1e-4)


def test_gradients_agree(found: Pass) -> None:
    for name in INPUTS:
        expected, observed = found.expected[f"grad_{name}"], found.gradients[name]
        error = np.linalg.norm(observed - expected) / np.linalg.norm(expected)
        assert error <= (1e-9 if found.exact else 2e-4), name
