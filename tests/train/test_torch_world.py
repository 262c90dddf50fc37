"""The renderer in torch shows what the one in numba shows, before the noise."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from bathyscope.errors import SettingsError
from bathyscope_train.data.synthetic import (
    DOMAINS,
    Domain,
    lens,
    torch_layout,
    torch_rendering,
    torch_support,
    torch_tracing,
)
from bathyscope_train.data.synthetic.clip import ClipPlan, plan_clip, render_frame_of
from bathyscope_train.data.synthetic.optics import develop, form_image
from bathyscope_train.data.synthetic.shutter import image_motion
from bathyscope_train.data.synthetic.torch_clip import render_clips, render_plans
from bathyscope_train.data.synthetic.torch_filters import blur, mean_matrix, sampling_matrix
from bathyscope_train.data.synthetic.torch_jpeg import compress
from bathyscope_train.data.synthetic.torch_layout import State, marked, pick, put, repeat_in_rounds, spread
from bathyscope_train.data.synthetic.torch_lens import distort, undistort
from bathyscope_train.data.synthetic.torch_metering import masked_percentile
from bathyscope_train.data.synthetic.torch_rendering import render_scenes
from bathyscope_train.data.synthetic.torch_scene import scene_tensors
from bathyscope_train.data.synthetic.torch_support import unknown_features

SIZE = (28, 35)
FAMILIES = ("lumen", "cavity", "sinus", "larynx", "closeup", "indoor")


def lively(family: str, *, alive: float, **sensor: object) -> Domain:
    """The broad domain with one family, bent lenses and no noise; ``alive``: tissue moves, instruments pass."""
    broad = DOMAINS["broad"]
    quiet = {"noise": (0.0, 0.0), "shot": (0.0, 0.0), "read": (0.0, 0.0)}
    life = {"instruments": alive, "breathing": alive, "peristalsis": alive}
    return broad.model_copy(
        update={
            "families": {family: 1.0},
            "camera": broad.camera.model_copy(update={"distorted": 0.7}),
            "life": broad.life.model_copy(update=life),
            "sensor": broad.sensor.model_copy(update=quiet | sensor),
        }
    )


def by_numba(plan: ClipPlan) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radiance ``(t, h, w, 3)``, depth and movers ``(t, h, w)`` of the kernels."""
    rendered = [render_frame_of(plan, frame) for frame in range(len(plan.scene_from_camera))]
    radiance, depth, mover = (np.stack(values) for values in zip(*rendered, strict=True))
    return radiance, depth, mover


def of_one_kind(plans: list[ClipPlan]) -> list[ClipPlan]:
    """A family may be built on several kinds of surface: those of the first."""
    return [plan for plan in plans if plan.scene.surface.kind == plans[0].scene.surface.kind]


@pytest.mark.parametrize("alive", [0.0, 1.0], ids=["still", "alive"])
@pytest.mark.parametrize("family", FAMILIES)
def test_radiance_depth_and_movers_are_those_of_the_kernels(family: str, alive: float) -> None:
    domain = lively(family, alive=alive)
    plans = of_one_kind([plan_clip(seed, domain, frames=2, size=SIZE) for seed in range(3)])
    pictures = render_scenes(scene_tensors(plans, "cpu"), SIZE)
    ours = (values.unflatten(0, (-1, 2)).numpy() for values in pictures)
    for plan, light, z, mover in zip(plans, *ours, strict=True):
        expected_light, expected_z, expected_mover = by_numba(plan)
        off = np.abs(z - expected_z) > 1e-3 * expected_z
        assert off.mean() < 0.005
        assert (mover != expected_mover).mean() < 0.005
        assert np.abs(light.transpose(0, 2, 3, 1) - expected_light).mean() < 1e-3 * expected_light.mean()


@pytest.mark.slow
def test_compiled_rendering_is_the_same_and_made_of_whole_graphs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the backend, whose code depends on the device: what is compiled, and how often, is the same."""
    monkeypatch.setattr(torch_layout, "_BACKEND", "eager")
    torch_layout.compiled.cache_clear()
    torch._dynamo.reset()
    counters = torch._dynamo.utils.counters
    counters.clear()
    plans = [plan_clip(0, lively("cavity", alive=1.0), frames=1, size=(16, 24))]
    expected = render_scenes(scene_tensors(plans, "cpu"), (16, 24))
    observed = render_scenes(scene_tensors(plans, "cpu", compiled=True), (16, 24))
    torch_layout.compiled.cache_clear()
    torch.testing.assert_close(tuple(observed), tuple(expected), rtol=1e-4, atol=1e-5)
    assert not counters["graph_break"]
    assert counters["stats"]["unique_graphs"] <= 12  # for all numbers of rays


SENSORS: dict[str, dict[str, object]] = {
    "as it comes": {},
    "smeared": {"smeared": 1.0, "interlaced": 0.5, "compressed": 0.0},
    "out of focus": {"unfocused": 1.0, "glaring": 1.0, "compressed": 0.0},
    "processed": {"fringed": 1.0, "sharpened": 1.0, "tinted": 1.0, "overlay": 1.0, "compressed": 0.0},
    "coded": {"compressed": 1.0, "held": 0.7, "hold": (1.0, 6.0)},
}


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_pictures_are_those_of_the_kernels_to_a_level(sensor: dict[str, object]) -> None:
    domain = lively("lumen", alive=0.3, **sensor)
    domain = domain.model_copy(update={"air": domain.air.model_copy(update={"smoky": 0.5})})
    plans = [plan_clip(seed, domain, frames=3, size=SIZE) for seed in range(4)]
    for plan, frames in zip(plans, render_plans(plans).frames, strict=True):
        radiance, depth, _ = by_numba(plan)
        motion = image_motion(depth, plan.scene_from_camera, plan.intrinsics, plan.distortion)
        formed = form_image(radiance, depth, motion, float(plan.intrinsics[0, 0]), plan.sensor)
        expected = develop(np.random.default_rng(0), formed, plan.sensor)
        difference = np.abs(frames.permute(0, 2, 3, 1).numpy().astype(float) - expected)
        assert difference.mean() < (1.6 if plan.sensor.quality else 0.05)


def test_a_feature_that_only_the_kernels_know_is_refused_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = plan_clip(0, DOMAINS["source"], frames=1, size=SIZE)
    assert unknown_features(plan) == []
    without_swell = torch_support._PARTS["ClipPlan"] - {"swell", "lamp"}
    monkeypatch.setitem(torch_support._PARTS, "ClipPlan", without_swell)
    assert unknown_features(plan) == ["ClipPlan.lamp"]  # swell is at its default: nothing moves
    with pytest.raises(SettingsError, match=r"does not render ClipPlan\.lamp"):
        render_plans([plan])


def test_everything_that_the_broad_domain_draws_is_known() -> None:
    domain = lively("lumen", alive=1.0)
    assert [unknown_features(plan_clip(seed, domain, frames=1, size=SIZE)) for seed in range(4)] == [[]] * 4


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
        _, depth, _ = by_numba(plan)
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


@pytest.mark.slow
def test_rendering_needs_nothing_from_another_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the meta device every tensor of another device is an error; which rays go on cannot be asked there."""

    def few(mask: torch.Tensor) -> torch_layout.Chosen:
        index = torch.arange(5, device=mask.device)
        return torch_layout.Chosen(index, index // mask.shape[1])

    for module in (torch_layout, torch_rendering):
        monkeypatch.setattr(module, "marked", few)
    for rounds in ("_MARCH", "_REFINE"):
        monkeypatch.setattr(torch_tracing, rounds, (1, 1))
    domain = lively("lumen", alive=0.5)
    domain = domain.model_copy(update={"families": {"lumen": 1.0, "cavity": 1.0, "indoor": 1.0}})
    batch = render_clips(range(10), domain, frames=2, size=(16, 20), device="meta")
    assert {name.split("-")[1] for name in batch.names} == {"lumen", "cavity", "indoor"}
    assert batch.frames.device.type == "meta"
    assert batch.frames.shape == (10, 2, 3, 16, 20)


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


def test_means_of_parts_are_those_that_opencv_takes() -> None:
    image = np.random.default_rng(0).random((35, 28)).astype(np.float32)
    expected = cv2.resize(image, (7, 8), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(mean_matrix(35, 8) @ image @ mean_matrix(28, 7).T, expected, atol=1e-6)


def test_percentiles_of_marked_values_are_numpys() -> None:
    random = np.random.default_rng(0)
    values, mask = random.random((3, 40)).astype(np.float32), random.random((3, 40)) < 0.6
    mask[2] = False
    found = masked_percentile(torch.from_numpy(values), torch.from_numpy(mask), torch.tensor([0.3, 0.5, 0.9]))
    expected = [np.percentile(values[0][mask[0]], 30), np.median(values[1][mask[1]]), 1.0]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6)


@pytest.mark.parametrize("quality", [20, 60, 95])
def test_compression_is_that_of_libjpeg_to_a_level(quality: int) -> None:
    noise = torch.Generator().manual_seed(1)
    frames = render_clips([3], DOMAINS["source"], frames=2, size=(44, 52), generator=noise).frames
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
    values, of_rows = torch.arange(12.0).view(3, 4), torch.tensor([[10.0], [20.0], [30.0]])
    chosen = marked(mask)
    assert pick(values, chosen).tolist() == [[0, 2, 3, 7]]
    assert spread((of_rows, 5), chosen)[0].tolist() == [[10, 10, 10, 20]]
    assert torch.equal(put(values, chosen, -pick(values, chosen)), torch.where(mask, -values, values))


def test_rays_that_need_many_steps_get_them_and_the_others_rest() -> None:
    wanted = torch.tensor([[1.0, 30.0, 5.0], [2.0, 90.0, 0.0]])
    scale = torch.tensor([[1.0], [2.0]])

    def step(scale: torch.Tensor, fixed: State, state: State, _: int) -> State:
        return (torch.where(state[0] < fixed[0], state[0] + scale, state[0]),)

    def unfinished(state: State) -> torch.Tensor:
        return state[0] < (wanted if state[0].shape == wanted.shape else torch.inf)

    (found,) = repeat_in_rounds(step, unfinished, scale, (wanted,), (torch.zeros_like(wanted),), rounds=(4, 8, 64))
    assert found.tolist() == [[1, 30, 5], [2, 90, 0]]


def test_a_lens_is_undone_in_single_precision() -> None:
    points, k = torch.rand(2, 3, 50, generator=torch.Generator().manual_seed(0)) - 0.5, torch.zeros(2, 3, 1)
    k[0], k[1] = torch.tensor([[-0.4], [0.0], [0.3]]), torch.tensor([[0.1], [0.0], [0.05]])
    torch.testing.assert_close(distort(undistort(points, k), k), points, rtol=0, atol=1e-6)
    expected = lens.undistort(points[:, 0].T.double().numpy(), (-0.4, 0.1))
    np.testing.assert_allclose(undistort(points, k)[:, 0].T.numpy(), expected, atol=1e-6)
