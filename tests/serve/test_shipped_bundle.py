"""The bundle that ships: whole, small, exact, and useful on a clip it has never seen."""

from __future__ import annotations

from importlib.resources import files

import numpy as np
import pytest

from bathyscope.bundle import Bundle, shipped_bundle
from bathyscope.camera import rotation_angle
from bathyscope.engines import DepthOptions
from bathyscope_serve.engine import DepthEngine
from bathyscope_serve.refine import problem
from bathyscope_serve.refine.adjustment import adjust


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return Bundle.open(shipped_bundle())


def test_the_shipped_bundle_is_under_forty_megabytes_and_may_be_used_in_products(bundle: Bundle) -> None:
    assert sum(entry.bytes for entry in bundle.manifest.files.values()) < 40e6
    assert not bundle.manifest.research_only
    assert bundle.manifest.training["ground_truth"].startswith("exact, rendered")


def test_the_shipped_graphs_were_held_to_torch_within_the_limits_at_several_lengths_and_sizes(bundle: Bundle) -> None:
    parity = bundle.manifest.parity
    assert {record["frames"] for record in parity} >= {1, 4, 8}
    assert len({(record["height"], record["width"]) for record in parity}) >= 3
    assert max(record["depth"] for record in parity) <= 1e-4
    assert max(record["rotation"] for record in parity) <= 1e-5
    assert max(record["translation"] for record in parity) <= 1e-5


def test_the_lumen_of_the_demo_clip_is_far_and_its_wall_near(bundle: Bundle) -> None:
    """In the first ten frames the lumen lies right of the middle and the left edge is wall, close to the lens."""
    clip = files("bathyscope_client") / "assets" / "demo.mp4"
    engine = DepthEngine(bundle)
    result = engine.depth_of(str(clip), DepthOptions(max_frames=10))
    assert len(result) == 10
    assert set(result.segment) == {0}
    assert result.valid.mean() > 0.95
    h, w = result.size
    middle = result.depth[:, h // 3 : 3 * h // 4, w // 2 : 3 * w // 4]
    edge = result.depth[:, :, : w // 8]
    assert np.median(middle.max((1, 2))) > 2 * np.median(edge)
    np.testing.assert_array_equal(result.world_from_camera[0], np.eye(4))
    assert np.degrees(rotation_angle(result.world_from_camera[-1, :3, :3])) < 45
    assert result.meta.agreement is not None
    assert result.meta.agreement.difference < 0.15


def test_warming_up_compiles_the_adjustment_too(bundle: Bundle, monkeypatch: pytest.MonkeyPatch) -> None:
    adjusted = []
    monkeypatch.setattr(problem, "adjust", lambda *given: adjusted.append(given) or adjust(*given))
    DepthEngine(bundle).warm_up()
    assert adjusted
