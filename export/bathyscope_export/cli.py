"""``bathyscope export CHECKPOINT BUNDLE``: turn a checkpoint into a bundle."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bathyscope.bundle import hash_file
from bathyscope.errors import BathyscopeError, CheckpointError, SettingsError
from bathyscope.model_spec import InputSpec

if TYPE_CHECKING:
    from bathyscope_train.model.network import Network
    from bathyscope_train.systems.kinds import Kind
    from bathyscope_train.systems.video_networks import VideoNetwork

app = typer.Typer(add_completion=False)
_WRONG_USAGE = 2
_PIXELS, _WINDOW, _OVERLAP = 112 * 140, 8, 2


@app.command()
def export(  # noqa: PLR0917 - typer: one parameter an option
    checkpoint: Annotated[
        Path, typer.Argument(help="Weights: safetensors, a PyTorch file, EndoDAC's folder; or constant, brightness.")
    ],
    bundle: Annotated[Path, typer.Argument(help="Folder that the bundle becomes.")],
    preset: Annotated[
        str | None, typer.Option(help="Network of weights that do not tell it by their keys: vda-s-metric, anysplat.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the bundle. Default: that of its folder.")] = None,
    version: Annotated[str, typer.Option(help="Version of the bundle.")] = "1",
    pixels: Annotated[
        int | None, typer.Option(min=1, help="Area of a frame that the network works best at. Default: 15680.")
    ] = None,
    window: Annotated[int | None, typer.Option(min=2, help="Frames the network sees at once. Default: 8.")] = None,
    overlap: Annotated[int | None, typer.Option(min=1, help="Frames neighbouring windows share. Default: 2.")] = None,
    licence: Annotated[str | None, typer.Option(help="Licence of the weights. Default: Apache-2.0.")] = None,
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

    Takes our own checkpoints and the published weights of AnySplat, VGGT, Video Depth Anything, EndoDAC and EndoDAV,
    which are told by their keys. The graphs are compared with PyTorch at several clip lengths and sizes; a bundle
    that differs is not written. Takes minutes. Prints the bundle's path.
    """
    from bathyscope_export.video_writer import VideoBundleSettings, write_video_bundle
    from bathyscope_export.writer import BundleSettings, write_bundle
    from bathyscope_train.model.checkpoints import training_of

    record = {} if accuracy is None else _read_accuracy(accuracy)
    called = name or bundle.name
    try:
        video, kind = _video(checkpoint, preset)
        if video is not None:
            given = {"--pixels": pixels, "--window": window, "--overlap": overlap, "--licence": licence}
            _refuse(video.name, {**given, "--research-only": research_only, "--half-weights": half_weights})
            digest = None if kind is None else hash_file(_file(checkpoint, kind)).sha256
            about = VideoBundleSettings(called, version, weights_sha256=digest, accuracy=record)
            written = write_video_bundle(video, bundle, about, replace=replace, progress=_say)
        else:
            network = _network(checkpoint, preset if kind is None else kind.preset)
            settings = BundleSettings(
                name=called,
                version=version,
                input=_input(network, pixels or _PIXELS, window or _WINDOW, overlap or _OVERLAP),
                licence=licence or "Apache-2.0",
                research_only=research_only,
                half_weights=half_weights,
                training=training_of(checkpoint),
                accuracy=record,
            )
            written = write_bundle(network, bundle, settings, replace=replace, progress=_say)
    except BathyscopeError as error:
        typer.echo(f"bathyscope export: {error}", err=True)
        raise typer.Exit(_WRONG_USAGE) from error
    typer.echo(written.folder)


def _video(checkpoint: Path, preset: str | None) -> "tuple[VideoNetwork | None, Kind | None]":
    """The video network that the weights, or the name of a guess, stand for; and of what kind the weights are."""
    from bathyscope_train.systems.guess_networks import GUESSES, guess_network

    if str(checkpoint) in GUESSES and not checkpoint.exists():
        return guess_network(str(checkpoint)), None
    kind = _kind(checkpoint, preset)
    return (None if kind is None or kind.video is None else kind.video(checkpoint, kind.name)), kind


def _kind(checkpoint: Path, preset: str | None) -> "Kind | None":
    """The published network that the weights are; ``None`` for our own, and for a preset that nobody publishes."""
    from bathyscope_train.model.presets import PRESETS
    from bathyscope_train.systems.recognition import kind_called, recognise

    wanted = kind_called(preset)
    if preset is not None and wanted is None:
        if preset not in PRESETS:
            raise SettingsError(f"no network {preset!r}; there are {', '.join(sorted(PRESETS))} and those told by keys")
        return None
    return recognise(checkpoint, wanted)


def _network(checkpoint: Path, preset: str | None) -> "Network":
    """The checkpoint's network, filled.

    Raises:
        CheckpointError: If the checkpoint does not fill it.
    """
    from bathyscope_train.model.checkpoints import load_network
    from bathyscope_train.model.presets import get_preset

    network, report = load_network(checkpoint, None if preset is None else get_preset(preset))
    if not report.complete:
        raise CheckpointError(f"{checkpoint} does not fill the network: {report}")
    return network


def _input(network: "Network", pixels: int, window: int, overlap: int) -> InputSpec:
    if overlap >= window:
        raise typer.BadParameter(f"overlap ({overlap}) must be smaller than window ({window})")
    return InputSpec(patch=network.preset.patch_size, pixels=pixels, window=window, overlap=overlap)


def _refuse(name: str, options: Mapping[str, object]) -> None:
    """Options that a video network decides itself."""
    given = [option for option, value in options.items() if value not in (None, False)]
    if given:
        raise SettingsError(f"{name} brings its own windows, size and licence; {', '.join(given)} cannot be given")


def _file(checkpoint: Path, kind: "Kind") -> Path:
    return checkpoint / kind.member if checkpoint.is_dir() and kind.member is not None else checkpoint


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
