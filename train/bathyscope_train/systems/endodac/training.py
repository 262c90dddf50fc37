"""What EndoDAC trains: two optimisers, and within the depth network what the step asks for.

On every batch the flow network is stepped alone (:meth:`TrainingNetworks.flow_parameters`,
:func:`~bathyscope_train.losses.endodac.flow_objective`), then depth, pose, intrinsics and appearance together
(:func:`depth_parameters` and :meth:`TrainingNetworks.scene_parameters`,
:func:`~bathyscope_train.losses.endodac.depth_objective`). Published: Adam at 1e-4 for both, a tenth of it every 10
epochs, 20 epochs, batches of 8 at 256x320.
"""

from torch import nn

from bathyscope_train.systems.depth_anything.schedule import WARM_UP, adapter_letters, added_parameters, train_only
from bathyscope_train.systems.endodac.flow_decoder import AppearanceDecoder, FlowDecoder
from bathyscope_train.systems.endodac.network import DepthNetwork
from bathyscope_train.systems.endodac.pose import IntrinsicsHead, PoseDecoder
from bathyscope_train.systems.endodac.resnet import PairEncoder


def depth_parameters(network: DepthNetwork, step: int, *, warm_up: int = WARM_UP) -> list[nn.Parameter]:
    """Freeze the depth network but for its adapters, necks and output layers; returns what trains at ``step``."""
    letters = adapter_letters(network.settings.adapter, step, warm_up=warm_up)
    outputs = [value for layer in network.depth_head.output_layers for value in layer.parameters()]
    return train_only([network], [*added_parameters(network.encoder, letters), *outputs])


class TrainingNetworks(nn.Module):
    """The networks that only training needs, and the two that give cameras; keys begin with the published file names.

    Args:
        learn_intrinsics: Whether there is an intrinsics head; without it the average over SCARED is used.
    """

    def __init__(self, *, learn_intrinsics: bool = True) -> None:
        super().__init__()
        self.pose_encoder, self.pose = PairEncoder(), PoseDecoder()
        self.intrinsics_head = IntrinsicsHead() if learn_intrinsics else None
        self.position_encoder, self.position = PairEncoder(), FlowDecoder()
        self.transform_encoder, self.transform = PairEncoder(), AppearanceDecoder()

    def flow_parameters(self) -> list[nn.Parameter]:
        """Of the first optimiser."""
        return _trainable(self.position_encoder, self.position)

    def scene_parameters(self) -> list[nn.Parameter]:
        """Of the second optimiser, beside :func:`depth_parameters`."""
        parts = [self.pose_encoder, self.pose, self.transform_encoder, self.transform]
        return _trainable(*parts, *([] if self.intrinsics_head is None else [self.intrinsics_head]))


def _trainable(*networks: nn.Module) -> list[nn.Parameter]:
    """All but what is stored and never read (classifiers, ``convs_suqeeze``), which asks for no gradient."""
    return [value for network in networks for value in network.parameters() if value.requires_grad]
