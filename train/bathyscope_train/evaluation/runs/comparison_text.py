"""A comparison of two evaluations, in Markdown."""

from __future__ import annotations

from bathyscope_train.evaluation.runs.cells import HIGHER_IS_BETTER, TITLES, number
from bathyscope_train.evaluation.runs.compare import FEWEST_SEQUENCES, Comparison
from bathyscope_train.evaluation.runs.markdown import table


def comparison_text(found: Comparison) -> str:
    """Verdict, tests, sequences and the frames that differ most."""
    title = TITLES.get(found.metric, found.metric)
    rows = [
        [part.name, str(part.frames), number(part.first), number(part.second), _signed(part.second - part.first)]
        for part in found.sequences
    ]
    return "\n\n".join(
        [
            f"{title}, first: {found.first}; second: {found.second}.",
            f"{_verdict(found)} Means {number(found.means[0])} and {number(found.means[1])}; difference "
            f"{_signed(found.difference)}, 95 % interval {_interval(found)}.",
            _tests(found),
            f"{found.frames} frames were measured by both; {found.only_first} only by the first, "
            f"{found.only_second} only by the second.",
            table(["sequence", "frames", "first", "second", "second - first"], rows),
            "Largest differences:",
            table(["frame", "first", "second"], [[name, number(a), number(b)] for name, a, b in found.largest]),
        ]
    )


def _verdict(found: Comparison) -> str:
    if found.interval is None:
        return "One sequence says nothing about others."
    if found.interval[0] <= 0 <= found.interval[1]:
        return "No difference can be told."
    better = (found.difference > 0) == (found.metric in HIGHER_IS_BETTER)
    return f"The second is {'better' if better else 'worse'}."


def _tests(found: Comparison) -> str:
    over_sequences = (
        f"fewer than {FEWEST_SEQUENCES} sequences, so no test over them"
        if found.sequence_p is None
        else f"p = {found.sequence_p:.2g} over sequences"
    )
    return (
        f"Wilcoxon signed-rank, paired: {over_sequences}; p = {found.frame_p:.2g} over frames, which is too sure of "
        "itself because neighbouring frames are alike."
    )


def _interval(found: Comparison) -> str:
    return "none" if found.interval is None else f"{_signed(found.interval[0])} to {_signed(found.interval[1])}"


def _signed(value: float) -> str:
    return f"{'+' if value > 0 else ''}{number(value)}"
