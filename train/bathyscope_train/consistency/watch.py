"""Stops a run that has gone wrong while there is still a good checkpoint."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from bathyscope.errors import TrainingError
from bathyscope_train.consistency.clip_step import VARIATION
from bathyscope_train.consistency.settings import SafetySettings


@dataclass
class Watch:
    """What a run remembers to notice that depth collapses; travels in checkpoints."""

    settings: SafetySettings
    recent: deque[float] = field(default_factory=deque)
    skipped: int = 0

    def check_finite(self, step: int, values: Mapping[str, float], clips: Sequence[str]) -> None:
        """Look at the numbers of a step before anything follows from them.

        Raises:
            TrainingError: If one is not finite.
        """
        bad = [name for name, value in values.items() if not math.isfinite(value)]
        if bad:
            raise self.broken(step, f"{', '.join(bad)} not finite", clips)

    @staticmethod
    def broken(step: int, what: str, clips: Sequence[str]) -> TrainingError:
        """The error for numbers that cannot be gone on with, and what to try."""
        return TrainingError(
            f"step {step}: {what}, on {', '.join(clips)}. Try a smaller peak_lr, a smaller clip_norm or "
            "precision=float32; if it is always this clip, look at it, or leave it out. The last checkpoint is good"
        )

    def see(self, step: int, values: Mapping[str, float]) -> None:
        """Judge the numbers of a step that was taken.

        Raises:
            TrainingError: If depth has lost its variation over the last steps.
        """
        self.recent.append(values[VARIATION])
        while len(self.recent) > self.settings.steps:
            self.recent.popleft()
        mean = sum(self.recent) / len(self.recent)
        if len(self.recent) == self.settings.steps and mean < self.settings.least_variation:
            raise TrainingError(
                f"step {step}: depth collapses: within a frame it varies {mean:.0%} as much as before training "
                f"(limit {self.settings.least_variation:.0%}, mean of {self.settings.steps} steps). Try a smaller "
                "loss.temporal.weight or a later loss.temporal.start, loss.anchor.weight=0.05, a smaller peak_lr, or "
                "fewer steps"
            )

    def skip(self, step: int) -> None:
        """Count an update that was left out because its gradient was not finite.

        Raises:
            TrainingError: If there were too many in a row.
        """
        self.skipped += 1
        if self.skipped >= self.settings.skipped:
            raise TrainingError(
                f"step {step}: {self.skipped} updates in a row had gradients that are not finite. Try a smaller "
                "peak_lr or precision=float32"
            )

    def took_step(self) -> None:
        """An update was taken."""
        self.skipped = 0
