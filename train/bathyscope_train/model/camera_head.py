"""The iterative camera head: camera tokens to a pose encoding for every frame."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.blocks import Block, Mlp


class CameraHead(nn.Module):
    """Refines a running encoding (translation, quaternion xyzw, two fields of view) a few times.

    Each iteration modulates the camera tokens with the current encoding (adaptive LayerNorm), lets the frames
    of a clip attend to each other, and adds what comes out.

    Args:
        width: Channels of a camera token.
        depth: Blocks of the trunk.
        heads: Attention heads of the trunk.
        iterations: Number of refinements.
        mlp_ratio: Hidden width of the trunk's MLPs over ``width``.
        layer_scale: Initial factor of the trunk's residual branches.
    """

    def __init__(
        self, *, width: int, depth: int, heads: int, iterations: int, mlp_ratio: int = 4, layer_scale: float = 0.01
    ) -> None:
        super().__init__()
        self.iterations = iterations
        self.empty_pose_tokens = nn.Parameter(torch.zeros(1, 1, 9))
        self.trunk = nn.ModuleList(
            Block(width, heads, mlp_ratio=mlp_ratio, layer_scale=layer_scale) for _ in range(depth)
        )
        self.token_norm = nn.LayerNorm(width, eps=1e-5)
        self.trunk_norm = nn.LayerNorm(width, eps=1e-5)
        self.embed_pose = nn.Linear(9, width)
        self.poseLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 3 * width))
        self.pose_branch = Mlp(width, width // 2, 9)

    def forward(self, camera_tokens: Float[Tensor, "b t c"]) -> Float[Tensor, "i b t 9"]:
        """Pose encodings after each iteration; the last one is the prediction.

        The ReLU that keeps a field of view from being negative is applied to what is returned, and not to what the
        next iteration starts from.
        """
        b, t, _ = camera_tokens.shape
        tokens = self.token_norm(camera_tokens)
        running = self.empty_pose_tokens.expand(b, t, 9)
        encodings = []
        for iteration in range(self.iterations):
            delta = self._refine(tokens, running.detach() if iteration else running)
            running = running + delta if iteration else delta
            encodings.append(torch.cat((running[..., :7], F.relu(running[..., 7:])), dim=-1))
        return torch.stack(encodings)

    def _refine(self, tokens: Float[Tensor, "b t c"], encoding: Float[Tensor, "b t 9"]) -> Float[Tensor, "b t 9"]:
        shift, scale, gate = self.poseLN_modulation(self.embed_pose(encoding)).chunk(3, dim=-1)
        normed = F.layer_norm(tokens, tokens.shape[-1:], eps=1e-6)
        modulated = gate * (normed * (1 + scale) + shift) + tokens
        for block in self.trunk:
            modulated = block(modulated)
        delta: Tensor = self.pose_branch(self.trunk_norm(modulated))
        return delta
