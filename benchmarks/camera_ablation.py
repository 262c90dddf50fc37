"""What each ingredient of the matching camera head brings: the head is trained anew without it, on a frozen trunk.

    python benchmarks/camera_ablation.py CHECKPOINT clips/source clips/source_val clips/shifted_val --steps 200

Prints, for every variant, the median rotation error over the median true rotation of pairs six frames apart, and the
median cosine of the direction of translation. ``full`` is the head as it is; ``no match loss`` drops the two losses
that supervise correspondences; ``no motion loss`` drops those that reach trust and corrections through the solver;
``no correlation`` hides what the look-ups say; ``plain head`` regresses pose encodings from the camera tokens instead.
"""

import argparse
import json
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor, nn

from bathyscope_train.data.truth_clips import read_truth_clips
from bathyscope_train.data.windows import Batch, TruthClip, sample_window, stack
from bathyscope_train.losses.supervised import LossWeights, supervised_objective
from bathyscope_train.model import correspondence
from bathyscope_train.model.camera_head import CameraHead
from bathyscope_train.model.checkpoints import load_network
from bathyscope_train.model.network import Network, build_camera_head
from bathyscope_train.model.pose_encoding import encode_cameras
from bathyscope_train.model.unprojection import invert_rigid
from bathyscope_train.pretrain import draw_pairs, draw_solver_input
from bathyscope_train.validation import validate

_log = logging.getLogger("camera_ablation")
_ONLY_CAMERAS = {"depth": 0.0, "gradient": 0.0, "normals": 0.0, "confidence": 0.0, "gaussians": 0.0}
VARIANTS = {
    "full": {},
    "no match loss": {"matching": 0.0, "flow": 0.0},
    "no motion loss": {"motion": 0.0, "induced_flow": 0.0},
    "no correlation": {},
    "plain head": {},
}


class Trial:
    """One variant: a fresh camera head on the trunk of a checkpoint."""

    def __init__(self, checkpoint: Path, variant: str, steps: int) -> None:
        torch.manual_seed(0)
        self.network: Network = load_network(checkpoint)[0]
        self.variant, self.steps = variant, steps
        width = 2 * self.network.preset.aggregator.width
        plain = variant == "plain head"
        self.network.camera_head = (
            CameraHead(width=width, depth=2, heads=6, iterations=2, layer_scale=1.0)
            if plain
            else build_camera_head(self.network.preset)
        )
        self.network.requires_grad_(False)
        self.network.camera_head.requires_grad_(True)
        self.loss = LossWeights(**(_ONLY_CAMERAS | VARIANTS[variant]))

    def train(self, clips: Sequence[TruthClip]) -> None:
        """Adam with a cosine; the same windows for every variant."""
        optimizer = torch.optim.AdamW(self.network.camera_head.parameters(), lr=1e-3, betas=(0.9, 0.98))
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, self.steps)
        for step in range(self.steps):
            random = np.random.default_rng([7, step])
            batch = stack([sample_window(clips[int(random.integers(len(clips)))], random) for _ in range(2)])
            optimizer.zero_grad(set_to_none=True)
            loss = self.objective(batch, random, step)
            loss.backward()
            nn.utils.clip_grad_norm_(self.network.camera_head.parameters(), 1.0)
            optimizer.step()
            schedule.step()
            if step % 50 == 0:
                _log.info("%s: step %d, loss %.3f", self.variant, step, loss.item())

    def objective(self, batch: Batch, random: np.random.Generator, step: int) -> Tensor:
        """The camera terms of pre-training, or the distance of pose encodings for the plain head."""
        pairs = draw_pairs(batch.images.shape[1], 10, random)
        given = draw_solver_input(random, batch.images.shape[1], certain=step < self.steps // 4)
        if self.variant != "plain head":
            return supervised_objective(self.network, batch, pairs, self.loss, given).total
        with torch.no_grad():
            features = self.network.encode(batch.images)
        size = (batch.images.shape[-2], batch.images.shape[-1])
        intrinsics = torch.eye(3).repeat(*batch.images.shape[:2], 1, 1)
        intrinsics[..., 0, 0] = intrinsics[..., 1, 1] = batch.focal[:, None]
        wanted = encode_cameras(invert_rigid(batch.world_from_camera), intrinsics, size)
        encodings: Tensor = self.network.camera_head(features.camera)
        return (encodings - wanted).abs().mean()

    def measure(self, clips: Sequence[TruthClip]) -> dict[str, float]:
        """Rotation error over true rotation, and the cosine of the direction."""
        result, _ = validate(self.network.eval(), clips)
        return {
            "rotation": round(result.rotation_deg / result.rotation_true_deg, 3),
            "cosine": round(result.direction_cosine, 3),
        }


@contextmanager
def without_correlation() -> Iterator[None]:
    """Look-ups find nothing, and the best match of a point is where it was."""
    look_up: Callable[[Tensor, Tensor], Tensor] = correspondence.look_up
    correlate = correspondence.Matcher.correlate

    def blind(matcher: correspondence.Matcher, source: Tensor, target: Tensor) -> correspondence.Correlation:
        seen = correlate(matcher, source, target)
        still = seen.queries.expand_as(seen.best)
        return correspondence.Correlation(
            seen.logits * 0, seen.normaliser * 0, seen.queries, still, torch.zeros_like(seen.evidence)
        )

    with (
        patch.object(correspondence, "look_up", lambda logits, base: 0 * look_up(logits, base)),
        patch.object(correspondence.Matcher, "correlate", blind),
    ):
        yield


def main() -> None:
    """Run the variants and print a line of JSON for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("held_out", type=Path, nargs="+")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(1)
    clips = read_truth_clips(arguments.data)
    held_out = {folder.name: read_truth_clips(folder, limit=16) for folder in arguments.held_out}
    for variant in arguments.variants:
        trial = Trial(arguments.checkpoint, variant, arguments.steps)
        guard = without_correlation() if variant == "no correlation" else patch.dict({}, {})
        with guard:
            trial.train(clips)
            found = {name: trial.measure(each) for name, each in held_out.items()}
        print(json.dumps({"variant": variant, "steps": arguments.steps, **found}), flush=True)


if __name__ == "__main__":
    main()
