"""What the first process reports while a run goes on: means of steps, pictures, and measurements on held-out clips."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import asdict

import cv2
import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import TrainingError
from bathyscope_train.consistency.journal import Journal
from bathyscope_train.consistency.scores import Scores, mean_scores, score_network
from bathyscope_train.consistency.settings import ConsistencySettings
from bathyscope_train.model.network import Network
from bathyscope_train.pretrain import held_out_clips
from bathyscope_train.validation import validate

PICTURES_FOLDER = "pictures"

_log = logging.getLogger(__name__)


class Reports:
    """Files and lines about one run.

    Args:
        settings: Of the run.
        start: Step to go on with.
        recent: Numbers of steps before it that no line has told yet.

    Raises:
        DatasetError: If a validation folder holds no clips.
    """

    def __init__(
        self, settings: ConsistencySettings, *, start: int, recent: list[dict[str, float]] | None = None
    ) -> None:
        self.settings = settings
        self.held_out = [held_out_clips(path, settings.validation_clips) for path in settings.validation]
        self.journal = Journal(settings.out, steps=settings.steps, start=start, tensorboard=settings.tensorboard)
        self.recent = list(recent or [])

    def tell(self, step: int, values: Mapping[str, float]) -> None:
        """The numbers of one more step; every few steps a line with their means."""
        self.recent.append(dict(values))
        if step % self.settings.log_every and step != self.settings.steps:
            return
        means = mean_numbers(self.recent)
        self.recent.clear()
        speed = self.journal.progress(step, means, self.settings.batch)
        self.journal.numbers(step, {**{name: round(value, 7) for name, value in means.items()}, **speed})

    def picture(self, step: int, grid: NDArray[np.uint8]) -> None:
        """Keep an RGB picture (h, w, 3).

        Raises:
            TrainingError: If it cannot be written.
        """
        folder = self.settings.out / PICTURES_FOLDER
        folder.mkdir(exist_ok=True)
        if not cv2.imwrite(str(folder / f"step-{step:07d}.png"), np.ascontiguousarray(grid[..., ::-1])):
            raise TrainingError(f"{folder}: a picture cannot be written; the last checkpoint is whole")
        self.journal.picture(step, "clip", grid)

    def validate(self, step: int, network: Network) -> None:
        """Measure a network, on the CPU, on the held-out clips: its heads and cameras, and the rendered depth."""
        frames = self.settings.window.frames
        for folder, clips in zip(self.settings.validation, self.held_out, strict=True):
            heads, _ = validate(network, clips, frames=frames)
            scores = score_network(network, clips, frames=frames)
            full, central = mean_scores([each.full for each in scores]), mean_scores([each.central for each in scores])
            numbers = {**json.loads(heads.as_json()), **_named(full, ""), **_named(central, "_central")}
            self.journal.numbers(step, numbers, group=folder.name)
            _log.info(
                "step %d, %s: AbsRel rendered %.4f (central %.4f), head %.4f, flicker %.2f %%",
                step,
                folder.name,
                full.abs_rel,
                central.abs_rel,
                heads.abs_rel,
                full.flicker,
            )
        self.journal.restart_clock(step)

    def close(self) -> None:
        """Write what is left."""
        self.journal.close()


def mean_numbers(steps: list[dict[str, float]]) -> dict[str, float]:
    """Mean of every number over the steps that have it, in the order of the last step."""
    means = {}
    for name in steps[-1]:
        known = [each[name] for each in steps if name in each]
        means[name] = sum(known) / len(known)
    return means


def _named(scores: Scores, ending: str) -> dict[str, float]:
    return {f"rendered_{name}{ending}": round(value, 6) for name, value in asdict(scores).items()}
