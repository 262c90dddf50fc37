"""Published EndoDAV weights into a network; the option set is read off the keys."""

from __future__ import annotations

from pathlib import Path

from bathyscope.errors import CheckpointError
from bathyscope_train.model.weight_files import WeightFile, open_weights
from bathyscope_train.systems.depth_anything.option_sets import encoder_options
from bathyscope_train.systems.endodav.network import EndoDav
from bathyscope_train.systems.endodav.settings import EndoDavSettings
from bathyscope_train.systems.kinds import bare
from bathyscope_train.systems.loading import load_exactly
from bathyscope_train.systems.vda.network import VideoDepthAnything
from bathyscope_train.systems.vda.settings import SIZES

_TEMPORAL = "head.motion_modules.0.temporal_transformer.transformer_blocks.0.ff.net.2.lora_A"


def load_endodav(path: Path) -> EndoDav:
    """The network of a checkpoint, in evaluation mode.

    Raises:
        CheckpointError: If the file is not exactly EndoDAV on ViT-S in one of its option sets.
    """
    weights = open_weights(path)
    settings = settings_of(weights)
    network = EndoDav(settings)
    load_exactly(network, weights, f"EndoDAV with {describe(settings)}")
    return network.eval()


def start_from_vda(network: EndoDav, path: Path) -> None:
    """Give a fresh network what its training begins with: the weights of Video Depth Anything, in the plain parts.

    Adapters, necks and sigmoid output layers keep their start, in which adapters and necks change nothing.

    Raises:
        CheckpointError: If the file does not hold exactly Video Depth Anything in the network's size.
    """
    plain = VideoDepthAnything(network.settings.network)
    load_exactly(plain, open_weights(path), f"Video Depth Anything of width {network.settings.network.width}")
    _, unknown = network.load_state_dict(plain.state_dict(), strict=False)
    assert all(".output_conv" in name for name in unknown), unknown


def settings_of(weights: WeightFile) -> EndoDavSettings:
    """The option set of a file. A sigmoid after the 'video' head leaves no trace in it and is taken not to be there.

    Raises:
        CheckpointError: If it is of another network, or on another encoder than ViT-S.
    """
    shapes = {bare(key): shape for key, shape in weights.shapes.items()}
    positions, sizes = shapes.get("pretrained.pos_embed"), SIZES["s"]
    if positions is None or not any(key.startswith("head.motion_modules.") for key in shapes):
        raise CheckpointError(
            f"{weights.path}: no EndoDAV: it has {len(shapes)} tensors, like {next(iter(shapes), '-')}, and lacks "
            "pretrained.pos_embed or head.motion_modules; give the depth_model.pth of that project"
        )
    wanted = (1, 1 + sizes.grid**2, sizes.width)
    if positions != wanted:
        raise CheckpointError(
            f"{weights.path}: a position table of shape {positions}, {wanted} was needed: EndoDAV can be used on ViT-S "
            "only (its ViT-L option cannot load the weights it starts from); train with --encoder vits"
        )
    options = encoder_options(shapes, "pretrained.")
    return EndoDavSettings(
        adapter=options.adapter,
        temporal_adapter=_TEMPORAL in shapes,
        rank=options.rank,
        neck=options.neck,
        head="sigmoid" if "head.conv_depth_1.head.0.weight" in shapes else "video",
    )


def describe(settings: EndoDavSettings) -> str:
    """The option set in words, for tables and messages."""
    adapter = settings.adapter or "no adapters"
    temporal = ", temporal ones too" if settings.temporal_adapter else ""
    neck = "neck" if settings.neck else "no neck"
    return f"{adapter}{temporal}, {neck}, {settings.head} head"
