"""EndoDAC's U-Net decoders: where a pixel goes (optical flow) and how its colour changes (appearance flow).

Both read the features of :class:`~.resnet.PairEncoder`, and are used in training only.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.systems.endodac.resnet import CHANNELS

DECODED = (16, 32, 64, 128, 256)
"""Channels of the decoder at 1, 1/2, 1/4, 1/8 and 1/16 of the size of the image."""

SCALES = 4


class ReflectedConv(nn.Module):
    """conv3x3 whose border is a reflection."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, padding=1, padding_mode="reflect")

    def forward(self, maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c2 h w"]:
        result: Tensor = self.conv(maps)
        return result


class ConvElu(nn.Module):
    """Reflected conv3x3, ELU."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = ReflectedConv(inputs, outputs)

    def forward(self, maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c2 h w"]:
        return F.elu(self.conv(maps))


class UNetDecoder(nn.Module):
    """Five rounds of conv, twice the size (bilinear, half-pixel), skip, conv; an output layer at the finest four.

    ``decoder`` holds the ten convolutions, coarse to fine, then the four output layers, fine to coarse.
    """

    def __init__(self, outputs: Sequence[nn.Module]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for level in reversed(range(len(DECODED))):
            inputs = CHANNELS[-1] if level == len(DECODED) - 1 else DECODED[level + 1]
            skip = CHANNELS[level - 1] if level > 0 else 0
            layers += [ConvElu(inputs, DECODED[level]), ConvElu(DECODED[level] + skip, DECODED[level])]
        self.decoder = nn.ModuleList([*layers, *outputs])

    def forward(self, features: Sequence[Float[Tensor, "n c h w"]]) -> tuple[Float[Tensor, "n k h2 w2"], ...]:
        """Maps at 1, 1/2, 1/4 and 1/8 of the size of the image, whose sides are multiples of 32."""
        maps, results = features[-1], []
        for index, level in enumerate(reversed(range(len(DECODED)))):
            maps = self.decoder[2 * index](maps)
            maps = F.interpolate(maps, scale_factor=2, mode="bilinear", align_corners=False)
            if level > 0:
                maps = torch.cat((maps, features[level - 1]), dim=1)
            maps = self.decoder[2 * index + 1](maps)
            if level < SCALES:
                results.append(self.decoder[2 * len(DECODED) + level](maps))
        return tuple(reversed(results))


class FlowDecoder(UNetDecoder):
    """Optical flow ("position") in pixels, channels in the order **(y, x)**; no bound."""

    def __init__(self) -> None:
        super().__init__([nn.Conv2d(DECODED[level], 2, 3, padding=1) for level in range(SCALES)])
        for output in self.decoder[2 * len(DECODED) :]:
            assert isinstance(output, nn.Conv2d)
            assert output.bias is not None
            nn.init.normal_(output.weight, std=1e-5)
            nn.init.zeros_(output.bias)


class AppearanceDecoder(UNetDecoder):
    """Change of colour ("transform") in (-1, 1) for red, green and blue."""

    def __init__(self) -> None:
        super().__init__([ReflectedConv(DECODED[level], 3) for level in range(SCALES)])

    def forward(self, features: Sequence[Float[Tensor, "n c h w"]]) -> tuple[Float[Tensor, "n 3 h2 w2"], ...]:
        return tuple(torch.tanh(maps) for maps in super().forward(features))
