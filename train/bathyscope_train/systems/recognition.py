"""Which network a file of weights holds, told by the names and shapes of its tensors."""

from __future__ import annotations

from pathlib import Path
from typing import cast

from bathyscope.bundle import MANIFEST
from bathyscope.errors import CheckpointError
from bathyscope_train.systems.kinds import KINDS, Kind, bare


def recognise(path: Path, wanted: Kind | None = None) -> Kind | None:
    """The kind of published weights at ``path``; ``None`` for a checkpoint that says its own network.

    Args:
        path: A file, or a folder of weights in several files.
        wanted: What it is said to be.

    Raises:
        CheckpointError: If it cannot be read, is of no known kind, or not of the wanted one.
    """
    from bathyscope_train.model.checkpoints import names_its_network
    from bathyscope_train.model.weight_files import open_weights

    kinds, file = _candidates(path)
    weights = open_weights(file)
    if names_its_network(weights):
        if wanted is not None:
            raise CheckpointError(f"{path}: says itself which network it holds; it is no {wanted.name}")
        return None
    shapes = {bare(key): shape for key, shape in weights.shapes.items()}
    fitting = [kind for kind in kinds if kind.recognises(shapes)]
    if wanted is not None and wanted not in fitting:
        what = f"those of {fitting[0].name}" if fitting else f"{len(shapes)} unknown ones, like {next(iter(shapes))}"
        raise CheckpointError(f"{path}: holds no {wanted.name}: its tensors are {what}")
    if not fitting:
        raise CheckpointError(
            f"{path}: its {len(shapes)} tensors (like {next(iter(shapes))}) are those of no network known here: "
            f"{', '.join(kind.name for kind in KINDS)}, or a checkpoint that `bathyscope train` wrote"
        )
    return wanted or _by_file_name(file, fitting)


def kind_called(name: str | None) -> Kind | None:
    """The kind of this name, if there is one."""
    return next((kind for kind in KINDS if kind.name == name), None)


def _candidates(path: Path) -> tuple[list[Kind], Path]:
    """Kinds that may lie at ``path``, and the file to tell by."""
    if not path.is_dir():
        return list(KINDS), path
    found = [kind for kind in KINDS if kind.member is not None and (path / kind.member).is_file()]
    if not found:
        members = sorted({kind.member for kind in KINDS if kind.member is not None})
        raise CheckpointError(f"{path}: neither a bundle ({MANIFEST}) nor weights ({', '.join(members)})")
    return found, path / cast(str, found[0].member)


def _by_file_name(path: Path, kinds: list[Kind]) -> Kind:
    """Metric and relative weights have the same keys; the published files say it in their names."""
    metric = [kind for kind in kinds if kind.name.endswith("-metric")]
    return metric[0] if metric and "metric" in path.stem else kinds[0]
