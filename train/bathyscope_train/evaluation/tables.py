"""Evaluation reports as tables for people."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.table import Table

from bathyscope_train.evaluation.reports import DepthScores, EvaluationReport, FolderReport, NetworkReport

_LABELS = {
    "rendered": "network, rendered depth",
    "head": "network, depth head",
    "constant": "guess: constant depth",
    "inverse_sqrt_brightness": "guess: 1/sqrt(brightness)",
}
_COLUMNS = ("AbsRel", "SqRel", "RMSE", "RMSE log", "δ1", "coverage")


def print_report(report: EvaluationReport, console: Console) -> None:
    """Print every folder, and the mean over folders where there are several."""
    console.print(
        f"Bundle [bold]{report.bundle.name}[/bold] {report.bundle.version}; {report.software}", highlight=False
    )
    console.print(f"Scale: {report.protocol.alignment}. Averages: {report.protocol.averaging}.", highlight=False)
    for folder in report.datasets:
        _print_folder(folder, console)
    if report.mean:
        console.print(_depth_table(f"mean over {len(report.datasets)} data sets", report.mean))


def _print_folder(folder: FolderReport, console: Console) -> None:
    counts = folder.counts
    title = f"{folder.dataset}: {counts.frames_with_truth} of {counts.frames} frames, {counts.pixels:,} pixels"
    title += f" of {folder.truth} depth, unit {folder.unit}"
    rows = {name: part.depth for name, part in folder.network.items()}
    console.print(_depth_table(title, {**rows, **folder.baselines}))
    with_poses = {name: part for name, part in folder.network.items() if part.poses is not None}
    if with_poses:
        console.print(_pose_table(with_poses))
    for name, part in folder.network.items():
        _print_notes(name, part, console)


def _depth_table(title: str, rows: Mapping[str, DepthScores]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for column in _COLUMNS:
        table.add_column(column, justify="right")
    for name, score in rows.items():
        values = (score.abs_rel, score.sq_rel, score.rmse, score.rmse_log, score.delta1, score.coverage)
        table.add_row(_LABELS.get(name, name), *(_text(value) for value in values))
    return table


def _pose_table(parts: Mapping[str, NetworkReport]) -> Table:
    first = next(part.poses for part in parts.values() if part.poses is not None)
    table = Table(
        title=f"poses, {first.gap} frames apart, {first.pairs} pairs, lengths in {first.unit}", title_justify="left"
    )
    table.add_column("")
    for name in parts:
        table.add_column(_LABELS.get(name, name), justify="right")
    poses = [part.poses for part in parts.values() if part.poses is not None]
    lines = {
        "rotation error, mean (deg)": [_text(p.rotation_error_deg_mean) for p in poses],
        "  true rotation, mean": [_text(p.true_rotation_deg_mean) for p in poses],
        "translation direction cosine, mean": [_text(p.direction_cosine_mean) for p in poses],
        "  true translation, mean": [_text(p.true_translation_mean) for p in poses],
        "RPE translation / rotation (deg)": [
            f"{_text(p.rpe_translation)} / {_text(p.rpe_rotation_deg)}" for p in poses
        ],
        "ATE after Sim(3)": [_text(p.ate_rmse) for p in poses],
        "  of a camera that stands still": [_text(p.ate_standing_still) for p in poses],
        "pose scale / depth scale": [_text(p.pose_scale_over_depth_scale) for p in poses],
    }
    for label, values in lines.items():
        table.add_row(label, *values)
    return table


def _print_notes(name: str, part: NetworkReport, console: Console) -> None:
    focal = "no cameras"
    if part.focal is not None:
        focal = f"predicted / true focal length {_text(part.focal.fx_ratio)} (x), {_text(part.focal.fy_ratio)} (y)"
    console.print(f"{name}: {focal}; segments: {part.segments}", highlight=False)
    for warning in part.warnings:
        console.print(f"{name}: {warning}", highlight=False, markup=False)


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
