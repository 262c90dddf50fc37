"""What a run says: ``metrics.jsonl``, the terminal, and TensorBoard."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import SettingsError, TrainingError
from bathyscope_train.metrics_file import METRICS_FILE, drop_after

TENSORBOARD_FOLDER = "tensorboard"

_log = logging.getLogger(__name__)


class Journal:
    """Writes numbers and pictures of one run.

    Args:
        folder: Of the run.
        steps: Steps of the whole run, for the time that is left.
        start: Step to go on with; what an interrupted run wrote about this step and later ones is dropped.
        tensorboard: Whether to write event files.

    Raises:
        SettingsError: If TensorBoard is asked for and not installed.
        TrainingError: If the files cannot be written.
    """

    def __init__(self, folder: Path, *, steps: int, start: int = 0, tensorboard: bool = True) -> None:
        self.path, self.steps = folder / METRICS_FILE, steps
        self._since, self._at = time.monotonic(), start
        try:
            drop_after(self.path, start)
        except OSError as error:
            raise TrainingError(f"{self.path}: cannot be written ({error})") from error
        self._events = _event_writer(folder / TENSORBOARD_FOLDER, start) if tensorboard else None

    def numbers(self, step: int, values: Mapping[str, Any], *, group: str = "training") -> None:
        """A line of ``metrics.jsonl`` and scalars; ``group`` is training or the name of a validation folder."""
        line = {"step": step, **({} if group == "training" else {"validation": group}), **values}
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
        except OSError as error:
            raise TrainingError(f"{self.path}: cannot be written ({error}); the last checkpoint is whole") from error
        if self._events is not None:
            for name, value in values.items():
                if isinstance(value, int | float):
                    self._events.add_scalar(f"{group}/{name}", value, step)

    def progress(self, step: int, values: Mapping[str, float], clips: int) -> dict[str, float]:
        """A line on the terminal about the steps since the last one; returns their speed.

        Args:
            step: Steps done.
            values: Means over those steps.
            clips: Windows of one step, over all processes.
        """
        now = time.monotonic()
        each = (now - self._since) / max(step - self._at, 1)
        self._since, self._at = now, step
        shown = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
        _log.info(
            "step %d/%d  %s  %.2f s/step  %.2f clips/s  %s left",
            step,
            self.steps,
            shown,
            each,
            clips / max(each, 1e-9),
            spoken((self.steps - step) * each),
        )
        return {"seconds_per_step": round(each, 4), "clips_per_second": round(clips / max(each, 1e-9), 4)}

    def restart_clock(self, step: int) -> None:
        """Leave what took time until now, such as a validation, out of the speed."""
        self._since, self._at = time.monotonic(), step

    def picture(self, step: int, name: str, image: NDArray[np.uint8]) -> None:
        """An RGB picture (h, w, 3) for TensorBoard."""
        if self._events is not None:
            self._events.add_image(name, image, step, dataformats="HWC")

    def close(self) -> None:
        """Write what is left."""
        if self._events is not None:
            self._events.close()


def spoken(seconds: float) -> str:
    """A length of time for a person: ``3 h 05 min``, ``12 min`` or ``40 s``."""
    minutes = round(seconds / 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60:02d} min"
    return f"{minutes} min" if seconds >= 90 else f"{round(seconds)} s"


def _event_writer(folder: Path, start: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise SettingsError(
            "TensorBoard is not installed; set tensorboard=false, or install it: pip install tensorboard"
        ) from error
    return SummaryWriter(str(folder), purge_step=start or None)
