"""What each part of the camera solver brings to a trained network: parts are switched off, nothing is trained.

    python benchmarks/camera_parts.py CHECKPOINT clips/source_val clips/shifted_val DATA_SET_FOLDER...

One line of JSON for each variant and folder: depth error, rotation error and motion over six frames, direction,
focal length. The depth of ``no depth correction`` is that of a single view.
"""

import argparse
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import torch
from torch import Tensor

from bathyscope_train.model import matching_camera_head
from bathyscope_train.model.checkpoints import load_network
from bathyscope_train.model.matching_camera_head import MatchingCameraHead
from bathyscope_train.model.network import Network
from bathyscope_train.pretrain import held_out_clips
from bathyscope_train.validation import validate

VARIANTS = ("all parts", "no loops", "no steps for far pairs", "no focal correction", "no depth correction", "true K")


@contextmanager
def without(network: Network, variant: str) -> Iterator[None]:
    """Switch a part of the camera head off."""
    head = network.camera_head
    assert isinstance(head, MatchingCameraHead)
    settings = head.settings
    try:
        if variant == "no loops":
            head.settings = settings.model_copy(update={"settling": 0})
        if variant == "no focal correction":
            head.settings = settings.model_copy(update={"focal_steps": 0})
        if variant == "no steps for far pairs":
            with patch.object(matching_camera_head, "follow_steps", lambda motion: motion):
                yield
        elif variant == "no depth correction":
            with patch.object(MatchingCameraHead, "correct_depth", _nothing):
                yield
        else:
            yield
    finally:
        head.settings = settings


def _nothing(head: MatchingCameraHead, clip: matching_camera_head.Clip, *others: object, **more: object) -> Tensor:
    return torch.zeros_like(clip.depth)


def main() -> None:
    """Measure every variant on every folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--clips", type=int, default=8)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    network = load_network(arguments.checkpoint)[0]
    for folder in arguments.folders:
        clips = held_out_clips(folder, arguments.clips)
        for variant in VARIANTS:
            with without(network, variant):
                result, _ = validate(network, clips, known_focal=variant == "true K")
            print(json.dumps({"variant": variant, "data": folder.name, **json.loads(result.as_json())}), flush=True)


if __name__ == "__main__":
    main()
