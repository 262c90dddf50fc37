"""The tables of an experiment: means over clips and seeds, paired intervals, forgetting, and the course of runs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bathyscope_train.consistency.scores import ClipScores

_COLUMNS = {
    "abs_rel": ("AbsRel", "{:.4f}"),
    "sq_rel": ("SqRel", "{:.3f}"),
    "rmse": ("RMSE", "{:.3f}"),
    "rmse_log": ("RMSE log", "{:.4f}"),
    "delta1": ("δ1", "{:.4f}"),
    "flicker": ("flicker %", "{:.2f}"),
    "abs_rel_clip": ("AbsRel, scale per clip", "{:.4f}"),
}
_REGIONS = {"full": "full frame", "central": "central 80 %"}
_DRAWS = 5_000
_SEED = 20260101


@dataclass(frozen=True, slots=True)
class Outcome:
    """One run, or what is measured without one."""

    variant: str
    seed: int | None
    scores: Mapping[str, Sequence[ClipScores]]
    """Of the target, and of the source where it is measured."""
    failed: str | None = None
    course: tuple[float, ...] = field(default=())
    """AbsRel on the target at every validation, the start first."""


@dataclass(frozen=True, slots=True)
class Change:
    """Relative change of a mean, with a 95 % interval."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:+.1%} [{self.low:+.1%}, {self.high:+.1%}]"


def paired_change(before: NDArray[np.float64], after: NDArray[np.float64], draws: int = _DRAWS) -> Change:
    """How much the mean of the same clips changed, over several seeds.

    The interval is a percentile bootstrap that draws clips and seeds with replacement; a clip's values before and after
    stay together, so that what makes clips differ does not widen it.

    Args:
        before: (c,) values of the clips.
        after: (s, c) values of the same clips, for each seed.
        draws: Of the bootstrap; the same in every call.
    """
    seeds, clips = after.shape
    random = np.random.default_rng(_SEED)
    chosen_clips = random.integers(clips, size=(draws, clips))
    chosen_seeds = random.integers(seeds, size=(draws, seeds))
    means = after[chosen_seeds[:, :, None], chosen_clips[:, None, :]].mean((1, 2))
    low, high = np.percentile(means / before[chosen_clips].mean(1) - 1, (2.5, 97.5))
    return Change(float(after.mean() / before.mean() - 1), float(low), float(high))


def tables(outcomes: Sequence[Outcome], *, baseline: str) -> str:
    """Markdown: target and source over both regions, then the course of every run and what failed."""
    parts = []
    for domain in ("target", "source"):
        if all(domain in each.scores for each in outcomes if each.variant == baseline):
            parts += [_table(outcomes, domain, region, baseline) for region in _REGIONS]
    parts += [_courses(outcomes), _failures(outcomes)]
    return "\n\n".join(part for part in parts if part) + "\n"


def values_of(outcomes: Iterable[Outcome], domain: str, region: str, name: str) -> NDArray[np.float64]:
    """(s, c) one number of every clip, for every run that did not fail."""
    return np.array(
        [
            [getattr(getattr(clip, region), name) for clip in each.scores[domain]]
            for each in outcomes
            if each.failed is None
        ]
    )


def _table(outcomes: Sequence[Outcome], domain: str, region: str, baseline: str) -> str:
    names = [label for label, _ in _COLUMNS.values()]
    lines = [
        f"**{domain.capitalize()} domain, {_REGIONS[region]}**",
        "",
        f"| | {' | '.join(names)} | change of AbsRel, paired 95 % | clips better | seeds |",
        f"|---|{'---|' * (len(names) + 3)}",
    ]
    before = values_of([each for each in outcomes if each.variant == baseline], domain, region, "abs_rel")[0]
    for variant in dict.fromkeys(each.variant for each in outcomes):
        runs = [each for each in outcomes if each.variant == variant]
        good = [each for each in runs if each.failed is None]
        if not good:
            lines.append(f"| {variant} |{' |' * len(names)} | | 0 of {len(runs)} |")
            continue
        numbers = [
            form.format(np.nanmean(values_of(good, domain, region, name))) for name, (_, form) in _COLUMNS.items()
        ]
        after = values_of(good, domain, region, "abs_rel")
        change = "" if variant == baseline else str(paired_change(before, after))
        better = "" if variant == baseline else f"{np.mean(after < before):.0%}"
        seeds = "" if runs[0].seed is None else f"{len(good)} of {len(runs)}"
        lines.append(f"| {variant} | {' | '.join(numbers)} | {change} | {better} | {seeds} |")
    return "\n".join(lines)


def _courses(outcomes: Sequence[Outcome]) -> str:
    """How far above its start a run ever was, and where it ended."""
    measured = [each for each in outcomes if len(each.course) > 1]
    if not measured:
        return ""
    rows = [
        f"| {each.variant}, seed {each.seed} | {each.course[0]:.4f} | {max(each.course[1:]) / each.course[0] - 1:+.1%} "
        f"| {each.course[-1] / each.course[0] - 1:+.1%} |"
        for each in measured
    ]
    head = ["**AbsRel on the target while training**", "", "| run | start | highest later | end |", "|---|---|---|---|"]
    return "\n".join([*head, *rows])


def _failures(outcomes: Sequence[Outcome]) -> str:
    failed = [f"- {each.variant}, seed {each.seed}: {each.failed}" for each in outcomes if each.failed is not None]
    return "\n".join(["**Stopped**", "", *failed]) if failed else ""
