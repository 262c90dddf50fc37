"""Training on clips that are rendered while it trains: exact windows, renewal, resuming, slices, devices."""

import json
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from safetensors.torch import load_file

from bathyscope.errors import SettingsError
from bathyscope_train.config import PretrainSettings, RenderSettings, SourceSettings
from bathyscope_train.data.rendered_windows import RenderedPool
from bathyscope_train.data.synthetic import DOMAINS
from bathyscope_train.data.synthetic.clip import plan_clip, render_clip
from bathyscope_train.data.synthetic.plan_stream import PlanJob, PlanStream
from bathyscope_train.data.truth_clips import truth_clip
from bathyscope_train.data.window_sources import WindowSources, named_domain
from bathyscope_train.data.windows import Augmentation, cut_window
from bathyscope_train.devices import choose_device, use_bfloat16
from bathyscope_train.losses.supervised import supervised_objective
from bathyscope_train.metrics_file import METRICS_FILE
from bathyscope_train.model.network import Network
from bathyscope_train.model.presets import get_preset
from bathyscope_train.pretrain import draw_pairs, pretrain
from bathyscope_train.pretrain_record import training_record
from bathyscope_train.training_state import STATE_FILE

CPU = torch.device("cpu")
SOURCE = DOMAINS["source"]
RENDER = RenderSettings(frames=6, height=28, width=42, pool=3, fresh=1, takes=2, processes=0)
PLAIN = Augmentation(crop_chance=0.0, gamma=(1.0, 1.0), gain=(1.0, 1.0), tint=0.0, slow_chance=0.0)


def settings(out: Path, **changes: object) -> PretrainSettings:
    values: dict[str, object] = {
        "data": (SourceSettings(domain="source"),),
        "render": RENDER,
        "device": "cpu",
        "out": out,
        "steps": 2,
        "batch": 2,
        "frames": 5,
        "pairs": 4,
    }
    return PretrainSettings.model_validate(values | changes)


def test_windows_of_a_pool_are_windows_of_the_clips_that_it_rendered() -> None:
    """Unaugmented but for mirrors and time's direction: depth over its mean is that of the kernels, to a mirror."""
    pool = RenderedPool(SOURCE, RENDER.model_copy(update={"pool": 1, "takes": 1}), device=CPU, first_seed=4)
    batch = pool.draw(np.random.default_rng(0), 3, frames=5, augmentation=PLAIN)
    clip = truth_clip(render_clip(4, SOURCE, frames=6, size=(28, 42)))
    expected = [cut_window(clip, list(range(start, start + 5))[::way]) for start in (0, 1) for way in (1, -1)]
    assert batch.images.shape == (3, 5, 3, 28, 42)
    for window in range(3):
        depth, focal = batch.depth[window], batch.focal[window]
        mirrors = [depth.flip(axes) for axes in ((), (1,), (2,), (1, 2))]
        differences = [(one - other.depth[0]).abs().mean() for one in mirrors for other in expected]
        assert min(differences) < 1e-4
        assert float(focal) == pytest.approx(clip.focal, rel=1e-6)
        mean = depth[batch.valid[window]].mean()
        assert float(mean) == pytest.approx(1, abs=1e-4)
    torch.testing.assert_close(batch.world_from_camera[:, 0], torch.eye(4).expand(3, 4, 4))


def test_a_crop_of_each_window_narrows_its_own_view() -> None:
    pool = RenderedPool(SOURCE, RENDER.model_copy(update={"pool": 1}), device=CPU)
    crops = Augmentation(crop=0.6, crop_chance=1.0)
    focal = pool.draw(np.random.default_rng(0), 6, frames=5, augmentation=crops).focal
    assert len(focal.unique()) == 6
    original = float(pool.clips["intrinsics"][0, 0, 0])
    assert ((focal > original) & (focal < original / 0.6 * 1.001)).all()


def test_the_oldest_clips_give_way_to_new_ones() -> None:
    pool = RenderedPool(SOURCE, RENDER, device=CPU)
    before = pool.clips["depth"].clone()
    pool.renew()
    kept = [torch.equal(a, b) for a, b in zip(before, pool.clips["depth"], strict=True)]
    assert kept == [False, True, True]
    pool.renew()
    assert torch.equal(before[2], pool.clips["depth"][2])
    assert not torch.equal(before[1], pool.clips["depth"][1])


def test_takes_share_a_scene_but_neither_camera_nor_light() -> None:
    stream = PlanStream(PlanJob(SOURCE, frames=2, size=(28, 42), takes=2), first_seed=3)
    first, second, third = stream.take(3)
    assert first.scene is second.scene
    assert first.scene is not third.scene
    assert not np.allclose(first.scene_from_camera, second.scene_from_camera)
    assert first.lamp.falloff != second.lamp.falloff
    np.testing.assert_array_equal(
        first.scene_from_camera, plan_clip(3, SOURCE, frames=2, size=(28, 42)).scene_from_camera
    )
    assert (first.name, second.name) == (first.name, f"{first.name}.1")


@pytest.mark.slow
def test_plans_come_in_order_from_other_processes() -> None:
    job = PlanJob(SOURCE, frames=2, size=(28, 42), takes=2)
    here, there = PlanStream(job), PlanStream(job, processes=1)
    try:
        for expected, observed in zip(here.take(4), there.take(4), strict=True):
            assert expected.name == observed.name
            np.testing.assert_array_equal(expected.scene.surface.heights, observed.scene.surface.heights)
    finally:
        there.close()


def test_sources_mix_by_their_shares_and_start() -> None:
    sources = [SourceSettings(domain="source"), SourceSettings(domain="broad", start=0.5)]
    windows = WindowSources(sources, RENDER, device=CPU)
    assert len(windows.draw(0.1, np.random.default_rng(0), 3, frames=5).images) == 3
    assert set(windows.pools) == {"source"}
    assert len(windows.draw(0.9, np.random.default_rng(1), 6, frames=5).images) == 6
    assert set(windows.pools) == {"source", "broad"}
    with pytest.raises(SettingsError, match="neither a domain"):
        named_domain("narrow")


@pytest.mark.slow
def test_a_run_on_rendered_clips_goes_on_where_a_slice_ended(tmp_path: Path) -> None:
    path = pretrain(settings(tmp_path, slice_minutes=1e-6))
    assert torch.load(tmp_path / STATE_FILE, weights_only=True)["step"] == 1
    first = load_file(path)
    assert pretrain(settings(tmp_path, slice_minutes=60)) == path
    state = torch.load(tmp_path / STATE_FILE, weights_only=True)
    assert state["step"] == 2
    assert any(not torch.equal(first[name], value) for name, value in load_file(path).items())
    assert json.loads((tmp_path / "settings.json").read_text())["data"][0]["domain"] == "source"
    assert not (tmp_path / METRICS_FILE).exists() or (tmp_path / METRICS_FILE).stat().st_size > 0
    record = training_record(settings(tmp_path, data=(SourceSettings(domain=str(tmp_path / "own.json")),)))
    assert record["data"][0] == {"folder": None, "domain": "own.json", "share": 1.0, "start": 0.0}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"data": ({"folder": "a", "domain": "source"},)}, "either a folder or a domain"),
        ({"data": ({},)}, "either a folder or a domain"),
        ({"workers": 2}, "need one worker"),
        ({"data": ({"folder": "a"},), "device": "cuda", "workers": 2}, "one worker trains"),
        ({"data": ({"folder": "a"},), "slice_minutes": 5, "workers": 2}, "slices"),
        ({"render": {"pool": 2, "fresh": 3}}, "replaces 3 clips"),
    ],
    ids=["both", "neither", "workers", "cuda workers", "slices", "fresh"],
)
def test_settings_that_contradict_each_other_are_refused(
    tmp_path: Path, changes: dict[str, object], words: str
) -> None:
    with pytest.raises(ValidationError, match=words):
        settings(tmp_path, **changes)


def test_a_device_that_is_not_there_is_refused_and_auto_takes_what_there_is() -> None:
    if torch.cuda.is_available():
        assert choose_device("auto").type == "cuda"
        assert use_bfloat16("auto", torch.device("cuda"))
    else:
        assert choose_device("auto") == CPU
        with pytest.raises(SettingsError, match="finds none"):
            choose_device("cuda")
    assert choose_device("auto", workers=2) == CPU


def test_an_objective_needs_nothing_from_another_device_and_waits_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the meta device every tensor of another device, and every value read back, is an error."""
    batch = WindowSources([SourceSettings(domain="source")], RENDER, device=CPU).draw(
        0, np.random.default_rng(0), 2, frames=5
    )
    away = type(batch)(*(getattr(batch, name).to("meta") for name in batch.__slots__))
    network = Network(get_preset("tiny")).to("meta")
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda *_: False)
    chosen = settings(Path("unused"))
    pairs = draw_pairs(5, 4, np.random.default_rng(0), torch.device("meta"))
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # meta has none
    objective = supervised_objective(network, away, pairs, chosen.loss)
    assert objective.total.device.type == "meta"
    objective.total.backward()
    assert all(p.grad is None or p.grad.device.type == "meta" for p in network.parameters())
