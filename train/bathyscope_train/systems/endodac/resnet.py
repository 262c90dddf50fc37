"""ResNet-18 as feature encoder of a pair of frames, named as in the published checkpoints."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

CHANNELS = (64, 64, 128, 256, 512)
"""Of the feature maps, at a half, a quarter ... a thirty-second of the size of the image."""

_CLASSES = 1000


class BasicBlock(nn.Module):
    """relu(bn(conv(relu(bn(conv(x))))) + x), 3x3; x is projected where its size or channels differ."""

    def __init__(self, inputs: int, outputs: int, *, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample: nn.Module = nn.Identity()
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(
                nn.Conv2d(inputs, outputs, 1, stride=stride, bias=False), nn.BatchNorm2d(outputs)
            )

    def forward(self, maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c2 h2 w2"]:
        hidden = F.relu(self.bn1(self.conv1(maps)))
        result: Tensor = F.relu(self.bn2(self.conv2(hidden)) + self.downsample(maps))
        return result


class ResNet18(nn.Module):
    """The convolutional part of ResNet-18. Its classifier ``fc`` is part of the checkpoints and never read."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.layer1 = self._layer(64, 64, stride=1)
        self.layer2 = self._layer(64, 128, stride=2)
        self.layer3 = self._layer(128, 256, stride=2)
        self.layer4 = self._layer(256, 512, stride=2)
        self.fc = nn.Linear(512, _CLASSES)
        self.fc.requires_grad_(False)

    @staticmethod
    def _layer(inputs: int, outputs: int, *, stride: int) -> nn.Sequential:
        return nn.Sequential(BasicBlock(inputs, outputs, stride=stride), BasicBlock(outputs, outputs, stride=1))

    def forward(self, images: Float[Tensor, "n k h w"]) -> tuple[Float[Tensor, "n c h2 w2"], ...]:
        """Five maps, fine to coarse, of :data:`CHANNELS`."""
        first = F.relu(self.bn1(self.conv1(images)))
        maps = [first, self.layer1(F.max_pool2d(first, 3, stride=2, padding=1))]
        for layer in (self.layer2, self.layer3, self.layer4):
            maps.append(layer(maps[-1]))
        return tuple(maps)


class PairEncoder(nn.Module):
    """Features of two frames stacked along the channels; colours in [0, 1] are not normalised."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = ResNet18(6)

    def forward(
        self, first: Float[Tensor, "n 3 h w"], second: Float[Tensor, "n 3 h w"]
    ) -> tuple[Float[Tensor, "n c h2 w2"], ...]:
        """Five maps, fine to coarse."""
        maps: tuple[Tensor, ...] = self.encoder(torch.cat((first, second), dim=1))
        return maps
