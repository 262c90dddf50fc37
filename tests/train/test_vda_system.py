"""Video Depth Anything as a system: what it reads, what it says, and what its temporal modules are."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from bathyscope.errors import ClipError, GeometryError, SettingsError
from bathyscope.vision.shorter_side import network_size
from bathyscope_train.systems.vda.network import VideoDepthAnything
from bathyscope_train.systems.vda.settings import VdaSettings
from bathyscope_train.systems.vda.system import vda_system
from bathyscope_train.systems.vda.temporal import TemporalModule, sinusoids

SMALL = VdaSettings(
    width=16, depth=4, heads=2, taps=(0, 1, 2, 3), features=8, channels=(8, 8, 8, 16), grid=4, motion_groups=4
)


class Counted:
    """A long clip that notes which frames are read."""

    name, size = "counted", (30, 40)

    def __init__(self, frames: int) -> None:
        self.frames, self.read = frames, list[int]()

    def __len__(self) -> int:
        return self.frames

    def image(self, index: int) -> NDArray[np.uint8]:
        self.read.append(index)
        return np.full((*self.size, 3), 60 + index, np.uint8)

    def time_s(self, index: int) -> float:
        return index / 25.0


def network(settings: VdaSettings = SMALL) -> VideoDepthAnything:
    torch.manual_seed(0)
    return VideoDepthAnything(settings).eval()


def test_frames_are_read_once_and_results_come_before_the_end() -> None:
    clip = Counted(80)
    estimates = vda_system(network(), name="small", metric=False, input_size=28).estimate(clip)
    next(estimates)
    assert clip.read == list(range(32))
    given = 1
    for estimate in estimates:
        given += 1
        assert len(clip.read) - given <= 32
        assert estimate.values.shape == clip.size
    assert given == 80
    assert clip.read == list(range(80))


def test_a_clip_of_one_frame_gives_one_map() -> None:
    assert len(list(vda_system(network(), name="small", metric=False, input_size=28).estimate(Counted(1)))) == 1


def test_metric_weights_say_metres() -> None:
    info = vda_system(network(), name="small", metric=True).info
    assert (info.quantity, info.scale, info.unit, info.cameras) == ("depth", "metric", "m", False)


def test_a_network_for_shorter_windows_is_refused() -> None:
    with pytest.raises(SettingsError, match="windows have 32 frames, the network knows places for 16"):
        vda_system(network(SMALL.model_copy(update={"frames": 16})), name="small", metric=False)


def test_a_fresh_temporal_module_is_the_identity_and_a_trained_one_looks_along_time_only() -> None:
    torch.manual_seed(0)
    module = TemporalModule(8, heads=2, groups=4, frames=6)
    maps = torch.rand(2, 5, 8, 3, 4)
    torch.testing.assert_close(module(maps), maps)
    torch.nn.init.normal_(module.temporal_transformer.proj_out.weight)
    changed = maps.clone()
    changed[0, 2] += torch.randn(8, 1, 1)  # a shift of every channel, which GroupNorm does not take out
    moved = (module(changed) - module(maps)).abs().amax((2, 3, 4))
    assert (moved[0] > 1e-4).all()  # every frame of the clip sees it
    assert moved[1].max() == 0  # the other clip does not
    with pytest.raises(GeometryError, match="a window of 7 frames is longer than the 6 that were learnt"):
        module(torch.rand(1, 7, 8, 2, 2))


def test_the_position_table_is_sines_and_cosines() -> None:
    table = sinusoids(5, 6)
    for t in range(5):
        for k in range(3):
            angle = t * 10000 ** (-2 * k / 6)
            assert table[t, 2 * k].item() == pytest.approx(np.sin(angle), abs=1e-6)
            assert table[t, 2 * k + 1].item() == pytest.approx(np.cos(angle), abs=1e-6)


@pytest.mark.parametrize(
    ("frame", "side", "expected"),
    [
        ((1024, 1280), 518, (518, 644)),  # published table
        ((288, 720), 518, (364, 910)),  # longer than 16:9: the side is lowered
        ((720, 288), 518, (910, 364)),
        ((300, 300), 224, (224, 224)),
    ],
)
def test_the_shorter_side_becomes_what_was_asked_for(
    frame: tuple[int, int], side: int, expected: tuple[int, int]
) -> None:
    assert network_size(frame, side) == expected


def test_a_ribbon_of_a_frame_is_refused() -> None:
    with pytest.raises(ClipError, match="frames of 10x2000 at side 518 leave less than one patch"):
        network_size((10, 2000), 518)
