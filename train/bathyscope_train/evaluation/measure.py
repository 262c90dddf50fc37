"""One system on one sequence under one protocol: numbers for every frame.

Two kinds of pass over the frames are made: one or two to fit the alignment, and one to measure. Each holds one frame
and the next, which is read meanwhile; where neighbours are compared, also the two before. What goes wrong with a
frame is written into its row, never left out.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from bathyscope.errors import DatasetError, GeometryError
from bathyscope_train.evaluation.binned import BinnedErrors
from bathyscope_train.evaluation.depth_alignment import Alignment, Pixels, fit_alignment
from bathyscope_train.evaluation.estimates import Estimates
from bathyscope_train.evaluation.example import Example, make_example
from bathyscope_train.evaluation.frame_pixels import FramePixels, Scene, frame_pixels
from bathyscope_train.evaluation.frame_rows import FrameRow, Status
from bathyscope_train.evaluation.metrics import depth_errors
from bathyscope_train.evaluation.neighbours import AlignedFrame, Neighbours
from bathyscope_train.evaluation.protocols import Protocol
from bathyscope_train.evaluation.sequences import EvaluationSequence

MEASURED = "measured"
Progress = Callable[[int], None]
"""Told how many frames have been measured."""


@dataclass(frozen=True)
class Measurement:
    """Everything that was measured on one sequence."""

    rows: tuple[FrameRow, ...]
    unit: str
    """Of errors that have one: ``mm`` or ``arbitrary``."""
    caps: tuple[float, float]
    alignment: Alignment | None
    """The sequence's; ``None`` where each frame has its own, or nothing could be measured."""
    outcome: str
    """``measured``, or why there is no number."""
    by_depth: BinnedErrors
    example: Example | None
    """A frame from the middle, the same for every system."""


class _Frames:
    """Frames of a sequence with their predictions, read again for each pass; reasons of bad ones are kept."""

    def __init__(
        self, sequence: EvaluationSequence, estimates: Estimates, protocol: Protocol, chosen: Sequence[int]
    ) -> None:
        if len(estimates) != len(sequence.frame_names):
            raise DatasetError(
                f"{sequence.name}: {len(sequence.frame_names)} frames have {len(estimates)} predictions; "
                "was the data set changed after predicting?"
            )
        self.sequence, self.estimates, self.protocol, self.chosen = sequence, estimates, protocol, chosen
        self.scene = Scene.of(sequence, protocol)
        self.unreadable: dict[int, str] = {}

    def load(self, index: int) -> FramePixels | None:
        """``None`` for a frame whose truth cannot be read."""
        try:
            true = self.sequence.truth(index)
        except DatasetError as error:
            self.unreadable[index] = str(error)
            return None
        return frame_pixels(true, self.estimates.read(index), self.scene, self.protocol)

    def ahead(self) -> Iterator[FramePixels | None]:
        """Every chosen frame in order; the next one is read while the caller works on this one."""
        with ThreadPoolExecutor(1) as reader:
            coming: deque[Future[FramePixels | None]] = deque()
            for index in self.chosen:
                coming.append(reader.submit(self.load, index))
                if len(coming) > 1:
                    yield coming.popleft().result()
            while coming:
                yield coming.popleft().result()

    def pairs(self) -> Iterator[Pixels]:
        """Pixels of every frame that has any."""
        for pixels in self.ahead():
            if pixels is not None and pixels.used.any():
                yield pixels.pairs()


def measure(
    sequence: EvaluationSequence,
    estimates: Estimates,
    protocol: Protocol,
    *,
    group: str | None = None,
    progress: Progress = lambda _: None,
) -> Measurement:
    """Measure one sequence.

    Args:
        sequence: The truth.
        estimates: Predictions for all of its frames.
        protocol: How.
        group: Name of the sequence's choice of frames to use; all frames unless given. Frames outside are as if they
            had no truth: they take no part in the alignment either.
        progress: Told after every frame of the last pass.

    Raises:
        DatasetError: If the numbers of frames differ, or the protocol's caps cannot be applied.
    """
    count = len(sequence.frame_names)
    chosen = range(count) if group is None else np.flatnonzero(sequence.groups[group]).tolist()
    frames = _Frames(sequence, estimates, protocol, chosen)
    alignment, outcome = _sequence_alignment(frames)
    by_depth = BinnedErrors.empty()
    neighbours = Neighbours(sequence, protocol, frames.scene) if group is None else None
    rows: list[FrameRow] = []
    example: Example | None = None
    for done, (index, pixels) in enumerate(zip(chosen, frames.ahead(), strict=True), 1):
        row, aligned = _measure_frame(frames, index, pixels, alignment, by_depth)
        rows.append(row)
        if neighbours is not None:
            neighbours.add(rows, aligned)
        if example is None and 2 * done >= len(chosen) and aligned is not None and aligned.counts.any():
            example = _example(sequence, aligned)
        progress(done)
    if outcome == MEASURED and not any(row.status is Status.MEASURED for row in rows):
        outcome = "no frame could be measured: " + reasons(rows)
    caps = (frames.scene.caps.low, frames.scene.caps.high)
    return Measurement(tuple(rows), frames.scene.unit, caps, alignment, outcome, by_depth, example)


def reasons(rows: Sequence[FrameRow]) -> str:
    """How many frames have no numbers, by reason: ``3 no truth, 1 truth unreadable``; empty if all have."""
    counts = Counter(row.status.value for row in rows if row.status is not Status.MEASURED)
    return ", ".join(f"{count} {reason}" for reason, count in counts.items())


def _sequence_alignment(frames: _Frames) -> tuple[Alignment | None, str]:
    if frames.protocol.per == "frame":
        return None, MEASURED
    try:
        return fit_alignment(frames.protocol.alignment, frames.pairs), MEASURED
    except GeometryError as error:
        return None, f"cannot be aligned: {error}"


def _measure_frame(
    frames: _Frames, index: int, pixels: FramePixels | None, alignment: Alignment | None, by_depth: BinnedErrors
) -> tuple[FrameRow, AlignedFrame | None]:
    name = frames.sequence.frame_names[index]
    if pixels is None:
        return FrameRow(index, name, Status.UNREADABLE, note=frames.unreadable[index]), None
    share = float(pixels.counts.mean())
    g, p = pixels.pairs()
    if alignment is None and len(g):
        if frames.protocol.per == "sequence":
            return FrameRow(index, name, Status.NOT_ALIGNED, share, note="the sequence cannot be aligned"), None
        try:
            alignment = fit_alignment(frames.protocol.alignment, lambda: [(g, p)])
        except GeometryError as error:
            return FrameRow(index, name, Status.NOT_ALIGNED, share, note=str(error)), None
    aligned = None if alignment is None else _aligned(frames, index, pixels, alignment)
    if len(g) == 0 or alignment is None:
        status = Status.NO_PREDICTION if share > 0 else Status.NO_TRUTH
        return FrameRow(index, name, status, share, coverage=pixels.coverage), aligned
    q = frames.scene.caps.clip(alignment.depth(p))
    by_depth.add(g, q)
    errors = depth_errors(g, q)
    return FrameRow(
        index=index,
        frame=name,
        status=Status.MEASURED,
        truth_share=share,
        pixels=len(g),
        coverage=pixels.coverage,
        scale=alignment.scale,
        shift=alignment.shift,
        abs_rel=errors.abs_rel,
        sq_rel=errors.sq_rel,
        rmse=errors.rmse,
        rmse_log=errors.rmse_log,
        delta1=errors.delta1,
        delta2=errors.delta2,
        delta3=errors.delta3,
    ), aligned


def _aligned(frames: _Frames, index: int, pixels: FramePixels, alignment: Alignment) -> AlignedFrame:
    depth = frames.scene.caps.clip(alignment.depth(pixels.depth)).astype(np.float32)
    return AlignedFrame(index, depth, pixels.predicted & np.isfinite(depth), pixels.true, pixels.counts)


def _example(sequence: EvaluationSequence, aligned: AlignedFrame) -> Example | None:
    try:
        image = sequence.image(aligned.index)
    except DatasetError:
        return None
    return make_example(
        aligned.index,
        image,
        np.where(aligned.counts, aligned.true, np.float32(0)),
        np.where(aligned.predicted, aligned.depth, np.float32(0)),
    )
