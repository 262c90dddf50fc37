"""Weights in several files: ``python -m bathyscope_train.weight_parts split model.safetensors folder``, or ``join``.

Some ways to bring weights home carry small files only. The parts are ordinary safetensors files whose names say which
they are; joined, they give the same tensors and the same record of how they were trained.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from bathyscope.errors import BathyscopeError, CheckpointError

app = typer.Typer(add_completion=False)


def split_weights(path: Path, folder: Path, *, limit_mb: float = 15.0) -> list[Path]:
    """Write the tensors of a file into files of at most ``limit_mb`` (10^6 bytes) each, largest tensors first.

    Args:
        path: A safetensors file.
        folder: For the parts, made if missing; parts of the same name are replaced.
        limit_mb: Largest size of a part.

    Raises:
        CheckpointError: If a single tensor is larger.
    """
    tensors, metadata = _read(path)
    parts: list[dict[str, Tensor]] = []
    room: list[float] = []
    for name, tensor in sorted(tensors.items(), key=lambda item: -item[1].nbytes):
        size = tensor.nbytes + 512  # the header's line
        if size > limit_mb * 1e6:
            raise CheckpointError(f"{path}: {name} has {tensor.nbytes / 1e6:.1f} MB, a part holds {limit_mb} MB")
        fits = next((k for k, left in enumerate(room) if left >= size), len(parts))
        if fits == len(parts):
            parts.append({})
            room.append(limit_mb * 1e6 - sum(len(key) + len(text) for key, text in metadata.items()) - 1024)
        parts[fits][name] = tensor
        room[fits] -= size
    folder.mkdir(parents=True, exist_ok=True)
    written = [folder / f"{path.stem}-{k}-of-{len(parts)}.safetensors" for k in range(1, len(parts) + 1)]
    for place, part in zip(written, parts, strict=True):
        save_file(part, place, metadata=metadata)
    return written


def join_weights(folder: Path, path: Path) -> Path:
    """Write the parts in ``folder`` into one file.

    Raises:
        CheckpointError: If there are none, one is missing, or they are parts of different files.
    """
    found = sorted(folder.glob("*-of-*.safetensors"))
    if not found:
        raise CheckpointError(f"{folder}: no parts; they are called NAME-1-of-2.safetensors and so on")
    stem, _, rest = found[0].stem.rpartition("-of-")
    count, stem = int(rest), stem.rpartition("-")[0]
    wanted = [folder / f"{stem}-{k}-of-{count}.safetensors" for k in range(1, count + 1)]
    missing = [part.name for part in wanted if part not in found]
    if missing or len(found) != count:
        raise CheckpointError(f"{folder}: {len(found)} parts of {count}; missing {missing}, or parts of another file")
    tensors: dict[str, Tensor] = {}
    metadata: dict[str, str] = {}
    for part in wanted:
        more, own = _read(part)
        if metadata and own != metadata:
            raise CheckpointError(f"{part}: of another file than the parts before it")
        tensors, metadata = tensors | more, own
    save_file(tensors, path, metadata=metadata)
    return path


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except (OSError, ValueError, RuntimeError) as error:
        raise CheckpointError(f"{path}: not a safetensors file ({error})") from error


@app.command()
def split(
    path: Path, folder: Path, limit_mb: Annotated[float, typer.Option(help="Largest size of a part.")] = 15.0
) -> None:
    """Write a file of weights in parts."""
    _run(lambda: split_weights(path, folder, limit_mb=limit_mb))


@app.command()
def join(folder: Path, path: Path) -> None:
    """Write parts into one file."""
    _run(lambda: [join_weights(folder, path)])


def _run(work: Callable[[], list[Path]]) -> None:
    try:
        for path in work():
            typer.echo(path)
    except BathyscopeError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error


if __name__ == "__main__":
    app()
