"""Rendered clips, written to disk by one side and read by the other, are still exact."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bathyscope_train.data.synthetic import DOMAINS, render_clip, write_dataset_folder
from bathyscope_train.evaluation.folders import DatasetFolder


def test_a_rendered_clip_comes_back_from_its_folder(tmp_path: Path) -> None:
    clip = render_clip(3, next(iter(DOMAINS.values())), frames=2, size=(56, 70))
    write_dataset_folder(clip, tmp_path / "clip")
    folder = DatasetFolder.open(tmp_path / "clip")
    assert len(folder.frames) == 2
    np.testing.assert_allclose(folder.world_from_camera, clip.world_from_camera, atol=1e-9)
    assert folder.calibration.fx == clip.intrinsics[0, 0]
    for t in range(2):
        np.testing.assert_array_equal(folder.image(t), clip.frames[t])
        known = folder.truth.at(t)
        assert len(known.depth) > 0.3 * 56 * 70
        exact = clip.depth[t][known.rows, known.columns]
        assert np.abs(known.depth - exact).max() <= np.ceil(clip.depth.max()) / 65535
