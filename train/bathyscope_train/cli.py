"""``bathyscope train SETTINGS [name=value ...]``: train a network."""

import os
from pathlib import Path
from typing import Annotated

import typer

from bathyscope.errors import BathyscopeError

app = typer.Typer(add_completion=False)


@app.command()
def train(
    settings: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="YAML file; see configs/.")],
    overrides: Annotated[list[str] | None, typer.Argument(help="Settings to replace, as name=value.")] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print settings, parameter groups and expected memory; train nothing.")
    ] = False,
) -> None:
    """Train a network; a run that was interrupted goes on where it stopped.

    The file's `task` says how: pretrain (supervised, on rendered clips), consistency (on your videos, without ground
    truth) or ablation (several runs and a table). Prints the path of the weights, or of the table.
    """
    try:
        typer.echo(_run(settings, overrides or [], dry_run=dry_run))
    except BathyscopeError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error


def _run(path: Path, overrides: list[str], *, dry_run: bool) -> object:
    from bathyscope_train.config import PretrainSettings
    from bathyscope_train.consistency.ablation_settings import AblationSettings
    from bathyscope_train.tasks import load_task

    settings = load_task(path, overrides)
    if isinstance(settings, PretrainSettings):
        from bathyscope_train.pretrain import pretrain
        from bathyscope_train.pretrain_plan import pretrain_plan

        return pretrain_plan(settings) if dry_run else pretrain(settings)
    if isinstance(settings, AblationSettings):
        from bathyscope_train.consistency.ablation import ablation_plan, run_ablation

        return ablation_plan(settings) if dry_run else run_ablation(settings)
    from bathyscope_train.consistency.plan import make_plan
    from bathyscope_train.consistency.trainer import optimise

    return make_plan(settings, processes=int(os.environ.get("WORLD_SIZE", "1"))) if dry_run else optimise(settings)
