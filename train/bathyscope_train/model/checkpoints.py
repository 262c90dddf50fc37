"""Checkpoints: our own, which say what network they belong to, and the published ones.

Published files carry prefixes (``encoder.``, ``model.encoder.``, ``module.``), reduced precision, frozen teacher
copies (``distill_*``) and heads that this network has not. Loading strips, casts and ignores accordingly, and
reports what it did; nothing is matched by guessing.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import BeforeValidator, ValidationError
from safetensors.torch import save_file
from torch import Tensor, nn

from bathyscope.errors import CheckpointError
from bathyscope_train.model.half_precision import halved
from bathyscope_train.model.network import Network
from bathyscope_train.model.presets import NetworkPreset
from bathyscope_train.model.weight_files import WeightFile, open_weights

_PREFIXES = ("module.", "model.", "encoder.")
_FOREIGN_PARTS = ("distill_", "point_head.", "track_head.")
_PRESET = "bathyscope.preset"
_TRAINING = "bathyscope.training"


@dataclass(frozen=True, slots=True)
class LoadReport:
    """What became of every key, by the network's names (``unexpected`` and ``ignored``: by the file's)."""

    loaded: tuple[str, ...]
    missing: tuple[str, ...]
    """In the network but not in the file; these keep their values."""
    unexpected: tuple[str, ...]
    """In the file but not in the network."""
    ignored: tuple[str, ...]
    """Teacher copies, and heads of VGGT that this network has not."""
    mismatched: tuple[str, ...]
    """Of another shape or kind, as ``key: found, needed``; these keep their values."""

    @property
    def complete(self) -> bool:
        """Whether every parameter of the network was loaded and nothing unknown was left over."""
        return not (self.missing or self.unexpected or self.mismatched)

    def __str__(self) -> str:
        parts = [f"{len(self.loaded)} loaded"]
        for name in ("missing", "unexpected", "ignored", "mismatched"):
            keys = getattr(self, name)
            if keys:
                parts.append(f"{len(keys)} {name} ({', '.join(keys[:3])}{', ...' if len(keys) > 3 else ''})")
        return "; ".join(parts)


def load_weights(network: Network, path: Path | str) -> LoadReport:
    """Copy what fits from a file into ``network``, in the network's own precision.

    Raises:
        CheckpointError: If the file cannot be used at all, or a tensor in it is not finite.
    """
    return _copy(network, open_weights(path))


def load_network(path: Path | str, preset: NetworkPreset | None = None) -> tuple[Network, LoadReport]:
    """The network of a checkpoint, on the CPU and in evaluation mode.

    Args:
        path: One of ours, or a published one.
        preset: What to build for a file that does not say; must be None for one that does.

    Raises:
        CheckpointError: If the file cannot be used; if it does not say its preset and none is given; or if it is one of
            ours and does not hold exactly the network that it names.
    """
    weights = open_weights(path)
    stated = _stated_preset(weights)
    if stated is None and preset is None:
        raise CheckpointError(f"{path}: does not say which network it belongs to; name a preset")
    if stated is not None and preset is not None:
        raise CheckpointError(f"{path}: says itself that it is a {stated.name!r}; load it without naming a preset")
    if stated is not None:
        _check_exact(stated, weights)
    chosen = stated or preset
    assert chosen is not None
    network = Network(chosen).eval()
    return network, _copy(network, weights)


def names_its_network(weights: WeightFile) -> bool:
    """Whether a file is one of ours: it carries the preset of its network."""
    return _PRESET in weights.metadata


def shipped_checkpoint() -> Path:
    """The checkpoint of the shipped bundle: what a training on other videos starts from."""
    return Path(__file__).parents[1] / "weights" / "tiny.safetensors"


def _shipped_or_path(value: object) -> object:
    return shipped_checkpoint() if value == "shipped" else value


CheckpointPath = Annotated[Path, BeforeValidator(_shipped_or_path)]
"""A path in settings; ``shipped`` stands for the checkpoint that comes with the package."""


def save_checkpoint(
    network: nn.Module, path: Path | str, *, training: Mapping[str, Any] | None = None, half: bool = False
) -> None:
    """Write safetensors that carry the preset, if it is a network of ours, and, as JSON, how the weights came about.

    Others are told by the names of their tensors, as their published weights are. Written beside and renamed into
    place.

    Args:
        network: What is written.
        path: Where.
        training: How the weights came about.
        half: Store what bfloat16 holds exactly as bfloat16; see :mod:`.half_precision`. Nothing is rounded here.
    """
    path = Path(path)
    metadata = {_TRAINING: json.dumps(dict(training or {}))}
    if isinstance(network, Network):
        metadata[_PRESET] = network.preset.model_dump_json()
    beside = path.with_name(path.name + ".part")
    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    if half:
        tensors = {name: halved(value) for name, value in tensors.items()}
    save_file(tensors, beside, metadata=metadata)
    beside.replace(path)


def training_of(path: Path | str) -> dict[str, Any]:
    """How the weights of one of our checkpoints came about; empty for a published one.

    Raises:
        CheckpointError: If the file cannot be used.
    """
    try:
        training = json.loads(open_weights(path).metadata.get(_TRAINING, "{}"))
    except ValueError as error:
        raise CheckpointError(f"{path}: its training record is not JSON ({error})") from error
    if not isinstance(training, dict):
        raise CheckpointError(f"{path}: its training record is a {type(training).__name__}, not an object")
    return training


def _copy(network: Network, weights: WeightFile) -> LoadReport:
    wanted = network.state_dict()
    sources, ignored, unexpected = _match(weights, set(wanted))
    loaded, mismatched = [], []
    for name, stored in sources.items():
        target = wanted[name]
        if weights.shapes[stored] != tuple(target.shape):
            mismatched.append(f"{name}: {_shape(weights.shapes[stored])}, needed {_shape(tuple(target.shape))}")
            continue
        value = weights.read(stored)
        if value.is_floating_point() != target.is_floating_point():
            mismatched.append(f"{name}: {value.dtype}, needed {target.dtype}")
            continue
        with torch.no_grad():
            target.copy_(_finite(value.to(target.dtype), stored, weights.path))
        loaded.append(name)
    missing = tuple(name for name in wanted if name not in sources)
    return LoadReport(tuple(loaded), missing, tuple(unexpected), tuple(ignored), tuple(mismatched))


def _match(weights: WeightFile, wanted: set[str]) -> tuple[dict[str, str], list[str], list[str]]:
    """The file's key for each of the network's, the keys to ignore, and those that nobody knows."""
    sources: dict[str, str] = {}
    ignored, unexpected = [], []
    for stored in weights.shapes:
        name = _strip(stored)
        if name in wanted:
            if name in sources:
                raise CheckpointError(f"{weights.path}: both {sources[name]} and {stored} would be {name}")
            sources[name] = stored
        elif name.startswith(_FOREIGN_PARTS):
            ignored.append(stored)
        else:
            unexpected.append(stored)
    return sources, ignored, unexpected


def _strip(key: str) -> str:
    while (prefix := next((p for p in _PREFIXES if key.startswith(p)), None)) is not None:
        key = key.removeprefix(prefix)
    return key


def _finite(value: Tensor, key: str, path: Path) -> Tensor:
    if value.is_floating_point() and not torch.isfinite(value).all():
        raise CheckpointError(f"{path}: {key} holds values that are not finite numbers")
    return value


def _stated_preset(weights: WeightFile) -> NetworkPreset | None:
    text = weights.metadata.get(_PRESET)
    if text is None:
        return None
    try:
        return NetworkPreset.model_validate_json(text)
    except ValidationError as error:
        problem = error.errors()[0]
        where = ".".join(map(str, problem["loc"])) or "preset"
        raise CheckpointError(f"{weights.path}: its preset cannot be used: {where}: {problem['msg']}") from error


def _check_exact(preset: NetworkPreset, weights: WeightFile) -> None:
    """Compare shapes before any memory is taken: the preset is as untrusted as the rest of the file."""
    with torch.device("meta"):
        needed = {name: tuple(value.shape) for name, value in Network(preset).state_dict().items()}
    if needed != dict(weights.shapes):
        differing = sorted(
            name for name in needed.keys() | weights.shapes.keys() if needed.get(name) != weights.shapes.get(name)
        )
        raise CheckpointError(
            f"{weights.path}: does not hold the {preset.name!r} network it names; "
            f"{len(differing)} tensors differ, first {differing[0]}"
        )


def _shape(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape)) or "scalar"
