"""``bathyscope export CHECKPOINT BUNDLE``: turn a checkpoint into a bundle."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from bathyscope.errors import BathyscopeError

app = typer.Typer(add_completion=False)
_WRONG_USAGE = 2


@app.command()
def export(  # noqa: PLR0917 - typer: one parameter an option
    checkpoint: Annotated[Path, typer.Argument(help="Weights: safetensors or a PyTorch file.")],
    bundle: Annotated[Path, typer.Argument(help="Folder that the bundle becomes.")],
    preset: Annotated[str | None, typer.Option(help="Network of a checkpoint that does not say: anysplat.")] = None,
    name: Annotated[str | None, typer.Option(help="Name of the bundle. Default: that of its folder.")] = None,
    version: Annotated[str, typer.Option(help="Version of the bundle.")] = "1",
    pixels: Annotated[int, typer.Option(min=1, help="Area of a frame that the network works best at.")] = 112 * 140,
    window: Annotated[int, typer.Option(min=2, help="Frames the network sees at once.")] = 8,
    overlap: Annotated[int, typer.Option(min=1, help="Frames that neighbouring windows share.")] = 2,
    licence: Annotated[str, typer.Option(help="Licence of the weights.")] = "Apache-2.0",
    research_only: Annotated[
        bool, typer.Option("--research-only", help="The weights may not be used otherwise.")
    ] = False,
    half_weights: Annotated[
        bool,
        typer.Option("--half-weights", help="Round weights to bfloat16 and store them so: half the size."),
    ] = False,
    accuracy: Annotated[
        Path | None,
        typer.Option(exists=True, dir_okay=False, help="JSON object with measured accuracy, for the manifest."),
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace a bundle that lies there already.")] = False,
) -> None:
    """Turn a checkpoint into a bundle: ONNX graphs, one weights file, a manifest with hashes and parity.

    The graphs are compared with PyTorch at several clip lengths and sizes; a bundle that differs is not written.
    Takes minutes. Prints the bundle's path.
    """
    from bathyscope.model_spec import InputSpec
    from bathyscope_export.writer import BundleSettings, write_bundle
    from bathyscope_train.model.checkpoints import load_network, training_of
    from bathyscope_train.model.presets import get_preset

    try:
        network, report = load_network(checkpoint, None if preset is None else get_preset(preset))
        if not report.complete:
            typer.echo(f"bathyscope export: {checkpoint} does not fill the network: {report}", err=True)
            raise typer.Exit(_WRONG_USAGE)
        if overlap >= window:
            raise typer.BadParameter(f"overlap ({overlap}) must be smaller than window ({window})")
        settings = BundleSettings(
            name=name or bundle.name,
            version=version,
            input=InputSpec(patch=network.preset.patch_size, pixels=pixels, window=window, overlap=overlap),
            licence=licence,
            research_only=research_only,
            half_weights=half_weights,
            training=training_of(checkpoint),
            accuracy={} if accuracy is None else _read_accuracy(accuracy),
        )
        written = write_bundle(network, bundle, settings, replace=replace, progress=_say)
    except BathyscopeError as error:
        typer.echo(f"bathyscope export: {error}", err=True)
        raise typer.Exit(_WRONG_USAGE) from error
    typer.echo(written.folder)


def _read_accuracy(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise typer.BadParameter(f"{path} is not JSON ({error})") from error
    if not isinstance(record, dict):
        raise typer.BadParameter(f"{path} holds a {type(record).__name__}, a JSON object was needed")
    return record


def _say(message: str) -> None:
    typer.echo(f"bathyscope export: {message}", err=True)
