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
    return [
        *_first(line, protocol),
        published_text.mean_line(columns),
        published_text.interval_line(columns),
    ]


def _first(line: Line, protocol: Protocol) -> list[str]:
    """What was fitted, where the alignment is one that is printed."""
    records = [part.record.groups[line.group] for part in line.parts]
    if protocol.alignment == "scale_shift" and protocol.per == "sequence":
        return [published_text.shift_line([record.lengths for record in records if record.lengths is not None])]
    if protocol.alignment != "scale":
        return []
    if protocol.per == "frame":
        scales = [row.scale for part in line.parts for row in part.rows if not np.isnan(row.scale)]
    else:
        scales = [record.scale for record in records if record.scale is not None]
    return [published_text.scaling_line(scales)]
