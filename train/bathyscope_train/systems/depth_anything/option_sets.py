"""Which adapters and necks a checkpoint has, read off the names and shapes of its tensors."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

from bathyscope_train.systems.depth_anything.adapters import AdapterKind

_NECK = re.compile(r"blocks\.(\d+)\.residual_\.conv1\.weight")
Shapes = Mapping[str, tuple[int, ...]]


@dataclass(frozen=True, slots=True)
class EncoderOptions:
    """What was added to the encoder."""

    adapter: AdapterKind | None
    rank: int
    """Of a low-rank adapter; 1 where there is none."""
    neck: tuple[int, ...]


def encoder_options(shapes: Shapes, prefix: str) -> EncoderOptions:
    """Options of the encoder whose keys begin with ``prefix`` (``encoder.``).

    Only the first block is asked for its adapter: loading compares every key afterwards.
    """
    layer = f"{prefix}blocks.0.mlp.fc1."
    down, weight = shapes.get(f"{layer}lora_A"), shapes.get(f"{layer}weight")
    neck = tuple(
        sorted(int(match[1]) for key in shapes if (match := _NECK.fullmatch(key.removeprefix(prefix))) is not None)
    )
    if down is None or weight is None:
        return EncoderOptions(None, 1, neck)
    if down == (weight[-1], 1):
        return EncoderOptions("ssb", 1, neck)
    return EncoderOptions("dvlora" if f"{layer}lora_U" in shapes else "lora", max(1, down[0]), neck)
