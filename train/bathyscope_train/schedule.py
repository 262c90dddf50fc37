"""What is a function of the progress of training: the learning rate, and which data are in use."""

import math
from collections.abc import Sequence

from bathyscope_train.config import SourceSettings


def learning_rate_factor(step: int, progress: float, *, warmup_steps: int, floor: float = 0.01) -> float:
    """Linear warm-up by steps, times a cosine from 1 to ``floor`` over the progress (0 to 1)."""
    warmup = min(1.0, (step + 1) / (warmup_steps + 1))
    cosine = 0.5 * (1 + math.cos(math.pi * min(max(progress, 0.0), 1.0)))
    return warmup * (floor + (1 - floor) * cosine)


def source_shares(sources: Sequence[SourceSettings], progress: float) -> list[float]:
    """Probability of each data folder at this progress."""
    weights = [source.share if progress >= source.start else 0.0 for source in sources]
    return [weight / sum(weights) for weight in weights]


def ema_decay(step: int, final: float) -> float:
    """Decay of the running average of weights: short at first, so that early steps are forgotten."""
    return min(final, (1 + step) / (10 + step))
