"""From frames to the objective: what no loss may gain by, what never becomes a Gaussian, and what saves memory only."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from consistency_runs import SIZE, run_settings, uneven_network
from torch import Tensor

from bathyscope.errors import SettingsError
from bathyscope_train.consistency.clip_step import TOTAL, ClipStep, within_frame_variation
from bathyscope_train.consistency.geometry import (
    ClipGeometry,
    assemble,
    dense_maps,
    encode,
    given_solution,
    predict,
)
from bathyscope_train.consistency.objective import anchor_loss, consistency_terms
from bathyscope_train.consistency.parts import set_trainable, trained_groups
from bathyscope_train.consistency.pictures import picture_grid
from bathyscope_train.consistency.rendering import ClipRendering, render_clip
from bathyscope_train.consistency.settings import ConsistencySettings
from bathyscope_train.model import Network
from bathyscope_train.model.network import Prediction
from bathyscope_train.model.presets import get_preset
from bathyscope_train.render import CpuRenderer

INSIDE = torch.ones(1, *SIZE, dtype=torch.bool)


@pytest.fixture(name="settings")
def _settings(tmp_path: Path) -> ConsistencySettings:
    return run_settings(tmp_path, tmp_path, tmp_path)


def images(frames: int = 4) -> Tensor:
    """Smooth pictures that drift to the left."""
    generator = torch.Generator().manual_seed(3)
    wall = torch.nn.functional.interpolate(
        torch.rand(1, 3, 8, 20, generator=generator), (SIZE[0], 3 * SIZE[1]), mode="bicubic", align_corners=False
    ).clamp(0.1, 0.9)
    return torch.stack([wall[0, ..., 2 * k : 2 * k + SIZE[1]] for k in range(frames)])[None]


def grown(network: Network, clip: Tensor, growth: Tensor, *, follow: bool) -> ClipGeometry:
    """Geometry of depth that is multiplied as a whole; cameras follow it, or stay where they are."""
    features = encode(network, clip, trained=False)
    maps = dense_maps(network, features, clip)
    depth = maps.depth.detach() * growth
    solved = given_solution(network, features, depth, None)
    encodings = solved.pose_encodings if follow else solved.pose_encodings.detach()
    return assemble(network, Prediction(encodings, replace(maps, depth=solved.depth)), clip)


@pytest.mark.parametrize("term", ["image", "world", "temporal"])
def test_no_term_gains_by_a_scene_that_shrinks_as_a_whole(settings: ConsistencySettings, term: str) -> None:
    network, clip = uneven_network(), images()
    gains = {}
    for follow in (True, False):
        growth = torch.ones((), requires_grad=True)
        geometry = grown(network, clip, growth, follow=follow)
        now = geometry.depth, geometry.world_from_camera, geometry.intrinsics
        before = ClipGeometry(*(values.detach() for values in now), None)
        rendered = render_clip(geometry, CpuRenderer(), settings.loss.image)
        terms = consistency_terms(rendered, geometry, before, images=clip, inside=INSIDE, settings=settings.loss)
        (gains[follow],) = torch.autograd.grad(terms[term], growth)
    assert abs(float(gains[True])) < 2e-3 * abs(float(gains[False]))


def test_depth_has_a_gradient_and_given_cameras_have_none_of_their_own(settings: ConsistencySettings) -> None:
    network, clip = uneven_network(), images()
    set_trainable(network, trained_groups(network, settings.parts), 0, settings)
    step = ClipStep(network, settings, CpuRenderer())
    found = step(clip, INSIDE)
    found[TOTAL].backward()
    found = {name: value.detach() for name, value in found.items()}
    assert sum(float(value.grad.abs().sum()) for value in network.depth_head.parameters() if value.grad is not None) > 0
    assert all(value.grad is None for value in network.camera_head.parameters())
    assert all(value.grad is None for value in step.before.parameters())
    assert float(found["growth"]) == pytest.approx(0, abs=1e-6)
    assert float(found["anchor"]) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("cameras", ["given", "before"])
def test_cameras_of_before_stay_where_depth_moves_and_given_ones_follow(tmp_path: Path, cameras: str) -> None:
    settings = run_settings(tmp_path, tmp_path, tmp_path, cameras=cameras)
    network, clip = uneven_network(), images()
    set_trainable(network, trained_groups(network, settings.parts), 0, settings)
    step = ClipStep(network, settings, CpuRenderer())
    now, before = step.geometry(clip, INSIDE)
    torch.testing.assert_close(now.world_from_camera, before.world_from_camera, rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(now.depth, before.depth)
    with torch.no_grad():
        list(network.depth_head.parameters())[-1].add_(0.5)  # the bias of log depth
    now, before = step.geometry(clip, INSIDE)
    grown = (now.depth / before.depth).mean().item()
    assert grown > 1.4
    ratio = now.world_from_camera[0, -1, :3, 3].norm() / before.world_from_camera[0, -1, :3, 3].norm()
    assert float(ratio.detach()) == pytest.approx(1 if cameras == "before" else grown, rel=0.02)


def test_what_is_outside_the_field_of_view_is_no_gaussian_and_learns_nothing() -> None:
    network, clip = uneven_network(), images()
    inside = INSIDE.clone()
    inside[..., :10] = False
    features = encode(network, clip, trained=False)
    geometry = predict(network, features, clip, inside)
    assert geometry.gaussians is not None
    opacities = geometry.gaussians.opacities.unflatten(1, (4, *SIZE))
    assert (opacities[..., :10] == 0).all()
    assert (opacities[..., 10:] > 0).all()
    assert network.gaussian_param_head is not None
    weights = list(network.gaussian_param_head.parameters())
    gradients = torch.autograd.grad(opacities[..., :10].sum(), weights, allow_unused=True)
    assert all(gradient is None or (gradient == 0).all() for gradient in gradients)


@pytest.mark.parametrize("chunk", [1, 3])
def test_dense_heads_in_chunks_give_the_same_maps_and_gradients(chunk: int) -> None:
    network, clip = uneven_network(), images()
    features = encode(network, clip, trained=False)
    found = []
    for size in (None, chunk):
        network.zero_grad()
        maps = dense_maps(network, features, clip, size)
        assert maps.gaussians is not None
        (maps.depth.square().mean() + maps.gaussians.square().mean()).backward()
        gradients = [value.grad.clone() for value in network.depth_head.parameters() if value.grad is not None]
        found.append((maps.depth.detach(), gradients))
    torch.testing.assert_close(found[0][0], found[1][0])
    for whole, parts in zip(found[0][1], found[1][1], strict=True):
        torch.testing.assert_close(whole, parts, rtol=1e-4, atol=1e-6)


def test_checkpointed_blocks_give_the_same_gradients(tmp_path: Path) -> None:
    gradients = []
    for saving in (False, True):
        settings = run_settings(
            tmp_path, tmp_path, tmp_path, parts={"aggregator": {"rate": 0.1}}, checkpoint_activations=saving
        )
        network = uneven_network()
        set_trainable(network, trained_groups(network, settings.parts), 0, settings)
        ClipStep(network, settings, CpuRenderer())(images(), INSIDE)[TOTAL].backward()
        gradients.append(network.aggregator.frame_blocks[0].attn.qkv.weight.grad)
    assert float(gradients[0].abs().max()) > 0
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-3, atol=1e-7)


def test_the_anchor_is_the_mean_change_of_log_depth_inside() -> None:
    before = torch.full((1, 2, *SIZE), 3.0)
    depth = before.clone()
    depth[:, 0] *= 2
    depth[..., :10] = 100
    inside = INSIDE.clone()
    inside[..., :10] = False
    assert float(anchor_loss(depth, before, inside)) == pytest.approx(0.5 * torch.log(torch.tensor(2.0)).item())


def test_variation_is_that_within_frames_and_leaves_holes_out() -> None:
    depth = torch.ones(1, 2, 4, 4)
    depth[:, 1] = 50  # another distance, but just as flat
    assert float(within_frame_variation(depth, torch.ones(1, 4, 4, dtype=torch.bool))) < 1e-6
    depth[:, :, :2] *= torch.e**2
    depth[:, :, 0, 0] = 0
    uneven = depth[0, 0][depth[0, 0] > 0].log()
    expected = uneven.std(correction=0)
    assert float(within_frame_variation(depth, torch.ones(1, 4, 4, dtype=torch.bool))) == pytest.approx(float(expected))


def test_pictures_show_the_image_as_the_loss_judges_it(settings: ConsistencySettings) -> None:
    step = ClipStep(uneven_network(), settings, CpuRenderer())
    shown = step.look(images(), INSIDE)
    geometry, _ = step.geometry(images(), INSIDE)
    drawn = render_clip(geometry, CpuRenderer(), settings.loss.image)
    assert shown.image is not None
    assert drawn.image is not None
    assert drawn.image_opacity is not None
    solid = drawn.image_opacity >= 0.05
    assert float(solid.float().mean()) > 0.01
    again = shown.image * torch.where(solid, drawn.image_opacity, 1)[:, :, None]
    torch.testing.assert_close(again, drawn.image)


@pytest.mark.parametrize("views", ["all", "others"])
def test_what_the_pairs_compare_is_rendered_or_where_each_frame_placed_its_gaussians(
    settings: ConsistencySettings, views: str
) -> None:
    network, term = uneven_network(), settings.loss.image.model_copy(update={"views": views})
    geometry = predict(network, encode(network, images(), trained=False), images(), INSIDE)
    rendered = render_clip(geometry, CpuRenderer(), term)
    placed = render_clip(geometry, CpuRenderer(), term, depth="placed")
    assert (placed.depth == geometry.depth).all()
    assert (placed.opacity == 1).all()
    assert not torch.allclose(rendered.depth, geometry.depth, rtol=1e-3)
    assert placed.image is not None
    assert rendered.image is not None
    assert (placed.image == rendered.image).all()
    bare = render_clip(geometry, CpuRenderer(), term.model_copy(update={"weight": 0}), depth="placed")
    assert bare.image is None


def test_a_network_without_gaussians_is_not_asked_for_images(settings: ConsistencySettings) -> None:
    preset = get_preset("tiny").model_copy(update={"gaussians": None, "name": "bare"})
    with pytest.raises(SettingsError, match=r"'bare' has no Gaussians .* set loss.image.weight=0"):
        ClipStep(Network(preset), settings, CpuRenderer())


def test_a_picture_has_a_row_for_each_frame_and_five_columns() -> None:
    maps = torch.ones(1, 4, *SIZE)
    maps[0, 0, 0, 0] = 0
    rendered = ClipRendering(maps, maps, images(), maps)
    grid = picture_grid(images()[0], rendered, frames=3)
    assert grid.shape == (3 * (SIZE[0] + 2), 5 * (SIZE[1] + 2), 3)
    columns = [grid[: SIZE[0], start : start + SIZE[1]] for start in range(0, grid.shape[1], SIZE[1] + 2)]
    assert (columns[0] == columns[1]).all()  # rendered as filmed
    assert (columns[2][0, 0] == 0).all()  # nothing was rendered there
    assert (columns[3][0, 0] == 0).all()
    assert (columns[3][1] == 255).all()
    assert (columns[4] == 0).all()
