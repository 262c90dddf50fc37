"""The command ``bathyscope data``: check data sets and prepare them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(add_completion=False, no_args_is_help=True, help="Check data sets and prepare them.")
_MOST_OF_A_KIND = 12


@app.command()
def check(
    root: Annotated[Path, typer.Argument(help="Folder of a data set, of videos or of frames; or one video.")],
    *,
    kind: Annotated[
        str | None,
        typer.Option(help="scared, hamlyn, c3vd, simcol, endoslam, folders or videos; found out unless given."),
    ] = None,
    every_frame: Annotated[bool, typer.Option("--every-frame", help="Read every frame and depth map.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Say what a folder holds, what is missing against the published counts, and which pitfalls apply.

    Exit code 1: something is missing or cannot be read.
    """
    from bathyscope_train.data.datasets.check import check_data

    with _progress("checking") as progress:
        report = check_data(root, kind=kind, every_frame=every_frame, progress=progress)
    if as_json:
        typer.echo(report.model_dump_json(indent=1))
    else:
        _print_report(report)
    raise typer.Exit(0 if report.complete else 1)


@app.command()
def cut(
    folder: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="Data set folder with frames/.")],
    out: Annotated[Path, typer.Argument(help="New folder.")],
    *,
    start: Annotated[int, typer.Option(min=0, help="First frame, counted from 0.")] = 0,
    stop: Annotated[int | None, typer.Option(min=1, help="Frame after the last one.")] = None,
    frames_only: Annotated[
        bool, typer.Option("--frames-only", help="Without depth, points and poses, as videos to train on.")
    ] = False,
) -> None:
    """Copy a range of frames, and what belongs to them, to a folder of its own."""
    from bathyscope_train.data.datasets.cut import cut_folder

    count = cut_folder(folder, out, start=start, stop=stop, frames_only=frames_only)
    typer.echo(f"{out}: {count} frames")


prepare = typer.Typer(add_completion=False, no_args_is_help=True, help="Convert archives to data set folders.")
app.add_typer(prepare, name="prepare")


@prepare.callback()
def _prepare() -> None:
    """Convert archives as they were fetched to data set folders that everything here reads."""


@prepare.command()
def scared(
    root: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="Folder with dataset_1, dataset_2 ...")],
    out: Annotated[Path, typer.Argument(file_okay=False, help="Where the folders go.")],
    *,
    jpeg_quality: Annotated[
        int | None, typer.Option(min=50, max=100, help="Frames as JPEG of this quality instead of PNG.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Sequences converted at the same time.")] = 2,
) -> None:
    """Convert SCARED's official archives; a run that was interrupted goes on where it stopped.

    Exit code 1: something is missing or could not be read; each is named.
    """
    from bathyscope_train.data.datasets.prepare_scared import prepare_scared

    with _progress("preparing") as progress:
        entries = prepare_scared(root, out, jpeg_quality=jpeg_quality, workers=workers, progress=progress)
    for entry in entries:
        typer.echo(f"{entry.name}: {entry.frames} frames, {entry.depth} depth maps, {entry.new} files written")
        for said in entry.said:
            typer.echo(f"  {said}")
    short = [entry.name for entry in entries if not entry.complete]
    typer.echo(f"{len(entries) - len(short)} of {len(entries)} sequences complete, in {out}")
    raise typer.Exit(1 if short else 0)


@contextmanager
def _progress(what: str) -> Iterator[Callable[[str, int, int], None]]:
    """A line on stderr that tells how far things are, on a terminal."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda *_: None
        return
    with console.status(what) as status:
        yield lambda name, done, total: status.update(f"{what} {name}, {done} of {total}")


def _print_report(report: Any) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table(title=f"{report.root}: {report.kind}")
    for heading in ("sequence", "frames", "size", "depth coverage", "poses"):
        table.add_column(heading, justify="left" if heading == "sequence" else "right")
    for s in report.sequences:
        coverage = "-" if s.depth_coverage is None else f"{s.depth_coverage:.1%}"
        table.add_row(s.name, str(s.frames), f"{s.size[1]}x{s.size[0]}", coverage, str(s.poses))
    console.print(table)
    for level in ("missing", "unreadable", "pitfall", "note"):
        found = [finding for finding in report.findings if finding.level == level]
        for finding in found[:_MOST_OF_A_KIND]:
            where = f"{finding.where}: " if finding.where else ""
            console.print(f"{level}: {where}{finding.what}", markup=False, highlight=False, soft_wrap=True)
        if len(found) > _MOST_OF_A_KIND:
            console.print(f"{level}: and {len(found) - _MOST_OF_A_KIND} more; --json prints all of them")
