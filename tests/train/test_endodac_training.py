"""EndoDAC's and EndoDAV's objectives, through all networks: what each trains, adds up, and that it can be lowered."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bathyscope.errors import CheckpointError, GeometryError
from bathyscope_train.losses.endodav import depth_flow_loss, depth_reprojection_loss
from bathyscope_train.systems.endodac import DepthNetwork, DepthSettings
from bathyscope_train.systems.endodac.loading import load_training
from bathyscope_train.systems.endodac.objective import EndoDacObjective
from bathyscope_train.systems.endodac.training import TrainingNetworks, depth_parameters
from bathyscope_train.systems.endodav import EndoDav, EndoDavSettings
from bathyscope_train.systems.endodav.objective import AgreementWeights, EndoDavObjective
from bathyscope_train.systems.endodav.training import parameters
from bathyscope_train.systems.vda.settings import VdaSettings

SMALL = DepthSettings(
    width=16, depth=4, heads=2, grid=4, image_size=(56, 70), features=8, channels=(4, 4, 8, 8), rank=2, neck=(1,)
)


@pytest.fixture(scope="module")
def objective() -> EndoDacObjective:
    torch.manual_seed(0)
    return EndoDacObjective(TrainingNetworks())


def frames() -> tuple[Tensor, list[Tensor]]:
    """A smooth texture that moves by two pixels a frame."""
    noise = torch.rand(1, 3, 18, 18, generator=torch.Generator().manual_seed(0))
    texture = F.interpolate(noise, (72, 72), mode="bicubic", align_corners=True).clamp(0, 1)
    return texture[..., 4:68, 4:68], [texture[..., 4:68, 2:66], texture[..., 4:68, 6:70]]


def trained(module: nn.Module) -> set[str]:
    """Children of ``module`` some of whose parameters have a gradient."""
    return {
        name
        for name, child in module.named_children()
        if any(value.grad is not None and value.grad.any() for value in child.parameters())
    }


def test_either_objective_trains_its_own_networks(objective: EndoDacObjective) -> None:
    target, sources = frames()
    depth = DepthNetwork(SMALL)
    depth_parameters(depth, 0)
    objective.networks.zero_grad()
    objective.flow(target, sources).backward()
    assert trained(objective.networks) == {"position_encoder", "position"}
    objective.networks.zero_grad()
    objective.scene(depth(target), target, sources).backward()
    assert trained(objective.networks) == {"pose_encoder", "pose", "intrinsics_head", "transform_encoder", "transform"}
    frozen = [name for name, value in depth.named_parameters() if value.grad is None]
    assert "encoder.blocks.0.mlp.fc1.weight" in frozen
    assert "encoder.blocks.0.mlp.fc1.lora_B" not in frozen
    assert "depth_head.conv_depth_1.head.0.weight" not in frozen


def test_steps_lower_the_flow_objective(objective: EndoDacObjective) -> None:
    target, (source, _) = frames()
    optimiser = torch.optim.Adam(objective.networks.flow_parameters(), lr=1e-4)
    losses = []
    for _ in range(2):
        loss = objective.flow(target, [source])
        losses.append(float(loss.detach()))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert losses[1] < losses[0]


def test_frames_without_neighbours_are_refused(objective: EndoDacObjective) -> None:
    with pytest.raises(GeometryError, match="got none; give the frames beside it"):
        objective.flow(frames()[0], [])


@pytest.mark.parametrize("size", [(32, 96), (64, 70)], ids=str)
def test_sizes_that_the_networks_cannot_take_are_refused(objective: EndoDacObjective, size: tuple[int, int]) -> None:
    target = torch.rand(1, 3, *size)
    with pytest.raises(
        GeometryError, match=f"frames of {size[0]}x{size[1]}; sides must be multiples of 32, 64 or more"
    ):
        objective.scene([target[:, :1]], target, [target])


VIDEO = EndoDavSettings(
    network=VdaSettings(width=16, depth=4, heads=2, taps=(0, 1, 2, 3), features=32, channels=(4, 4, 32, 32), grid=4),
    image_size=(28, 28),
    temporal_adapter=True,
    rank=2,
    neck=(),
)


def clip_and_network(objective: EndoDacObjective) -> tuple[Tensor, EndoDav]:
    torch.manual_seed(0)
    target, (before, after) = frames()
    objective.networks.zero_grad()
    return torch.stack((before, target, after), dim=1), EndoDav(VIDEO)


def test_agreement_of_adjacent_frames_is_added_in_temporal_turns(objective: EndoDacObjective) -> None:
    clips, network = clip_and_network(objective)
    with torch.no_grad():
        alone, both, neither = (
            EndoDavObjective(network, objective, weights).scene(clips, agreement=agreement)
            for weights, agreement in (
                (None, False),
                (AgreementWeights(2.0, 3.0), True),
                (AgreementWeights(0, 0), True),
            )
        )
        depth = objective.depth_of(network(clips)[0], clips[0])[None]
        motions, cameras = objective.motion(clips[0, 1:], clips[0, :-1])
        moved = depth_reprojection_loss(depth, motions[None], cameras.mean(0, keepdim=True))
        there, back = objective.flows(clips[0, 1:], clips[0, :-1])[0], objective.flows(clips[0, :-1], clips[0, 1:])[0]
        flowed = depth_flow_loss(depth, there[None], back[None])
    torch.testing.assert_close(alone, neither)
    torch.testing.assert_close(both, alone + 2 * moved + 3 * flowed)


def test_temporal_adapters_learn_from_their_turn_alone(objective: EndoDacObjective) -> None:
    clips, network = clip_and_network(objective)
    for module in network.head.motion_modules:
        nn.init.normal_(module.temporal_transformer.proj_out.weight, std=0.1)
    parameters(network, 400)
    EndoDavObjective(network, objective).scene(clips, agreement=True).backward()
    learnt = {name for name, value in network.named_parameters() if value.grad is not None and value.grad.any()}
    assert learnt
    assert all(name.startswith("head.motion_modules.") and ".lora_" in name for name in learnt)


def test_a_clip_of_two_frames_has_no_frame_between_neighbours(objective: EndoDacObjective) -> None:
    clips, network = clip_and_network(objective)
    with pytest.raises(GeometryError, match="a clip of 2 frames; 3 are needed"):
        EndoDavObjective(network, objective).flow(clips[:, :2])


def test_known_intrinsics_leave_no_head_to_train() -> None:
    with torch.device("meta"):
        networks = TrainingNetworks(learn_intrinsics=False)
    assert "intrinsics_head" not in dict(networks.named_children())


def test_a_folder_that_lacks_a_network_names_it(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"pose_encoder\.pth: no such file"):
        load_training(tmp_path)


def test_a_published_folder_holds_every_network_in_a_file_of_its_own(tmp_path: Path) -> None:
    with torch.device("meta"):
        networks = TrainingNetworks()
    for index, (name, network) in enumerate(networks.named_children()):
        tensors = {
            key: torch.full((1,) * value.ndim, index + 1, dtype=value.dtype).expand(value.shape)
            for key, value in network.state_dict().items()
        }
        torch.save(tensors, tmp_path / f"{name}.pth")
    loaded = load_training(tmp_path)
    for index, (_, network) in enumerate(loaded.named_children()):
        assert all((value == index + 1).all() for value in network.state_dict().values())
