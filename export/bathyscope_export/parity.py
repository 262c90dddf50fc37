"""How far the exported graphs, run by ONNX Runtime, are from the network in PyTorch."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from bathyscope.bundle import ROLES, GraphSpec, Role
from bathyscope.errors import BundleError
from bathyscope_train.model.network import Network, Prediction
from bathyscope_train.model.pose_encoding import decode_cameras
from bathyscope_train.model.unprojection import invert_rigid

SHAPES = ((1, 8, 10), (2, 8, 10), (4, 6, 9), (4, 10, 8), (8, 8, 10))
"""Clips to compare: frames, rows and columns of patches."""

MAX_DEPTH = 1e-4
MAX_POSE = 1e-5


@dataclass(frozen=True, slots=True)
class Difference:
    """Largest differences for one clip."""

    frames: int
    height: int
    width: int
    depth: float
    """Over the standard deviation of the depth."""
    confidence: float
    """Over its standard deviation."""
    gaussians: float
    """Over the standard deviation of each channel, at worst."""
    rotation: float
    """Angle between the camera rotations, radians."""
    translation: float
    """Between the camera centres, over the largest camera distance or, if that is more, the mean depth."""
    field_of_view: float
    """Radians."""
    rounding: float = 0.0
    """How far PyTorch's own depth moves, in the unit of ``depth``, when the last bit of the images changes."""

    def check(self) -> None:
        """Refuse differences that rounding does not explain.

        Raises:
            BundleError: If depth is off by more than 1e-4 of its standard deviation and three times what rounding does
                to it, or a pose by more than 1e-5.
        """
        most_depth = max(MAX_DEPTH, 3 * self.rounding)
        found = {"depth": self.depth, "rotation": self.rotation, "translation": self.translation}
        found["field_of_view"] = self.field_of_view
        wrong = [name for name, value in found.items() if not value <= (most_depth if name == "depth" else MAX_POSE)]
        if wrong:
            shape = f"{self.frames} frames of {self.height}x{self.width}"
            values = ", ".join(f"{name} {found[name]:.1e}" for name in wrong)
            raise BundleError(
                f"the exported graphs differ from PyTorch on {shape}: {values} "
                f"(at most {most_depth:.1e} for depth, {MAX_POSE:.0e} for poses)"
            )

    def record(self) -> dict[str, Any]:
        """As it goes into the manifest."""
        return asdict(self)


def compare(
    network: Network, folder: Path, graphs: Mapping[Role, GraphSpec], shapes: tuple[tuple[int, int, int], ...] = SHAPES
) -> list[Difference]:
    """Differences for clips of several lengths and sizes.

    Args:
        network: The network the graphs were traced from, in evaluation mode.
        folder: Where the graphs lie.
        graphs: Their files, inputs and outputs.
        shapes: Frames, rows and columns of each clip.
    """
    sessions = {role: start(folder / graph.file) for role, graph in graphs.items()}
    differences = []
    for frames, rows, columns in shapes:
        patch = network.preset.patch_size
        images = sample_clip(frames, patch * rows, patch * columns)
        with torch.no_grad():
            expected = network(images[None])
            nudged = network(_last_bit(images)[None])
        observed = run_graphs(sessions, graphs, images.numpy())
        rounding = spread(expected.maps.depth[0], nudged.maps.depth[0].numpy())
        differences.append(replace(_difference(expected, observed), rounding=rounding))
    return differences


def sample_clip(frames: int, height: int, width: int) -> Tensor:
    """Frames (t, 3, h, w) that slide over one smooth random texture, as a moving camera would show."""
    generator = torch.Generator().manual_seed(frames * height * width)
    coarse = torch.rand(1, 3, height // 7, width // 7 + frames, generator=generator)
    texture = F.interpolate(coarse, size=(height, width + 4 * frames), mode="bilinear", align_corners=True)[0]
    texture = 0.8 * texture + 0.2 * torch.rand(texture.shape, generator=generator)
    return torch.stack([texture[:, :, 3 * frame : 3 * frame + width] for frame in range(frames)])


def _last_bit(images: Tensor) -> Tensor:
    """The images with the last bit of a third of their values up, and of a third down."""
    generator = torch.Generator().manual_seed(0)
    steps = torch.randint(-1, 2, images.shape, generator=generator)
    return images * (1 + torch.finfo(images.dtype).eps * steps)


def run_graphs(
    sessions: Mapping[Role, ort.InferenceSession],
    graphs: Mapping[Role, GraphSpec],
    images: NDArray[np.float32],
    order: tuple[Role, ...] = ROLES["scene"],
) -> dict[str, NDArray[np.float32]]:
    """Everything that the graphs say about frames (t, 3, h, w), by name."""
    known = {"images": images, "focal": np.zeros(1, np.float32)}
    for role in order:
        graph = graphs[role]
        values = sessions[role].run(list(graph.outputs), {name: known[name] for name in graph.inputs})
        known |= dict(zip(graph.outputs, values, strict=True))
    return known


def start(path: Path) -> ort.InferenceSession:
    """A graph, loaded by ONNX Runtime."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def _difference(expected: Prediction, observed: Mapping[str, NDArray[np.float32]]) -> Difference:
    maps = expected.maps
    size = (maps.depth.shape[-2], maps.depth.shape[-1])
    encodings = expected.pose_encoding[0].double(), torch.from_numpy(observed["pose_encoding"]).double()
    poses = [invert_rigid(decode_cameras(encoding, size).camera_from_world) for encoding in encodings]
    centres = [pose[:, :3, 3] for pose in poses]
    scale = max(centres[0].norm(dim=-1).max().item(), maps.depth.mean().item())
    turn = poses[0][:, :3, :3].transpose(-1, -2) @ poses[1][:, :3, :3]
    # The angle of a small rotation from its antisymmetric part: arccos of the trace loses half the digits.
    sine = torch.stack((turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]), 1)
    return Difference(
        frames=maps.depth.shape[1],
        height=size[0],
        width=size[1],
        depth=spread(maps.depth[0], observed.get("refined_depth", observed["depth"])),
        confidence=spread(maps.confidence[0], observed["confidence"]),
        gaussians=_gaussian_difference(maps.gaussians, observed),
        rotation=(sine.norm(dim=-1) / 2).max().item(),
        translation=(centres[0] - centres[1]).norm(dim=-1).max().item() / scale,
        field_of_view=(encodings[0][:, 7:] - encodings[1][:, 7:]).abs().max().item(),
    )


def _gaussian_difference(expected: Tensor | None, observed: Mapping[str, NDArray[np.float32]]) -> float:
    if expected is None:
        return 0.0
    channels = range(expected.shape[2])
    return max(spread(expected[0, :, channel], observed["gaussians"][:, channel]) for channel in channels)


def spread(expected: Tensor, observed: NDArray[np.float32]) -> float:
    """Largest difference over the standard deviation; plain relative error hides errors in a nearly constant map."""
    difference = np.abs(observed.astype(np.float64) - expected.double().numpy()).max()
    return float(difference / max(expected.double().std().item(), 1e-12))
