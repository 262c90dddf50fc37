"""The renderer in torch shows what the one in numba shows, before the noise."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from bathyscope_train.data.synthetic import DOMAINS, Domain
from bathyscope_train.data.synthetic.clip import ClipPlan, plan_clip
from bathyscope_train.data.synthetic.kernels import render
from bathyscope_train.data.synthetic.optics import develop
from bathyscope_train.data.synthetic.torch_clip import render_clips, render_plans
from bathyscope_train.data.synthetic.torch_compaction import compact, pick, put
from bathyscope_train.data.synthetic.torch_filters import blur, sampling_matrix
from bathyscope_train.data.synthetic.torch_jpeg import compress
from bathyscope_train.data.synthetic.torch_rendering import render_scenes
from bathyscope_train.data.synthetic.torch_scene import scene_tensors

SIZE = (28, 35)
FAMILIES = ("lumen", "cavity", "sinus")


def without_noise(family: str, **sensor: object) -> Domain:
    broad = DOMAINS["broad"]
    chosen = broad.sensor.model_copy(update={"noise": (0.0, 0.0), "round_view": 0.5, **sensor})
    return broad.model_copy(update={"families": {family: 1.0}, "sensor": chosen})


def by_numba(plan: ClipPlan) -> tuple[np.ndarray, np.ndarray]:
    """Radiance ``(t, h, w, 3)`` and depth ``(t, h, w)`` of the kernels."""
    scene = plan.scene
    rendered = [
        render(scene.surface, scene.tissue, plan.lamp, pose, plan.intrinsics, plan.size)
        for pose in plan.scene_from_camera
    ]
    radiance, depth = (np.stack(values) for values in zip(*rendered, strict=True))
    return radiance, depth


@pytest.mark.parametrize("family", FAMILIES)
def test_radiance_and_depth_are_those_of_the_kernels(family: str) -> None:
    plans = [plan_clip(seed, without_noise(family), frames=2, size=SIZE) for seed in range(3)]
    radiance, depth = render_scenes(scene_tensors(plans, "cpu"), SIZE)
    for plan, light, z in zip(plans, radiance.permute(0, 1, 3, 4, 2).numpy(), depth.numpy(), strict=True):
        expected_light, expected_z = by_numba(plan)
        off = np.abs(z - expected_z) > 1e-3 * expected_z
        assert off.mean() < 0.005
        assert np.abs(light - expected_light).mean() < 1e-3 * expected_light.mean()


@pytest.mark.parametrize("family", FAMILIES)
def test_pictures_are_those_of_the_kernels_to_a_level(family: str) -> None:
    domain = without_noise(family, compressed=0.5)
    plans = [plan_clip(seed, domain, frames=2, size=SIZE) for seed in range(4)]
    for plan, frames in zip(plans, render_plans(plans).frames, strict=True):
        expected = develop(np.random.default_rng(0), by_numba(plan)[0], plan.sensor)
        difference = np.abs(frames.permute(0, 2, 3, 1).numpy().astype(float) - expected)
        assert difference.mean() < (1.0 if plan.sensor.quality else 0.01)


def test_clips_of_several_families_come_back_in_the_order_of_their_seeds() -> None:
    domain = DOMAINS["broad"]
    batch = render_clips(range(5), domain, frames=2, size=SIZE)
    assert batch.frames.dtype == torch.uint8
    assert {name.split("-")[1] for name in batch.names} >= {"lumen", "cavity"}
    for seed in range(5):
        plan = plan_clip(seed, domain, frames=2, size=SIZE)
        assert batch.names[seed] == plan.name
        torch.testing.assert_close(
            batch.intrinsics[seed].double(), torch.from_numpy(plan.intrinsics), rtol=1e-6, atol=0
        )
        _, depth = by_numba(plan)
        inside = plan.sensor.view >= 0.5
        expected = torch.from_numpy(np.where(inside, depth, 0))
        off = (batch.depth[seed] - expected).abs() > 1e-3 * expected
        assert off.float().mean() < 0.005
        assert torch.equal(batch.valid[seed], batch.depth[seed] > 0)
    assert torch.equal(batch.world_from_camera[:, 0], torch.eye(4).expand(5, 4, 4))


def test_clips_of_one_scene_share_its_maps() -> None:
    plan = plan_clip(0, DOMAINS["source"], frames=1, size=SIZE)
    twice = scene_tensors([plan, replace(plan, name="again")], "cpu")
    assert len(twice.surface.cells.table) == len(scene_tensors([plan], "cpu").surface.cells.table)


def test_the_noise_is_that_of_the_generator() -> None:
    domain = DOMAINS["source"]
    first, again, other = (
        render_clips([0], domain, frames=1, size=SIZE, generator=torch.Generator().manual_seed(seed)).frames
        for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.parametrize(
    ("border", "code"),
    [("mirror", cv2.BORDER_DEFAULT), ("reflect", cv2.BORDER_REFLECT), ("nearest", cv2.BORDER_REPLICATE)],
)
def test_every_image_gets_the_blur_that_opencv_gives_it(border: str, code: int) -> None:
    images = np.random.default_rng(0).random((3, 2, 21, 34)).astype(np.float32)
    sigmas = (0.4, 0.0, 3.1)
    blurred = blur(torch.from_numpy(images), sigmas, border=border).numpy()
    for image, sigma, observed in zip(images, sigmas, blurred, strict=True):
        stacked = np.ascontiguousarray(image.transpose(1, 2, 0))
        expected = cv2.GaussianBlur(stacked, (0, 0), sigma, borderType=code) if sigma else stacked
        np.testing.assert_allclose(observed.transpose(1, 2, 0), expected, atol=2e-6)


def test_samples_between_samples_are_linear_and_beyond_the_border_constant() -> None:
    values = sampling_matrix(np.array([-1.0, 0.25, 1.5, 9.0]), 3) @ np.array([0.0, 10.0, 20.0])
    np.testing.assert_allclose(values, [0, 2.5, 15, 20])


@pytest.mark.parametrize("quality", [20, 60, 95])
def test_compression_is_that_of_libjpeg_to_a_level(quality: int) -> None:
    frames = render_clips([3], DOMAINS["source"], frames=2, size=(44, 52)).frames
    observed = compress(frames.float(), [quality])[0].permute(0, 2, 3, 1).numpy()
    for frame, ours in zip(frames[0].permute(0, 2, 3, 1).numpy(), observed, strict=True):
        coded = cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        decoded = cv2.imdecode(coded, cv2.IMREAD_COLOR)
        assert decoded is not None
        expected = decoded[..., ::-1].astype(float)
        assert np.abs(ours - expected).mean() < 1.2
        assert np.abs(ours - expected).mean() < 0.5 * np.abs(frame - expected).mean()


def test_marked_rays_are_moved_together_and_back() -> None:
    mask = torch.tensor([[True, False, True, True], [False, False, False, True], [False] * 4])
    values = torch.arange(12.0).view(3, 4)
    index, present = compact(mask)
    assert pick(values, index)[present].tolist() == [0, 2, 3, 7]
    assert torch.equal(put(values, index, present, -pick(values, index)), torch.where(mask, -values, values))
