"""``bathyscope train SETTINGS [name=value ...]``: train a network."""

from pathlib import Path
from typing import Annotated

import typer

from bathyscope.errors import BathyscopeError

app = typer.Typer(add_completion=False)


@app.command()
def train(
    settings: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="YAML file; see configs/.")],
    overrides: Annotated[list[str] | None, typer.Argument(help="Settings to replace, as name=value.")] = None,
) -> None:
    """Train a network; a run that was interrupted goes on where it stopped.

    Prints the path of the weights.
    """
    from bathyscope_train.config import load_settings
    from bathyscope_train.pretrain import pretrain

    try:
        typer.echo(pretrain(load_settings(settings, overrides or [])))
    except BathyscopeError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error


if __name__ == "__main__":
    app()
