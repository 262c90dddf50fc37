"""Weights in files from anywhere: safetensors, or PyTorch's zip format. Nothing in them is ever executed.

A tensor is read when it is asked for, so that a file may be larger than memory has room for twice.
"""

import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from bathyscope.errors import CheckpointError

_WRAPPERS = ("state_dict", "model_state_dict", "model", "network")


@dataclass(frozen=True, slots=True)
class WeightFile:
    """Names and shapes of what a file holds, and a way to read one tensor of it."""

    path: Path
    shapes: Mapping[str, tuple[int, ...]]
    metadata: Mapping[str, str]
    """Text that came with the weights; empty for PyTorch files."""
    _read: Callable[[str], Tensor]

    def read(self, name: str) -> Tensor:
        """One tensor, as stored.

        Raises:
            CheckpointError: If its bytes cannot be read.
        """
        try:
            return self._read(name)
        except (SafetensorError, RuntimeError, ValueError, OSError) as error:
            raise CheckpointError(f"{self.path}: {name} cannot be read ({error})") from error


def open_weights(path: Path | str) -> WeightFile:
    """Open a safetensors file or a PyTorch file (zip format), told apart by their first bytes.

    Raises:
        CheckpointError: If there is no such file, it is damaged, or it holds anything but tensors.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file; give a .safetensors or a PyTorch checkpoint")
    with path.open("rb") as file:
        head = file.read(9)
    if head[:4] == b"PK\x03\x04":
        return _open_torch(path)
    if head[:2] == b"\x80\x02":
        raise CheckpointError(f"{path}: a PyTorch file from before version 1.6; save it again with a newer PyTorch")
    if head[8:9] == b"{":
        return _open_safetensors(path)
    raise CheckpointError(f"{path}: neither safetensors nor a PyTorch checkpoint (first bytes {head[:8]!r})")


def _open_safetensors(path: Path) -> WeightFile:
    try:
        file = safe_open(path, framework="pt", device="cpu")
        shapes = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118 (no iterator)
        metadata = file.metadata() or {}
    except (SafetensorError, OSError, ValueError) as error:
        raise CheckpointError(f"{path}: damaged safetensors file ({error})") from error
    return WeightFile(path, shapes, metadata, file.get_tensor)


def _open_torch(path: Path) -> WeightFile:
    _check_archive(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except UnpicklingError as error:
        reason = str(error).splitlines()[0]
        raise CheckpointError(
            f"{path}: holds Python objects besides tensors, which could run code; "
            f"save only the state_dict, or convert it to safetensors ({reason})"
        ) from error
    except Exception as error:  # the unpickler raises whatever a damaged stream makes it stumble over
        raise CheckpointError(f"{path}: damaged PyTorch checkpoint ({error})") from error
    tensors = _find_tensors(content)
    if not tensors:
        raise CheckpointError(f"{path}: no tensors in it; a checkpoint is a dictionary of named tensors")
    return WeightFile(path, {name: tuple(value.shape) for name, value in tensors.items()}, {}, tensors.__getitem__)


def _check_archive(path: Path) -> None:
    """PyTorch stores its members uncompressed; anything else may unpack to more than the file's size."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
    except (zipfile.BadZipFile, OSError, NotImplementedError) as error:
        raise CheckpointError(f"{path}: truncated or damaged PyTorch checkpoint ({error})") from error
    if not any(member.filename.endswith("/data.pkl") for member in members):
        raise CheckpointError(f"{path}: a zip file, but not a PyTorch checkpoint (no data.pkl in it)")
    packed = next((member.filename for member in members if member.compress_type != zipfile.ZIP_STORED), None)
    if packed is not None:
        raise CheckpointError(f"{path}: member {packed} is compressed; PyTorch checkpoints never are")


def _find_tensors(content: Any) -> dict[str, Tensor]:
    """The named tensors of a state dict, or of one that a training loop wrapped."""
    if not isinstance(content, dict):
        return {}
    tensors = {str(name): value for name, value in content.items() if isinstance(value, Tensor)}
    if tensors:
        return tensors
    return next((found for key in _WRAPPERS if (found := _find_tensors(content.get(key)))), {})
