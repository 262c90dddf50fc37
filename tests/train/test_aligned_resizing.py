"""Resizing with aligned corners, against PyTorch's."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from bathyscope.resizing import resize_corners


@pytest.mark.parametrize("size", [(5, 7), (13, 9), (3, 20), (1, 1), (8, 11)], ids=str)
@pytest.mark.parametrize("source", [(8, 11), (1, 4), (14, 14)], ids=str)
def test_corners_stay_where_they_are(source: tuple[int, int], size: tuple[int, int]) -> None:
    maps = np.random.default_rng(0).normal(size=(3, *source)).astype(np.float32)
    expected = F.interpolate(torch.from_numpy(maps)[None], size=size, mode="bilinear", align_corners=True)[0]
    observed = resize_corners(maps, size)
    assert observed.dtype == np.float32
    np.testing.assert_allclose(observed, expected.numpy(), atol=1e-5)
