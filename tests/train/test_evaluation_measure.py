"""One system on one sequence: what is measured, and what becomes of frames that cannot be."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_sequences import MadeSequence

from bathyscope.camera import invert_pose
from bathyscope.errors import DatasetError, GeometryError, SettingsError
from bathyscope_train.evaluation.estimates import ArrayEstimates
from bathyscope_train.evaluation.frame_pixels import FrameValues, Scene, frame_pixels
from bathyscope_train.evaluation.frame_rows import Status
from bathyscope_train.evaluation.measure import MEASURED, measure
from bathyscope_train.evaluation.protocols import COMPATIBLE, PROTOCOLS, Protocol, Quirk, changed, named_protocol
from bathyscope_train.evaluation.resampling import depth_at

PAPER = named_protocol("paper")
H, W, T = 12, 16, 5


def depth(frames: int = T) -> np.ndarray:
    """Whole numbers of millimetres that rise to the right and from frame to frame."""
    return (40 + 5 * np.arange(frames)[:, None, None] + 3 * np.arange(W) + np.zeros((frames, H, 1))).astype(np.float32)


def test_a_prediction_right_up_to_scale_is_perfect() -> None:
    found = measure(MadeSequence(depth()), ArrayEstimates(depth() / 7), PAPER)
    assert found.alignment is not None
    assert found.alignment.scale == pytest.approx(7, rel=1e-6)
    assert [row.abs_rel for row in found.rows] == pytest.approx([0] * T, abs=1e-6)
    assert {row.delta1 for row in found.rows} == {1.0}


def test_one_scale_for_the_sequence_makes_drift_cost_and_one_for_each_frame_does_not() -> None:
    drifting = depth() * np.linspace(1, 1.4, T)[:, None, None].astype(np.float32)
    whole = measure(MadeSequence(depth()), ArrayEstimates(drifting), PAPER)
    single = measure(MadeSequence(depth()), ArrayEstimates(drifting), replace(PAPER, per="frame"))
    assert min(row.abs_rel for row in whole.rows[:1]) > 0.05
    assert max(row.abs_rel for row in single.rows) < 1e-6
    assert single.alignment is None
    assert [row.scale for row in single.rows] == pytest.approx(1 / np.linspace(1, 1.4, T), rel=1e-6)


@pytest.mark.parametrize("name", list(PROTOCOLS))
def test_every_protocol_calls_the_truth_itself_perfect(name: str) -> None:
    found = measure(MadeSequence(depth()), ArrayEstimates(1 / depth(), "disparity"), named_protocol(name))
    assert [row.rmse for row in found.rows] == pytest.approx([0] * T, abs=1e-3)


def test_frames_without_truth_are_named_and_do_not_poison_anything() -> None:
    truth = depth()
    truth[2] = 0
    found = measure(MadeSequence(truth), ArrayEstimates(depth()), PAPER)
    assert [row.status for row in found.rows].count(Status.NO_TRUTH) == 1
    assert found.rows[2].status is Status.NO_TRUTH
    assert found.outcome == MEASURED
    assert np.isnan(found.rows[2].abs_rel)
    assert np.isnan(found.rows[2].coverage)


def test_an_all_invalid_sequence_says_so_and_has_no_number() -> None:
    found = measure(MadeSequence(np.zeros((T, H, W))), ArrayEstimates(depth()), PAPER)
    assert found.outcome.startswith("cannot be aligned")
    assert "at least one value" in found.outcome
    assert {row.status for row in found.rows} == {Status.NO_TRUTH}


def test_truth_that_cannot_be_read_is_named_in_its_row() -> None:
    found = measure(MadeSequence(depth(), unreadable=frozenset({3})), ArrayEstimates(depth()), PAPER)
    assert found.rows[3].status is Status.UNREADABLE
    assert "0003.png: not a readable image" in found.rows[3].note
    assert sum(row.status is Status.MEASURED for row in found.rows) == T - 1


def test_a_frame_without_any_prediction_is_named() -> None:
    valid = np.ones((T, H, W), np.bool_)
    valid[1] = False
    found = measure(MadeSequence(depth()), ArrayEstimates(depth(), valid=valid), PAPER)
    assert found.rows[1].status is Status.NO_PREDICTION
    assert found.rows[1].coverage == 0.0


def test_holes_are_left_out_and_counted_or_clipped_when_asked() -> None:
    valid = np.ones((T, H, W), np.bool_)
    valid[:, :, : W // 4] = False
    sequence = MadeSequence(depth(), depth_range=(1e-3, 150.0))
    sound = measure(sequence, ArrayEstimates(depth(), valid=valid), PAPER)
    assert [row.coverage for row in sound.rows] == [0.75] * T
    assert sound.rows[0].abs_rel == pytest.approx(0, abs=1e-6)
    quirky = measure(sequence, ArrayEstimates(depth(), valid=valid), named_protocol("paper", ["holes-clipped"]))
    g = depth()[0][:, : W // 4].astype(float)
    rest = 0.75 * np.log(quirky.rows[0].scale) ** 2
    assert quirky.rows[0].coverage == 1.0
    assert quirky.rows[0].rmse_log == pytest.approx(np.sqrt(np.mean(np.log(g / 1e-3) ** 2) / 4 + rest), rel=1e-5)


def test_frames_that_a_system_lost_are_an_error() -> None:
    with pytest.raises(DatasetError, match="5 frames have 4 predictions"):
        measure(MadeSequence(depth()), ArrayEstimates(depth(4)), PAPER)


def test_truth_in_centimetres_and_metres_is_measured_in_millimetres() -> None:
    noisy = depth() * np.random.default_rng(0).uniform(0.8, 1.2, depth().shape).astype(np.float32)
    results = [
        measure(MadeSequence((depth() / factor).astype(np.float32), depth_unit=unit), ArrayEstimates(noisy), PAPER)
        for unit, factor in (("mm", 1), ("cm", 10), ("m", 1000))
    ]
    assert {part.unit for part in results} == {"mm"}
    assert results[1].rows[0].rmse == pytest.approx(results[0].rows[0].rmse, rel=1e-5)
    assert results[2].rows[0].sq_rel == pytest.approx(results[0].rows[0].sq_rel, rel=1e-4)


def test_arbitrary_units_stay_and_caps_in_millimetres_are_refused_for_them() -> None:
    sequence = MadeSequence(depth(), depth_unit="arbitrary")
    assert measure(sequence, ArrayEstimates(depth()), PAPER).unit == "arbitrary"
    with pytest.raises(DatasetError, match="it is arbitrary"):
        measure(sequence, ArrayEstimates(depth()), replace(PAPER, caps_mm=(1e-3, 150.0)))


def test_truth_counts_strictly_inside_the_caps_and_predictions_are_clipped_to_them() -> None:
    truth = np.array([[[50.0, 100.0, 120.0, 80.0]]], np.float32)
    predicted = np.array([[[50.0, 1.0, 1.0, 300.0]]], np.float32)
    protocol = replace(PAPER, alignment="none", caps_mm=(1e-3, 100.0))
    row = measure(MadeSequence(truth), ArrayEstimates(predicted), protocol).rows[0]
    assert (row.pixels, row.truth_share) == (2, 0.5)
    assert row.abs_rel == pytest.approx((100 - 80) / 80 / 2)


def test_a_choice_of_frames_is_aligned_by_itself() -> None:
    drifting = depth() * np.linspace(1, 1.4, T)[:, None, None].astype(np.float32)
    first = np.arange(T) == 0
    sequence = MadeSequence(depth(), groups={"keyframes": first})
    found = measure(sequence, ArrayEstimates(drifting), PAPER, group="keyframes")
    assert [row.index for row in found.rows] == [0]
    assert found.rows[0].abs_rel == pytest.approx(0, abs=1e-6)


def test_temporal_errors_use_poses_in_the_unit_of_depth() -> None:
    """A wall approached by 5 mm a frame; poses in metres."""
    poses = np.tile(np.eye(4), (T, 1, 1))
    poses[:, 2, 3] = 0.005 * np.arange(T)
    wall = np.stack([np.full((H, W), 100.0 - 5 * t) for t in range(T)]).astype(np.float32)
    k = np.array([[20.0, 0, W / 2], [0, 20.0, H / 2], [0, 0, 1]])
    sequence = MadeSequence(wall, pose_unit="m", world_from_camera=poses, intrinsics=k)
    rows = measure(sequence, ArrayEstimates(wall / 3), PAPER).rows
    assert [row.tae for row in rows[:-1]] == pytest.approx([0] * (T - 1), abs=1e-4)
    assert np.isnan(rows[-1].tae)
    assert np.isnan([rows[0].flicker, rows[-1].flicker]).all()
    assert rows[1].flicker == pytest.approx(rows[1].true_flicker, rel=1e-3)
    backwards = replace(sequence, world_from_camera=np.stack([invert_pose(pose) for pose in poses]))
    assert measure(backwards, ArrayEstimates(wall / 3), PAPER).rows[0].tae > 5


@pytest.mark.parametrize("order", ["as_given", "disparity"])
def test_disparity_is_resized_before_it_is_inverted(order: str) -> None:
    disparity = np.random.default_rng(0).uniform(0.1, 1, (6, 8)).astype(np.float32)
    found, valid = depth_at(disparity, np.ones((6, 8), np.bool_), "disparity", (H, W), order)  # type: ignore[arg-type]
    assert valid.all()
    assert found == pytest.approx(1 / cv2.resize(disparity, (W, H), interpolation=cv2.INTER_LINEAR), rel=1e-6)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.sampled_from(["as_given", "disparity", "depth"]))
def test_pixels_that_are_not_valid_never_leak_into_others(seed: int, order: str) -> None:
    rng = np.random.default_rng(seed)
    valid = rng.random((6, 8)) < 0.7
    values = np.where(valid, 5.0, 1e6).astype(np.float32)
    found, keep = depth_at(values, valid, "depth", (15, 21), order)  # type: ignore[arg-type]
    assert found[keep] == pytest.approx(5.0, rel=1e-5)
    assert (found[~keep] == 0).all()


def test_negative_depth_must_be_marked_as_not_valid() -> None:
    with pytest.raises(GeometryError, match="negative"):
        depth_at(np.full((2, 2), -1, np.float32), np.ones((2, 2), np.bool_), "depth", (4, 4), "as_given")


def test_a_protocol_says_in_words_what_it_does() -> None:
    words = " ".join(named_protocol("endodav", ["endodav"]).words())
    for text in ("robust scale and shift", "one pool", "last-point", "fx = 0.82 W", "clipped to them"):
        assert text in words


def test_equal_hashes_mean_equal_protocols() -> None:
    hashes = {protocol.hash for protocol in PROTOCOLS.values()}
    hashes |= {named_protocol(name, [name]).hash for name in COMPATIBLE}
    assert len(hashes) == len(PROTOCOLS) + len(COMPATIBLE)
    assert named_protocol("paper").hash == PAPER.hash


@pytest.mark.parametrize(
    ("name", "compat", "says"),
    [("papper", (), "no protocol"), ("paper", ("vdb",), "no such evaluator"), ("vda", ("holes-clipped",), "a hole")],
)
def test_unknown_names_are_refused_with_those_that_are_known(name: str, compat: tuple[str, ...], says: str) -> None:
    with pytest.raises(SettingsError, match=says):
        named_protocol(name, compat)


def test_quirks_only_happen_when_asked_for() -> None:
    assert all(protocol.quirks == frozenset() for protocol in PROTOCOLS.values())
    assert named_protocol("paper", ["unguarded"]).quirks == {Quirk.UNGUARDED}
    assert isinstance(named_protocol("paper"), Protocol)


def test_a_changed_protocol_says_so_in_its_name_and_hash() -> None:
    found = changed(PAPER, ["per=frame", "caps=1:100", "crop=published"])
    assert (found.per, found.caps_mm, found.crop) == ("frame", (1.0, 100.0), True)
    assert found.name == "paper per=frame caps=1:100 crop=published"
    assert "for each frame" in found.words()[1]
    assert found.hash != PAPER.hash
    assert changed(PAPER, []) == PAPER


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("scale=1", "no such field"),
        ("per=clip", "per is one of sequence, frame"),
        ("caps=9", "LOW:HIGH"),
        ("caps=9:1", "low"),
    ],
)
def test_changes_that_mean_nothing_are_refused(change: str, says: str) -> None:
    with pytest.raises(SettingsError, match=says):
        changed(PAPER, [change])


def test_metric_depth_in_metres_is_measured_in_millimetres_without_an_alignment() -> None:
    values = FrameValues(depth()[0] / 1000, np.ones((H, W), np.bool_), "depth", millimetres=1000.0)
    protocol = changed(PAPER, ["alignment=none"])
    scene = Scene.of(MadeSequence(depth()), protocol)
    assert frame_pixels(depth()[0], values, scene, protocol).depth == pytest.approx(depth()[0], rel=1e-6)
