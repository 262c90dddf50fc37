"""Whole runs of the consistency optimisation on Video Depth Anything."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from bathyscope.errors import SettingsError
from bathyscope_train.consistency.plan import make_plan
from bathyscope_train.consistency.settings import ConsistencySettings, load_consistency_settings
from bathyscope_train.consistency.trainer import optimise
from bathyscope_train.model import Network, get_preset
from bathyscope_train.model.checkpoints import save_checkpoint, training_of
from bathyscope_train.model.weight_files import open_weights
from bathyscope_train.systems import Unavailable, open_system
from bathyscope_train.systems.vda.network import VideoDepthAnything
from bathyscope_train.systems.vda.settings import SIZES

CONFIGS = Path(__file__).parents[2] / "configs"


def sliding_video(folder: Path, frames: int = 24) -> Path:
    """A folder of our layout: a texture that passes by, with poses in millimetres."""
    (folder / "frames").mkdir(parents=True)
    rng = np.random.default_rng(0)
    texture = cv2.resize(rng.integers(30, 220, (16, 48, 3)).astype(np.uint8), (288, 64), interpolation=cv2.INTER_CUBIC)
    lines = []
    for t in range(frames):
        cv2.imwrite(str(folder / "frames" / f"{t:04d}.png"), texture[:, 2 * t : 2 * t + 80])
        pose = np.eye(4)
        pose[0, 3] = 1.5 * t
        lines.append(f"{t:04d}.png " + " ".join(repr(float(value)) for value in pose.ravel()))
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")
    calibration = {"width": 80, "height": 64, "fx": 70.0, "fy": 70.0, "cx": 40.0, "cy": 32.0}
    unit = {"depth_scale": 1.0, "depth_unit": "millimetre", "pose_unit": "millimetre", "depth_valid": None}
    (folder / "intrinsics.json").write_text(json.dumps(calibration | unit))
    return folder


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    network = VideoDepthAnything(SIZES["s"])
    torch.nn.init.constant_(network.head.scratch.output_conv2[2].bias, 1.0)
    path = tmp_path_factory.mktemp("vda") / "video_depth_anything_vits.pth"
    torch.save(network.state_dict(), path)
    return path


def settings(tmp_path: Path, weights: Path, **changes: Any) -> ConsistencySettings:
    base = load_consistency_settings(
        CONFIGS / "consistency-vda.yaml",
        [f"data={sliding_video(tmp_path / 'video')}", f"init={weights}", f"out={tmp_path / 'run'}", "device=cpu"],
    )
    small = {
        "steps": 2,
        "warmup_steps": 1,
        "loaders": 0,
        "tensorboard": False,
        "precision": "float32",
        "checkpoint_every": 1,
        "pictures_every": 2,
        "cameras_from": "data",
        "nominal_depth": 60.0,
        "window": {"frames": 7, "size": (56, 70)},
    }
    return ConsistencySettings.model_validate(base.model_dump() | small | changes)


@pytest.mark.slow
def test_a_run_trains_the_head_alone_and_leaves_weights_that_open_as_a_system(tmp_path: Path, weights: Path) -> None:
    torch.manual_seed(0)
    ours = tmp_path / "tiny.safetensors"
    save_checkpoint(Network(get_preset("tiny")), ours)
    path = optimise(settings(tmp_path, weights, cameras_from=str(ours), nominal_depth=None))
    before, after = open_weights(weights), open_weights(path)
    assert dict(after.shapes) == dict(before.shapes)
    changed = {name for name in before.shapes if not torch.equal(before.read(name), after.read(name))}
    assert changed
    assert all(name.startswith("head.") for name in changed)
    assert any("motion_modules" in name for name in changed)
    system = open_system(f"vda+consistency={path}")
    assert not isinstance(system, Unavailable)
    assert (system.info.name, system.info.details["network"]) == ("vda+consistency", "vda-s")
    assert training_of(path)
    steps = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert any("world" in step and "temporal" in step for step in steps)
    assert len(list((tmp_path / "run" / "pictures").iterdir())) > 0


@pytest.mark.slow
def test_a_run_goes_on_where_it_stopped(tmp_path: Path, weights: Path) -> None:
    whole = optimise(settings(tmp_path / "a", weights))
    stopped = settings(tmp_path / "b", weights)
    optimise(stopped)
    last = stopped.out / "checkpoints" / "step-0000002"
    (stopped.out / "model.safetensors").unlink()
    for file in last.iterdir():
        file.unlink()
    last.rmdir()
    again = optimise(stopped)
    first, second = open_weights(whole), open_weights(again)
    for name in first.shapes:
        torch.testing.assert_close(first.read(name), second.read(name), rtol=0, atol=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"loss": {"image": {"weight": 1.0}}}, "renders no image; set loss.image.weight=0"),
        ({"cameras_from": None}, "has no cameras; set cameras_from="),
        ({"nominal_depth": None}, "come without depth; set nominal_depth"),
        ({"validation": ("somewhere",)}, "measured by `bathyscope evaluate`; set validation="),
        ({"window": {"frames": 40}}, "at most 32 frames in patches of 14 pixels, settings say 40 and 14"),
    ],
    ids=["image", "cameras", "depth", "validation", "window"],
)
def test_what_cannot_be_trained_is_refused(
    tmp_path: Path, weights: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(SettingsError, match=message):
        optimise(settings(tmp_path, weights, **changes))


def test_a_plan_says_what_is_trained_and_what_memory_it_takes(tmp_path: Path, weights: Path) -> None:
    plan = make_plan(settings(tmp_path, weights))
    network = VideoDepthAnything(SIZES["s"])
    head = sum(value.numel() for value in network.head.parameters())
    assert plan.preset == "vda-s"
    assert sum(plan.counts) == head
    assert plan.frozen == sum(value.numel() for value in network.pretrained.parameters())
    assert plan.memory.parts["AdamW"] == 2 * 4 * head
    assert plan.memory.parts["activations"] > 7 * 4 * 56 * 70
    assert "head" in str(plan)
