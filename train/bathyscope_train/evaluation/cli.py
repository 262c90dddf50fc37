"""The command ``bathyscope evaluate``."""

from __future__ import annotations

from contextlib import nullcontext
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from bathyscope_train.evaluation.evaluate import FRAME_GAP, DepthKind, Progress, evaluate

app = typer.Typer(add_completion=False)


class DepthChoice(StrEnum):
    """Which depth outputs to measure."""

    rendered = "rendered"
    head = "head"
    both = "both"

    @property
    def kinds(self) -> tuple[DepthKind, ...]:
        """The outputs by name."""
        if self is DepthChoice.both:
            return ("rendered", "head")
        return ("rendered",) if self is DepthChoice.rendered else ("head",)


@app.command()
def run(
    folders: Annotated[
        list[Path], typer.Argument(exists=True, file_okay=False, help="Data set folders: frames/, intrinsics.json, ...")
    ],
    *,
    bundle: Annotated[
        Path | None, typer.Option("--bundle", "-b", help="Model bundle; the shipped one unless given.")
    ] = None,
    depth: Annotated[DepthChoice, typer.Option("--depth", help="Depth outputs to measure.")] = DepthChoice.both,
    gap: Annotated[int, typer.Option(min=1, help="Frames between the cameras of a pair in pose errors.")] = FRAME_GAP,
    max_frames: Annotated[int | None, typer.Option(min=1, help="Use only the first frames of each folder.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Measure a bundle on data sets with ground truth, beside two guesses that need no network."""
    from rich.console import Console

    from bathyscope.bundle import Bundle, shipped_bundle
    from bathyscope.engines import engine_factory
    from bathyscope_train.evaluation.tables import print_report

    errors = Console(stderr=True)
    engine = engine_factory()(Bundle.open(bundle or shipped_bundle()))
    with errors.status("evaluating") if errors.is_terminal else nullcontext() as status:
        progress: Progress = lambda *_: None  # noqa: E731
        if status is not None:
            progress = lambda what, done, total: status.update(f"{what}, frame {done} of {total}")  # noqa: E731
        report = evaluate(engine, folders, kinds=depth.kinds, gap=gap, max_frames=max_frames, progress=progress)
    if as_json:
        typer.echo(report.model_dump_json(indent=1))
    else:
        print_report(report, Console())
