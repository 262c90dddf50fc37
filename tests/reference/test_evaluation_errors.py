"""Depth errors against the golden numbers (``evaluation/errors*.npz`` and ``.json``)."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest

from bathyscope_train.evaluation.metrics import depth_errors

REFERENCE = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference"))
FILES = sorted((REFERENCE / "evaluation").glob("errors*.npz"))
NAMES = {"abs_rel": "abs_rel", "sq_rel": "sq_rel", "rmse": "rmse", "rmse_log": "rmse_log"}
NAMES |= {"a1": "delta1", "a2": "delta2", "a3": "delta3"}

pytestmark = pytest.mark.skipif(not FILES, reason=f"no evaluation/errors*.npz under {REFERENCE}")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_errors_are_the_golden_ones(path: Path) -> None:
    expected = json.loads(path.with_suffix(".json").read_text())
    with np.load(path) as arrays:
        cases = [key.removeprefix("gt") for key in arrays if re.fullmatch(r"gt\d+", key)]
        assert len(cases) == len(expected)
        for case in cases:
            found = depth_errors(arrays[f"gt{case}"], arrays[f"pred{case}"]).as_dict()
            for golden, name in NAMES.items():
                assert found[name] == pytest.approx(expected[f"case{case}"][golden], rel=1e-6), (case, name)
