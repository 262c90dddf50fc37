"""What the public evaluators would have printed, for those who compare logs; asked for by the quirk ``student-t``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bathyscope_train.evaluation import published_text
from bathyscope_train.evaluation.protocols import SEVEN_COLUMNS, Protocol
from bathyscope_train.evaluation.runs.records import ALL_FRAMES
from bathyscope_train.evaluation.runs.summary import Line


def published_lines(lines: Sequence[Line], protocol: Protocol) -> str:
    """The printed lines of every system on every data set: ratios, means over all frames, intervals."""
    blocks = [
        "\n".join([f"{line.system} on {line.dataset}", *_lines(line, protocol)])
        for line in lines
        if line.missing is None and line.group == ALL_FRAMES
    ]
    return "\n\n".join(blocks) + "\n"


def _lines(line: Line, protocol: Protocol) -> list[str]:
    errors = [np.concatenate([part.column(name) for part in line.parts]) for name in SEVEN_COLUMNS]
    columns = [column[~np.isnan(column)] for column in errors]
    if protocol.temporal == "endodav":
        pairs = [np.concatenate([part.column(name)[:-1] for part in line.parts]) for name in ("tae", "tas")]
        columns += [pair for pair in pairs if len(pair) and not np.isnan(pair).all()]
    ratios = _ratios(line, protocol)
    first = [published_text.scaling_line(ratios)] if ratios else []
    return [*first, published_text.mean_line(columns), published_text.interval_line(columns)]


def _ratios(line: Line, protocol: Protocol) -> list[float]:
    """The factors of frames or sequences, where the alignment is one factor."""
    if protocol.alignment != "scale":
        return []
    if protocol.per == "frame":
        return [row.scale for part in line.parts for row in part.rows if not np.isnan(row.scale)]
    scales = [part.record.groups[line.group].scale for part in line.parts]
    return [scale for scale in scales if scale is not None]
