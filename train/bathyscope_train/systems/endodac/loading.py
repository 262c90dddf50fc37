"""Published EndoDAC weights into networks: the depth network alone, or a folder with the pose networks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torch import nn

from bathyscope.errors import CheckpointError
from bathyscope_train.model.weight_files import WeightFile, open_weights
from bathyscope_train.systems.depth_anything.option_sets import encoder_options
from bathyscope_train.systems.endodac.network import DepthNetwork
from bathyscope_train.systems.endodac.pose import IntrinsicsHead, PoseDecoder
from bathyscope_train.systems.endodac.resnet import PairEncoder
from bathyscope_train.systems.endodac.settings import DEPTH_SETTINGS, DepthSettings
from bathyscope_train.systems.endodac.training import TrainingNetworks
from bathyscope_train.systems.kinds import bare
from bathyscope_train.systems.loading import load_exactly

DEPTH_FILE = "depth_model.pth"
POSE_ENCODER_FILE, POSE_FILE, INTRINSICS_FILE = "pose_encoder.pth", "pose.pth", "intrinsics_head.pth"


@dataclass(frozen=True, slots=True)
class PoseNetworks:
    """What makes cameras."""

    encoder: PairEncoder
    decoder: PoseDecoder
    intrinsics: IntrinsicsHead | None
    """None where intrinsics were not learnt."""

    @property
    def modules(self) -> tuple[nn.Module, ...]:
        """All of them."""
        return tuple(each for each in (self.encoder, self.decoder, self.intrinsics) if each is not None)


@dataclass(frozen=True, slots=True)
class EndoDacNetworks:
    """What runs at inference, in evaluation mode."""

    depth: DepthNetwork
    pose: PoseNetworks | None
    """None without the pose networks' files: depth only, no cameras."""


def load_networks(path: Path) -> EndoDacNetworks:
    """The networks of a depth checkpoint, or of a folder with :data:`DEPTH_FILE` and, if there, the pose networks.

    Raises:
        CheckpointError: If a file cannot be read or does not hold exactly its network, or a folder has one of the two
            pose networks without the other.
    """
    if not path.is_dir():
        return EndoDacNetworks(load_depth(path), None)
    return EndoDacNetworks(load_depth(path / DEPTH_FILE), load_pose(path))


def load_depth(path: Path) -> DepthNetwork:
    """The depth network of a checkpoint, with the adapters and necks that its keys tell.

    Raises:
        CheckpointError: If the file is not exactly one of EndoDAC's depth networks.
    """
    weights = open_weights(path)
    settings = settings_of(weights)
    network = DepthNetwork(settings)
    adapter = settings.adapter or "no adapter"
    load_exactly(network, weights, f"depth network of EndoDAC, width {settings.width}, {adapter}")
    return network.eval()


def settings_of(weights: WeightFile) -> DepthSettings:
    """Which of the published depth networks a file holds.

    Raises:
        CheckpointError: If it holds none: its encoder is of another width, or there is none.
    """
    shapes = {bare(key): shape for key, shape in weights.shapes.items()}
    positions = shapes.get("encoder.pos_embed")
    if positions is None:
        raise CheckpointError(
            f"{weights.path}: no depth network of EndoDAC: {len(shapes)} tensors, like {next(iter(shapes), '-')}, and "
            f"no encoder.pos_embed; give the project's {DEPTH_FILE}"
        )
    sizes = {settings.width: settings for settings in DEPTH_SETTINGS.values()}
    if positions[-1] not in sizes:
        raise CheckpointError(
            f"{weights.path}: an encoder of width {positions[-1]}; EndoDAC has {' and '.join(map(str, sorted(sizes)))}"
        )
    options = encoder_options(shapes, "encoder.")
    return sizes[positions[-1]].model_copy(
        update={"adapter": options.adapter, "rank": options.rank, "neck": options.neck}
    )


def load_pose(folder: Path) -> PoseNetworks | None:
    """The pose networks of a folder; None if it has none.

    Raises:
        CheckpointError: If there is one without the other, or a file does not hold exactly its network.
    """
    files = {name: folder / name for name in (POSE_ENCODER_FILE, POSE_FILE)}
    there = [name for name, file in files.items() if file.is_file()]
    if not there:
        return None
    if len(there) < len(files):
        absent = next(name for name in files if name not in there)
        raise CheckpointError(f"{folder}: has {there[0]} but no {absent}; add it for cameras, or remove {there[0]}")
    encoder, decoder = PairEncoder(), PoseDecoder()
    load_exactly(encoder, open_weights(files[POSE_ENCODER_FILE]), "pose encoder of EndoDAC")
    load_exactly(decoder, open_weights(files[POSE_FILE]), "pose decoder of EndoDAC")
    intrinsics = None
    if (folder / INTRINSICS_FILE).is_file():
        intrinsics = IntrinsicsHead()
        load_exactly(intrinsics, open_weights(folder / INTRINSICS_FILE), "intrinsics head of EndoDAC")
        intrinsics.eval()
    return PoseNetworks(encoder.eval(), decoder.eval(), intrinsics)


def load_training(folder: Path) -> TrainingNetworks:
    """All networks beside depth from a folder of the public project, one file each; in evaluation mode.

    Raises:
        CheckpointError: If a file is missing or does not hold exactly its network. A folder without intrinsics head is
            one of a training with known intrinsics.
    """
    networks = TrainingNetworks(learn_intrinsics=(folder / INTRINSICS_FILE).is_file())
    for name, network in networks.named_children():
        load_exactly(network, open_weights(folder / f"{name}.pth"), f"{name} network of EndoDAC")
    return networks.eval()
