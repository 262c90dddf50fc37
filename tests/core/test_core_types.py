"""Clips, scenes and results check that their arrays belong together."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from bathyscope.clip import Clip
from bathyscope.errors import BathyscopeError, ClipError, GeometryError, ServiceError
from bathyscope.gaussians import Gaussians, concatenate
from bathyscope.result import ARRAY_NAMES, ClipDepth, FrameDepth, ResultMeta


def scene(n: int = 4, k: int = 9, start: float = 0.0) -> Gaussians:
    numbers = np.arange(start, start + n, dtype=np.float32)
    return Gaussians(
        means=numbers[:, None] + np.zeros((n, 3), np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        scales=numbers[:, None] + np.ones((n, 3), np.float32),
        opacities=numbers / 100,
        harmonics=numbers[:, None, None] + np.zeros((n, k, 3), np.float32),
    )


def arrays(t: int = 3, h: int = 4, w: int = 5) -> dict[str, Any]:
    return {
        "depth": np.ones((t, h, w), np.float32),
        "confidence": np.ones((t, h, w), np.float32),
        "valid": np.ones((t, h, w), np.bool_),
        "world_from_camera": np.tile(np.eye(4), (t, 1, 1)),
        "intrinsics": np.tile(np.eye(3), (t, 1, 1)),
        "timestamps_s": np.arange(t) / 25,
        "segment": np.zeros(t, np.int32),
    }


def test_a_clip_knows_its_length_and_size() -> None:
    clip = Clip(np.zeros((3, 4, 5, 3), np.uint8), np.array([0.0, 0.04, 0.04]))
    assert (len(clip), clip.size) == (3, (4, 5))


@pytest.mark.parametrize(
    ("frames", "stamps", "message"),
    [
        (np.zeros((3, 4, 5, 3), np.float32), np.zeros(3), r"uint8 .*, got float32"),
        (np.zeros((3, 4, 5), np.uint8), np.zeros(3), r"got uint8 \(3, 4, 5\)"),
        (np.zeros((3, 4, 5, 4), np.uint8), np.zeros(3), r"\(3, 4, 5, 4\)"),
        (np.zeros((0, 4, 5, 3), np.uint8), np.zeros(0), "at least one frame"),
        (np.zeros((3, 0, 5, 3), np.uint8), np.zeros(3), "one pixel"),
        (np.zeros((3, 4, 5, 3), np.uint8), np.zeros(2), r"3 frames need as many time stamps, got \(2,\)"),
        (np.zeros((2, 4, 5, 3), np.uint8), np.array([1.0, 0.5]), "never decrease"),
        (np.zeros((2, 4, 5, 3), np.uint8), np.array([0.0, np.nan]), "finite"),
    ],
)
def test_a_clip_that_cannot_be_is_refused_by_name(frames: np.ndarray, stamps: np.ndarray, message: str) -> None:
    with pytest.raises(ClipError, match=f"colon: .*{message}"):
        Clip(frames, stamps, "colon")


@pytest.mark.parametrize(("k", "degree"), [(1, 0), (4, 1), (9, 2), (16, 3), (25, 4)])
def test_the_degree_follows_from_the_number_of_harmonics(k: int, degree: int) -> None:
    assert scene(k=k).degree == degree


@pytest.mark.parametrize("k", [0, 2, 8])
def test_a_number_of_harmonics_that_is_no_square_is_refused(k: int) -> None:
    with pytest.raises(GeometryError, match="harmonics"):
        scene(k=k)


@pytest.mark.parametrize("name", ["means", "rotations", "scales", "opacities", "harmonics"])
def test_gaussians_of_different_number_are_refused_by_name(name: str) -> None:
    parts = {field.name: getattr(scene(), field.name) for field in fields(Gaussians)}
    other = "means" if name != "means" else "rotations"
    with pytest.raises(GeometryError, match=name if name != "means" else other):
        Gaussians(**{**parts, name: parts[name][:2]})


def test_selection_keeps_the_parts_of_each_gaussian_together() -> None:
    chosen = scene().select(np.array([3, 1]))
    assert (chosen.means[:, 0].tolist(), chosen.harmonics[:, 0, 0].tolist()) == ([3, 1], [3, 1])
    assert len(scene().select(np.array([True, False, False, True]))) == 2
    assert len(scene().select(slice(1, None))) == 3


def test_scenes_are_joined_in_order() -> None:
    joined = concatenate([scene(2), scene(3, start=10)])
    assert joined.opacities.tolist() == pytest.approx([0, 0.01, 0.1, 0.11, 0.12])


@pytest.mark.parametrize("scenes", [[], [scene(k=1), scene(k=4)]], ids=["none", "degrees"])
def test_scenes_that_cannot_be_joined_are_refused(scenes: list[Gaussians]) -> None:
    with pytest.raises(GeometryError, match="one harmonics degree"):
        concatenate(scenes)


def test_a_result_made_of_frames_is_the_result_they_came_from() -> None:
    clip = ClipDepth(**arrays(), meta=ResultMeta())
    again = ClipDepth.from_frames([clip.frame(t) for t in range(len(clip))], clip.meta)
    for name in ARRAY_NAMES:
        np.testing.assert_array_equal(getattr(again, name), getattr(clip, name))
        assert getattr(again, name).dtype == getattr(clip, name).dtype
    assert (len(clip), clip.size) == (3, (4, 5))


@pytest.mark.parametrize("name", ARRAY_NAMES)
def test_arrays_of_a_result_that_do_not_belong_together_are_named(name: str) -> None:
    parts = arrays()
    parts[name] = parts[name][:2]
    with pytest.raises(GeometryError, match="confidence" if name == "depth" else name):
        ClipDepth(**parts, meta=ResultMeta())


def test_flat_depth_is_refused() -> None:
    with pytest.raises(GeometryError, match=r"\(t, h, w\), got shape \(4, 5\)"):
        ClipDepth(**{**arrays(), "depth": np.ones((4, 5))}, meta=ResultMeta())


def test_frames_of_different_size_make_no_result() -> None:
    first = ClipDepth(**arrays(), meta=ResultMeta()).frame(0)
    other = ClipDepth(**arrays(h=6), meta=ResultMeta()).frame(0)
    with pytest.raises(GeometryError, match="one size"):
        ClipDepth.from_frames([first, other], ResultMeta())
    with pytest.raises(GeometryError, match="at least one frame"):
        ClipDepth.from_frames([], ResultMeta())


def test_a_frame_is_a_view_of_its_clip() -> None:
    clip = ClipDepth(**arrays(), meta=ResultMeta())
    frame: FrameDepth = clip.frame(1)
    frame.depth[0, 0] = 7
    assert clip.depth[1, 0, 0] == 7


def test_every_error_is_a_bathyscope_error_and_a_service_error_carries_its_request() -> None:
    import bathyscope.errors as module

    kinds = [kind for kind in vars(module).values() if isinstance(kind, type)]
    assert all(issubclass(kind, BathyscopeError) for kind in kinds)
    assert all(kind.__name__ in (module.__doc__ or "") for kind in kinds)
    error = ServiceError("full", status=503, request_id="abc")
    assert (str(error), error.status, error.request_id) == ("full", 503, "abc")
