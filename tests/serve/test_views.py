"""Which Gaussians show a frame, and what comes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bathyscope.camera import Similarity
from bathyscope.model_spec import SceneSpec
from bathyscope.scene import Cameras, frame_gaussians
from bathyscope.splat import prepare
from bathyscope_serve.placed import FrameScene, PlacedFrame, WindowScene
from bathyscope_serve.views import Views

SIZE = (14, 16)
SPEC = SceneSpec(pixel_centre=0.5, focal_epsilon=0, activation="footprint", sh_degree=0, voxel_size=None)
EVERYWHERE = np.ones(SIZE, np.bool_)


def wall(index: int, depth: float = 1.0, *, key: bool = True, opacity: float = 0.0, segment: int = 0) -> PlacedFrame:
    """A camera that stands still says how far a wall is."""
    raw = np.zeros((12, *SIZE), np.float32)
    raw[0], raw[1:4] = opacity, 0.5
    return PlacedFrame(
        index=index,
        timestamp_s=index / 25,
        depth=np.full(SIZE, depth, np.float32),
        confidence=np.full(SIZE, 10.0, np.float32),
        known=EVERYWHERE,
        world_from_camera=np.eye(4),
        intrinsics=np.array([[15.0, 0, 8], [0, 15, 7], [0, 0, 1]]),
        key=key,
        scene=FrameScene(np.full((3, *SIZE), 0.5, np.float32), raw),
        segment=segment,
    )


def shown(views: Views, frames: list[PlacedFrame], step: int | None = None) -> dict[int, PlacedFrame]:
    """All frames, added ``step`` at a time."""
    step = step or len(frames)
    out = [frame for start in range(0, len(frames), step) for frame in views.add(frames[start : start + step])]
    out += views.finish()
    assert [frame.index for frame in out] == [frame.index for frame in frames]
    return {frame.index: frame for frame in out}


def middle(frame: PlacedFrame) -> float:
    return float(frame.depth[7, 8])


def test_a_frame_is_shown_by_itself_its_neighbours_and_keys_on_both_sides() -> None:
    """One frame at a time says another distance: it is felt where it belongs to the set, and nowhere else."""
    felt = set()
    for odd in range(61):
        frames = [wall(i, 0.8 if i == odd else 1.0, key=i % 5 == 0) for i in range(61)]
        if middle(shown(Views(SPEC, inside=EVERYWHERE), frames)[32]) < 0.999:
            felt.add(odd)
    assert felt == {30, 31, 32, 33, 15, 20, 25, 35, 40, 45}


def test_what_is_shown_does_not_depend_on_how_the_frames_came() -> None:
    rng = np.random.default_rng(3)
    frames = [wall(i, float(rng.uniform(1, 1.2)), key=i % 4 == 0) for i in range(70)]
    at_once, in_parts = (shown(Views(SPEC, inside=EVERYWHERE), frames, step) for step in (70, 9))
    for index in range(14, 56):
        np.testing.assert_array_equal(at_once[index].depth, in_parts[index].depth)


def test_segments_do_not_see_each_other() -> None:
    frames = [wall(i, 1.0 if i < 5 else 3.0, segment=int(i >= 5)) for i in range(10)]
    out = shown(Views(SPEC, inside=EVERYWHERE), frames)
    assert [middle(out[i]) for i in range(10)] == pytest.approx([1.0] * 5 + [3.0] * 5, rel=1e-4)


def test_where_the_scene_is_thin_the_frame_speaks_for_itself_with_less_confidence() -> None:
    frames = [wall(i, 1.0 + 0.1 * i, opacity=-9.0) for i in range(3)]
    out = shown(Views(SPEC, inside=EVERYWHERE), frames)
    assert [middle(out[i]) for i in range(3)] == pytest.approx([1.0, 1.1, 1.2])
    assert all(float(frame.confidence.max()) < 0.2 for frame in out.values())


def test_accumulated_depth_is_left_thin() -> None:
    frames = [wall(i, opacity=-3.0) for i in range(3)]
    accumulated = middle(shown(Views(SPEC, inside=EVERYWHERE, depth="accumulated"), frames)[1])
    assert 0 < accumulated < 0.95


def test_head_depth_goes_through_as_it_is() -> None:
    frames = [replace(wall(i, 1.0 + i), scene=None) for i in range(4)]
    assert Views(SPEC, inside=EVERYWHERE, depth="head").add(frames) == frames


def test_fused_gaussians_are_seen_from_their_own_window_in_the_unit_of_the_result() -> None:
    """The window's wall is at 1; its world grows twice, then three times, and turns, on the way to the result."""
    own = wall(4)
    assert isinstance(own.scene, FrameScene)
    camera = Cameras(own.world_from_camera[None], own.intrinsics[None])
    gaussians = frame_gaussians(own.scene.raw, own.depth, own.scene.image, camera, SPEC, inside=EVERYWHERE)
    placed = replace(own, scene=WindowScene(prepare(gaussians), np.eye(4)))
    for scale in (2.0, 3.0):
        placed = placed.moved(Similarity(scale, np.diag([-1.0, -1, 1]), np.array([1.0, 2, 3])), 0)
    fused = SPEC.model_copy(update={"activation": "anysplat"})
    (seen,) = Views(fused, inside=EVERYWHERE).add([placed])
    np.testing.assert_allclose(seen.depth, 6.0, rtol=1e-4)
