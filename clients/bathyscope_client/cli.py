"""``bathyscope depth``: depth and cameras of one clip or a folder of clips."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Literal

import typer
from pydantic import ValidationError

from bathyscope.engines import DepthOptions
from bathyscope.errors import BathyscopeError, ServiceError, SettingsError
from bathyscope.result import DepthKind, PointAgreement
from bathyscope.result_files import Precision
from bathyscope_client.batch import BatchSettings, ClipReport, run_batch
from bathyscope_client.client import DepthClient
from bathyscope_client.clips import LocalClip, find_clips
from bathyscope_client.progress import BatchProgress
from bathyscope_client.runners import EngineRunner, Runner, ServiceRunner

app = typer.Typer(add_completion=False)
_SOME_FAILED = 1
_WRONG_USAGE = 2
_PATIENCE_S = 600.0


def depth_options(stride: int, kind: DepthKind, max_frames: int | None, intrinsics: str | None) -> DepthOptions:
    """What was asked for on the command line.

    Raises:
        typer.BadParameter: If the intrinsics are no camera.
    """
    try:
        return DepthOptions(stride=stride, depth=kind, max_frames=max_frames, intrinsics=intrinsics)
    except ValidationError as error:
        raise typer.BadParameter(error.errors()[0]["msg"], param_hint="--intrinsics") from error


@app.command()
def depth(  # noqa: PLR0917 - typer: one parameter an option
    source: Annotated[
        Path, typer.Argument(metavar="VIDEO|FOLDER", help="A video, a zip or folder of images, or a folder of videos.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", file_okay=False, help="Folder for the files.")] = Path("depth"),
    url: Annotated[
        str | None, typer.Option(envvar="BATHYSCOPE_URL", help="Depth service; without it, the work is done here.")
    ] = None,
    bundle: Annotated[
        Path | None,
        typer.Option(envvar="BATHYSCOPE_BUNDLE", help="Model bundle for work done here. Default: the shipped one."),
    ] = None,
    stride: Annotated[int, typer.Option(min=1, help="Use every n-th frame.")] = 1,
    max_frames: Annotated[int | None, typer.Option(min=1, help="Stop after this many frames.")] = None,
    intrinsics: Annotated[
        str | None, typer.Option(help="The camera's fx,fy,cx,cy in pixels of the video, where they are known.")
    ] = None,
    kind: Annotated[
        DepthKind,
        typer.Option(
            "--depth", help="Depth rendered from the scene (expected, or accumulated), or the depth head's own."
        ),
    ] = "rendered",
    dtype: Annotated[Literal["float32", "float16"], typer.Option(help="Type of the maps in the npz.")] = "float32",
    points: Annotated[int, typer.Option(min=1, help="Most points in the cloud.")] = 500_000,
    again: Annotated[bool, typer.Option("--again", help="Make files again that are already there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON list of what became of each clip.")] = False,
) -> None:
    """Estimate depth and camera poses; clips already done are skipped.

    Each clip NAME gives NAME.npz, NAME.zip (16-bit PNG), NAME_preview.mp4, NAME_poses.txt (TUM), NAME_intrinsics.json,
    NAME_cloud.ply and NAME_sheet.png. Exit code 0: done; 1: some clips failed, each named; 2: wrong usage.
    """
    precision: Precision = dtype
    settings = BatchSettings(
        options=depth_options(stride, kind, max_frames, intrinsics), precision=precision, most_points=points
    )
    with ExitStack() as held:
        try:
            clips = find_clips(source)
            _check(source, out, url, bundle)
            runner = _runner(url, bundle, held)
        except BathyscopeError as error:
            typer.echo(f"bathyscope depth: {error}", err=True)
            raise typer.Exit(_SOME_FAILED if isinstance(error, ServiceError) else _WRONG_USAGE) from error
        reports = _run(clips, out, runner, settings, again=again, as_json=as_json)
    if as_json:
        typer.echo(json.dumps([report.model_dump(mode="json") for report in reports], indent=1))
    if any(report.status == "failed" for report in reports):
        raise typer.Exit(_SOME_FAILED)


def _check(source: Path, out: Path, url: str | None, bundle: Path | None) -> None:
    if url is not None and bundle is not None:
        raise SettingsError("a service brings its own bundle; give either --url or --bundle (or unset BATHYSCOPE_URL)")
    if source.is_dir() and out.resolve() == source.resolve():
        raise SettingsError(f"{out} holds the clips; outputs there would be taken for clips, so give another --out")


def _runner(url: str | None, bundle: Path | None, held: ExitStack) -> Runner:
    if url is None:
        return EngineRunner.load(bundle)
    return ServiceRunner(held.enter_context(DepthClient(url, patience_s=_PATIENCE_S)))


def _run(
    clips: list[LocalClip], out: Path, runner: Runner, settings: BatchSettings, *, again: bool, as_json: bool
) -> list[ClipReport]:
    reports: list[ClipReport] = []
    with BatchProgress(len(clips)) as progress:
        for report in run_batch(clips, out, runner, settings, progress=progress.of, again=again):
            reports.append(report)
            _tell(report, as_json)
    return reports


def _tell(report: ClipReport, as_json: bool) -> None:
    """Failures and warnings on stderr; where the files are on stdout, unless that is for JSON."""
    if report.status == "failed":
        request = f" (request {report.request_id})" if report.request_id else ""
        typer.echo(f"{report.name}: failed: {report.error}{request}", err=True)
        return
    for warning in report.meta.warnings if report.meta else ():
        typer.echo(f"{report.name}: {warning}", err=True)
    if not as_json:
        note = " (was already done)" if report.status == "skipped" else ""
        typer.echo(f"{report.name}: {report.outputs['depth']} and {len(report.outputs) - 1} files beside it{note}")
        if report.meta is not None and report.meta.agreement is not None:
            typer.echo(f"{report.name}: {_said_of(report.meta.agreement)}")


def _said_of(found: PointAgreement) -> str:
    return (
        f"the network's depth differs from that of followed points by {found.difference:.1%} "
        f"({found.points:.0f} a frame, in {found.frames} frames)"
    )
