"""Write a bundle: graphs, weights, model card and a manifest with hashes and parity."""

import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import onnx

from bathyscope.bundle import (
    Bundle,
    BundleManifest,
    GraphSpec,
    Role,
    hash_file,
    write_manifest,
)
from bathyscope.errors import BundleError
from bathyscope.model_spec import InputSpec
from bathyscope_export.card import write_card
from bathyscope_export.graph import export_stage
from bathyscope_export.half_weights import halve_weights
from bathyscope_export.parity import SHAPES, compare
from bathyscope_export.stages import Stage, split
from bathyscope_export.weights import externalise
from bathyscope_train.model.half_precision import round_to_bfloat16
from bathyscope_train.model.network import Network
from bathyscope_train.model.specs import scene_spec

WEIGHTS = "weights.bin"
CARD = "card.md"


@dataclass(frozen=True, slots=True)
class BundleSettings:
    """What a bundle says about itself, besides what its network says."""

    name: str
    version: str
    input: InputSpec
    licence: str = "Apache-2.0"
    research_only: bool = False
    training: Mapping[str, Any] = field(default_factory=dict)
    """How the weights came about; paths in it are cut to their last part."""
    accuracy: Mapping[str, Any] = field(default_factory=dict)
    """Measured accuracy, with protocol."""
    half_weights: bool = False
    """Round weights to bfloat16 and store them so."""
    shapes: tuple[tuple[int, int, int], ...] = SHAPES
    """Clips on which the graphs are compared with PyTorch: frames, rows and columns of patches."""


def write_bundle(
    network: Network,
    folder: Path,
    settings: BundleSettings,
    *,
    replace: bool = False,
    progress: Callable[[str], None] = lambda message: None,
) -> Bundle:
    """Export a network into a new folder; written beside and renamed into place.

    Args:
        network: In evaluation mode, on the CPU, in float32.
        folder: Where the bundle goes.
        settings: What it says about itself.
        replace: Whether a bundle that lies there already may go.
        progress: Told what is being done; the whole takes minutes.

    Raises:
        BundleError: If the folder exists, the graphs differ from PyTorch, or their attention is quadratic in memory.
    """
    return placed(folder, lambda beside: _fill(network, beside, settings, progress), replace=replace)


def placed(folder: Path, fill: Callable[[Path], None], *, replace: bool) -> Bundle:
    """A bundle that ``fill`` writes beside, checked and renamed into place.

    Raises:
        BundleError: If the folder exists and may not be replaced, or what was written is no bundle.
    """
    if folder.exists() and not replace:
        raise BundleError(f"{folder} exists; remove it, choose another name, or replace it")
    if folder.exists() and not (folder / "bundle.json").is_file():
        raise BundleError(f"{folder} exists and is no bundle; choose another name")
    folder.parent.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        beside.chmod(0o755)
        fill(beside)
        Bundle.open(beside)
        if folder.exists():
            shutil.rmtree(folder)
        beside.rename(folder)
    except BaseException:
        shutil.rmtree(beside, ignore_errors=True)
        raise
    return Bundle.open(folder)


def _fill(network: Network, folder: Path, settings: BundleSettings, progress: Callable[[str], None]) -> None:
    if settings.half_weights:
        network = deepcopy(network)
        round_to_bfloat16(network)
    graphs = write_graphs(network, folder, progress)
    progress(f"comparing with PyTorch on {len(settings.shapes)} clips")
    differences = compare(network, folder, graphs, settings.shapes)
    for difference in differences:
        difference.check()
    parity = [difference.record() for difference in differences]
    training = strip_paths(dict(settings.training))
    write_card(folder / CARD, network.preset, settings, training=training, parity=parity)
    names = [*(graph.file for graph in graphs.values()), WEIGHTS, CARD]
    manifest = BundleManifest(
        name=settings.name,
        version=settings.version,
        preset=network.preset.name,
        graphs=graphs,
        weights=WEIGHTS,
        files={name: hash_file(folder / name) for name in names},
        input=settings.input,
        scene=scene_spec(network.preset),
        licence=settings.licence,
        research_only=settings.research_only,
        training=training,
        parity=parity,
        accuracy=dict(settings.accuracy),
    )
    write_manifest(folder, manifest)


def write_graphs(
    network: Network, folder: Path, progress: Callable[[str], None] = lambda message: None
) -> dict[Role, GraphSpec]:
    """Trace the three stages and write them, with their weights, into ``folder``."""
    return write_stages(split(network), folder, patch=network.preset.patch_size, progress=progress)


def write_stages(
    stages: Iterable[Stage], folder: Path, *, patch: int, progress: Callable[[str], None] = lambda message: None
) -> dict[Role, GraphSpec]:
    """Trace stages and write them, with their weights, into ``folder``."""
    models: dict[Role, onnx.ModelProto] = {}
    for stage in stages:
        progress(f"tracing {stage.role}")
        models[stage.role] = export_stage(stage, patch=patch)
        halve_weights(models[stage.role])
    externalise(models.values(), folder / WEIGHTS)
    specs: dict[Role, GraphSpec] = {}
    for role, model in models.items():
        file = f"{role}.onnx"
        (folder / file).write_bytes(model.SerializeToString(deterministic=True))
        specs[role] = GraphSpec(
            file=file,
            inputs=tuple(value.name for value in model.graph.input),
            outputs=tuple(value.name for value in model.graph.output),
        )
    return specs


def strip_paths(value: Any) -> Any:
    """The same record with every absolute path cut to its last part: a bundle travels, folders do not."""
    if isinstance(value, Mapping):
        return {key: strip_paths(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [strip_paths(each) for each in value]
    if isinstance(value, str) and PurePath(value).is_absolute():
        return PurePath(value).name
    return value
