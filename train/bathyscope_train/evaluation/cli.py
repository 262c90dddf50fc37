"""The command ``bathyscope evaluate``."""

from __future__ import annotations

from contextlib import contextmanager, nullcontext
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bathyscope_train.evaluation.arguments import EvaluateGroup
from bathyscope_train.evaluation.evaluate import FRAME_GAP, DepthKind, Progress, evaluate
from bathyscope_train.evaluation.metrics import NAMES
from bathyscope_train.evaluation.runs.layouts import Layout

if TYPE_CHECKING:
    from collections.abc import Iterator

app = typer.Typer(
    cls=EvaluateGroup,
    add_completion=False,
    help="FOLDER... measures a bundle at once (`folders`); --data and --systems make a whole evaluation (`tables`).",
)


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


@app.command(name="folders")
def run_folders(
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
    """Measure a bundle on folders with ground truth, beside two guesses that need no network."""
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


@app.command(name="tables")
def run_tables(
    data: Annotated[list[str], typer.Option(help="NAME[:SPLIT][:keyframes|:corrected]=ROOT, several; or folders.")],
    systems: Annotated[
        list[str], typer.Option(help="[NAME=]BUNDLE|WEIGHTS|shipped|constant|brightness|vda-s|...[@DEPTH], several.")
    ],
    protocol: Annotated[str, typer.Option(help="paper, endodav, endodac or vda.")] = "paper",
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for tables; an evaluation there goes on.")] = Path(
        "results"
    ),
    *,
    compat: Annotated[
        list[str] | None, typer.Option(help="Quirks of published evaluators: endodav, endodac, vda, or one by name.")
    ] = None,
    change: Annotated[
        list[str] | None, typer.Option(help="alignment=, per=, averaging=, caps=LOW:HIGH, resize=, intrinsics=, ...")
    ] = None,
    corrected: Annotated[Path | None, typer.Option(help="SCARED-C's poses and depth, laid over SCARED.")] = None,
    max_frames: Annotated[int | None, typer.Option(min=1, help="Use only the first frames of each sequence.")] = None,
    keep_predictions: Annotated[bool, typer.Option(help="Keep raw predictions in the folder.")] = False,
    layout: Annotated[Layout, typer.Option(help="Which of the paper's tables to write.")] = Layout.COMPARISON,
    plots: Annotated[bool, typer.Option(help="Draw plots and the qualitative picture.")] = True,
) -> None:
    """Measure many systems on many data sets under a named protocol; a run that was stopped goes on."""
    from bathyscope_train.evaluation.protocols import changed, named_protocol
    from bathyscope_train.evaluation.runs.names import parse_data, parse_systems
    from bathyscope_train.evaluation.runs.outputs import write_outputs
    from bathyscope_train.evaluation.runs.run import RunRequest, run

    request = RunRequest(
        protocol=changed(named_protocol(protocol, compat or ()), change or ()),
        data=tuple(parse_data(data)),
        systems=tuple(parse_systems(systems)),
        out=out,
        corrected=corrected,
        max_frames=max_frames,
        keep_predictions=keep_predictions,
    )
    with _progress() as progress:
        outcome = run(request, progress)
        write_outputs(outcome, layout, plots=plots)
    typer.echo((out / "summary.md").read_text())
    for problem in outcome.problems:
        typer.echo(problem, err=True)
    if outcome.failed:
        raise typer.Exit(1)


@app.command(name="diff")
def run_diff(
    first: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="An evaluation to compare with.")],
    second: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="The evaluation that is compared.")],
    *,
    systems: Annotated[
        list[str] | None, typer.Option(help="The system of the first, then that of the second; one if they agree.")
    ] = None,
    metric: Annotated[str, typer.Option(help="A number of per_frame.csv.")] = "abs_rel",
) -> None:
    """Compare two evaluations frame by frame, with paired tests."""
    from bathyscope.errors import SettingsError
    from bathyscope_train.evaluation.runs.compare import compare, open_side
    from bathyscope_train.evaluation.runs.comparison_text import comparison_text

    known = (*NAMES, "tae", "tas", "flicker", "coverage")
    if metric not in known:
        raise SettingsError(f"--metric {metric}: no such number; there are {', '.join(known)}")
    names = systems or [None]  # type: ignore[list-item]
    if len(names) > 2:
        raise SettingsError(f"--systems names one or two systems to compare, got {len(names)}")
    typer.echo(comparison_text(compare(open_side(first, names[0]), open_side(second, names[-1]), metric)))


@app.command(name="trajectory")
def run_trajectory(
    true: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="True cameras, TUM text.")],
    predicted: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="Predicted cameras, TUM text.")],
    *,
    gap: Annotated[int, typer.Option(min=1, help="Frames between the cameras of a pair.")] = FRAME_GAP,
) -> None:
    """Compare two trajectory files after a Sim(3) alignment; prints JSON."""
    from bathyscope_train.evaluation.trajectory_files import compare_files

    scores, unmatched = compare_files(true, predicted, gap=gap)
    typer.echo(scores.model_dump_json(indent=1))
    if unmatched:
        typer.echo(f"{unmatched} frames of {true} have no prediction", err=True)


@contextmanager
def _progress() -> Iterator[Any]:
    """A bar on a terminal, a line for each new step elsewhere; both on stderr."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    errors = Console(stderr=True)
    if not errors.is_terminal:
        last = ""

        def line(what: str, done: int, total: int) -> None:
            nonlocal last
            if what != last:
                last = what
                typer.echo(f"{what} ({total} frames)", err=True)

        yield line
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=errors, transient=True) as bars:
        task = bars.add_task("evaluating")

        def bar(what: str, done: int, total: int) -> None:
            if bars.tasks[0].description != what:
                bars.reset(task, description=what)
            bars.update(task, completed=done, total=total)

        yield bar
