"""One step forward, from frames to the objective: the module that several processes train together."""

import copy
from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bathyscope.errors import SettingsError
from bathyscope_train.consistency.geometry import ClipGeometry, encode, predict, predict_before
from bathyscope_train.consistency.objective import consistency_terms, weighted_sum
from bathyscope_train.consistency.rendering import ClipRendering, render_clip
from bathyscope_train.consistency.settings import ConsistencySettings
from bathyscope_train.losses.photometric import LEAST_OPACITY
from bathyscope_train.model.blocks import Block
from bathyscope_train.model.matching_camera_head import MatchingCameraHead
from bathyscope_train.model.network import Network
from bathyscope_train.render import Renderer

TOTAL, VARIATION, GROWTH = "total", "variation", "growth"
TRUNK = "aggregator"
DEPTH_CORRECTION = "refiner."
FLAT = 1e-6
"""Variation of depth within a frame is not taken below this."""


class ClipStep(nn.Module):
    """The network in training, the network as it was, and the objective between them.

    Args:
        network: In training.
        settings: Of the run.
        renderer: Differentiable splatting on the network's device.
        autocast: Run the transformer in bfloat16.

    Raises:
        SettingsError: If the objective asks for what the network has not.
    """

    def __init__(
        self, network: Network, settings: ConsistencySettings, renderer: Renderer, *, autocast: bool = False
    ) -> None:
        super().__init__()
        check_objective(network, settings)
        self.network = network
        self.trunk_trained = any(part.startswith(TRUNK) and each.rate > 0 for part, each in settings.parts.items())
        self.before = frozen_copy(network, whole=self.trunk_trained)
        self.settings, self.renderer, self.autocast = settings, renderer, autocast
        self.weights: dict[str, float] = settings.loss.weights
        if settings.checkpoint_activations and self.trunk_trained:
            checkpoint_blocks(network)

    def forward(
        self,
        images: Float[Tensor, "b t 3 h w"],
        inside: Bool[Tensor, "b h w"],
        focal: Float[Tensor, "b"] | None = None,
        progress: float = 1.0,
    ) -> dict[str, Float[Tensor, ""]]:
        """The terms by name, and with them their weighted sum, the variation of depth and the growth of the scene."""
        geometry, before = self.geometry(images, inside, focal)
        loss = self.settings.loss
        rendered = render_clip(geometry, self.renderer, loss.image, depth=loss.depth)
        terms = consistency_terms(
            rendered, geometry, before, images=images, inside=inside, settings=self.settings.loss, progress=progress
        )
        with torch.no_grad():
            started = within_frame_variation(before.depth, inside).clamp_min(FLAT)
            variation = within_frame_variation(rendered.depth, inside) / started
            growth = (geometry.depth / before.depth).log().mean()
        return {TOTAL: weighted_sum(terms, self.weights), **terms, VARIATION: variation, GROWTH: growth}

    def geometry(
        self, images: Tensor, inside: Tensor, focal: Tensor | None = None
    ) -> tuple[ClipGeometry, ClipGeometry]:
        """Of the network as it is, and as it was before training."""
        settings = self.settings
        features = encode(self.network, images, trained=self.trunk_trained, autocast=self.autocast)
        with torch.no_grad():
            own = encode(self.before, images, trained=False, autocast=self.autocast) if self.trunk_trained else features
            before, solved = predict_before(self.before, own, images, focal)
        frozen = not solver_trained(self.network)
        geometry = predict(
            self.network,
            features,
            images,
            inside,
            focal,
            cameras="given" if frozen and settings.cameras == "given" else "through",
            before=solved if frozen and settings.cameras == "before" else None,
            chunk=settings.dense_chunk,
        )
        return geometry, before

    @torch.no_grad()
    def look(self, images: Tensor, inside: Tensor, focal: Tensor | None = None) -> ClipRendering:
        """What is rendered of clips, for pictures: the image as the image term judges it."""
        geometry, _ = self.geometry(images, inside, focal)
        term = self.settings.loss.image
        rendered = render_clip(geometry, self.renderer, term)
        if not term.divide_by_opacity or rendered.image is None or rendered.image_opacity is None:
            return rendered
        opacity = rendered.image_opacity
        share = opacity.where(opacity >= LEAST_OPACITY, torch.ones_like(opacity))
        return replace(rendered, image=rendered.image / share[:, :, None])

    def weigh(self, weights: Mapping[str, float]) -> None:
        """Replace the factors of the terms."""
        self.weights = dict(weights)


def check_objective(network: Network, settings: ConsistencySettings) -> None:
    """Refuse what the network cannot be trained for.

    Raises:
        SettingsError: If images are asked for without Gaussians, or one frame's are to be left out of fused voxels; or
            if windows are not made of the network's patches.
    """
    name, image, preset = network.preset.name, settings.loss.image, network.preset
    if image.weight > 0 and preset.gaussians is None:
        raise SettingsError(
            f"the network {name!r} has no Gaussians and renders no image; set loss.image.weight=0 to train it by depth"
        )
    if image.weight > 0 and image.views == "others" and preset.scene.voxel_size is not None:
        raise SettingsError(
            f"the network {name!r} fuses the Gaussians of all frames into voxels, which belong to no frame that could "
            "be left out; set loss.image.views=all"
        )
    if settings.loss.matches.weight > 0 and (
        settings.cameras != "given" or not isinstance(network.camera_head, MatchingCameraHead)
    ):
        raise SettingsError(
            f"loss.matches compares with the matches of a camera head that is taken as given; the network {name!r} has "
            f"{'one' if isinstance(network.camera_head, MatchingCameraHead) else 'none'}, cameras is "
            f"{settings.cameras!r}; set loss.matches.weight=0"
        )
    if settings.window.patch != preset.patch_size:
        raise SettingsError(
            f"the network {name!r} has patches of {preset.patch_size} pixels, window.patch is {settings.window.patch}"
        )


def solver_trained(network: Network) -> bool:
    """Whether cameras are trained; the correction of depth by parallax, which belongs to their head, does not count."""
    return any(
        value.requires_grad
        for name, value in network.camera_head.named_parameters()
        if not name.startswith(DEPTH_CORRECTION)
    )


def frozen_copy(network: Network, *, whole: bool) -> Network:
    """The network as it is now, without its Gaussian head, and without its trunk unless ``whole``: never trained."""
    left_out = [network.gaussian_param_head, None if whole else network.aggregator]
    before = copy.deepcopy(network, {id(part): nn.Identity() for part in left_out if part is not None})
    before.gaussian_param_head = None
    return before.requires_grad_(False).eval()


def within_frame_variation(depth: Float[Tensor, "b t h w"], inside: Bool[Tensor, "b h w"]) -> Float[Tensor, ""]:
    """Standard deviation of log depth within a frame, mean over frames; pixels without depth do not count."""
    valid = inside[:, None] & (depth > 0)
    count = valid.sum((-2, -1)).clamp_min(1)
    logarithm = depth.where(valid, depth.new_ones(())).log()
    mean = logarithm.sum((-2, -1)) / count
    square = ((logarithm - mean[..., None, None]) ** 2 * valid).sum((-2, -1)) / count
    return square.sqrt().mean()


def checkpoint_blocks(network: Network) -> None:
    """Have every block of the transformer work out its activations again on the way back."""
    from functools import partial

    from torch.utils.checkpoint import checkpoint

    for module in network.aggregator.modules():
        if isinstance(module, Block):
            module.forward = partial(checkpoint, module.forward, use_reentrant=False)  # type: ignore[method-assign]
