"""The root command ``bathyscope``: gathers the sub-commands of the installed packages.

Each package names its typer app, with one command, as an entry point in ``bathyscope.commands``. An app is imported
only when its command is asked for, so ``bathyscope --help`` is quick, and a package whose requirements are not
installed says which extra brings them.
"""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint, entry_points, version
from typing import Annotated, Any

import typer
from typer.core import TyperGroup
from typer.main import get_command

from bathyscope.errors import BathyscopeError

GROUP = "bathyscope.commands"
_SUMMARIES = {
    "depth": "Estimate depth and camera poses for a video or a folder of videos.",
    "serve": "Run the depth service.",
    "evaluate": "Measure systems on data sets with ground truth, and compare evaluations.",
    "export": "Turn a checkpoint into a bundle.",
    "train": "Train a network.",
    "data": "Check data sets and prepare them.",
    "demo": "Run the shipped clip through service and client.",
}
_EXTRAS = {
    "bathyscope_client": "client",
    "bathyscope_serve": "serve",
    "bathyscope_export": "export",
    "bathyscope_train": "train",
}


class _Commands(TyperGroup):
    """Sub-commands found through entry points and imported when used."""

    def list_commands(self, ctx: Any) -> list[str]:
        return sorted(point.name for point in entry_points(group=GROUP))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        found = entry_points(group=GROUP, name=cmd_name)
        return _load(next(iter(found))) if found else None

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """One line a command, without importing any of them."""
        typer.echo(f"Usage: {ctx.command_path} [OPTIONS] COMMAND [ARGS]...\n\n  {self.help}\n\nCommands:")
        for name in self.list_commands(ctx):
            typer.echo(f"  {name:10}{_SUMMARIES.get(name, '')}")
        typer.echo("\nOptions:\n  --version   Show the version and exit.\n  --help      Show this message and exit.")


def _load(point: EntryPoint) -> Any:
    try:
        return get_command(point.load())
    except ModuleNotFoundError as error:
        package = point.value.split(".")[0]
        typer.echo(
            f"`bathyscope {point.name}` needs the package {error.name!r}; install it with: "
            f"pip install 'bathyscope[{_EXTRAS.get(package, package)}]'",
            err=True,
        )
        raise typer.Exit(2) from error


root = typer.Typer(cls=_Commands, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(version("bathyscope"))
        raise typer.Exit


@root.callback()
def _root(
    version: Annotated[bool, typer.Option("--version", callback=_show_version, is_eager=True)] = False,
) -> None:
    """Depth maps and camera poses, consistent in one 3-D world, from monocular endoscopic video."""


def main() -> None:
    """Run the command line; errors that the user can mend are one line on stderr and exit code 2."""
    try:
        root()
    except BathyscopeError as error:
        typer.echo(f"bathyscope: {error}", err=True)
        sys.exit(2)
