"""*VDA + consistency* (Table 3): Video Depth Anything under L_3D and L_temp, with cameras of another system.

Its values become depth in the unit of the cameras, differentiably; what comes out is the geometry that the losses of
consistency optimisation take. It renders nothing, so L_rgb has no place here.
"""

import copy
from types import MappingProxyType
from typing import Self

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from bathyscope.errors import GeometryError
from bathyscope_train.consistency.geometry import ClipGeometry
from bathyscope_train.systems.camera_sources import CameraSource, ClipCameras
from bathyscope_train.systems.vda.network import VideoDepthAnything, normalised

RATES = MappingProxyType({"network.head": 0.1})
"""Times the learning rate, by the beginning of the parameters' names; all else is frozen.

Read as for AnySplat: heads are trained, what was pre-trained moves at a tenth of the rate, and the encoder stays.
"""
_SHARPNESS = 20.0
"""How soon inverse depth bends away from 0, over the median: at a fifth of it by half a per cent."""


class VdaGeometry(nn.Module):
    """The network and what turns its values into depth.

    *Relative* weights give disparity up to a scale and a shift. In every step both are fitted, without gradient, to
    the depth that comes with the cameras (medians and mean absolute deviations of inverse depth, clip by clip): the
    network can change the shape of its depth, but gains nothing by growing or shrinking it against the poses. Without
    such depth ``nominal_depth`` stands in for its median. *Metric* weights give metres: of them only the unit is
    fitted, clip by clip, to the median of that depth; without it ``units_a_metre`` says what the unit is.

    Args:
        network: In training; its encoder works without gradients unless one of its parameters has some.
        cameras: Where cameras come from; None if every call brings them.
        metric: Whether the weights are metric ones.
        units_a_metre: How many units of the poses one metre has.
        nominal_depth: Median depth, in the unit of the poses, of clips that come without depth.
        recompute: Work out the fine half of the head again going back: less memory for more time.
    """

    def __init__(
        self,
        network: VideoDepthAnything,
        cameras: CameraSource | None = None,
        *,
        metric: bool = False,
        units_a_metre: float = 1000.0,
        nominal_depth: float | None = None,
        recompute: bool = True,
    ) -> None:
        super().__init__()
        self.network = network
        self.cameras = cameras
        self.metric, self.units_a_metre = metric, units_a_metre
        self.nominal_depth, self.recompute = nominal_depth, recompute

    def forward(
        self,
        images: Float[Tensor, "b t 3 h w"],
        inside: Bool[Tensor, "b h w"] | None = None,
        known: ClipCameras | None = None,
    ) -> ClipGeometry:
        """Depth with gradients, cameras without.

        Args:
            images: RGB in [0, 1]; sides are multiples of the patch size.
            inside: Field of view, outside of which nothing is fitted; the whole image unless given.
            known: Cameras of these clips, like ground truth; those of the source unless given.

        Raises:
            GeometryError: If there are neither cameras nor a source of them, or a clip of relative values comes without
                depth and without a nominal one.
        """
        cameras = known if known is not None else self.borrowed(images)
        values = self.values(images)
        where = images.new_ones(values[:, 0].shape, dtype=torch.bool) if inside is None else inside
        if self.metric:
            depth = values * self._units(values.detach(), cameras.depth, where)
        else:
            scale, shift, median = self._fit(values.detach(), cameras.depth, where)
            depth = 1 / softly_positive(scale * values + shift, median)
        return ClipGeometry(depth, cameras.world_from_camera, cameras.intrinsics, None)

    def values(self, images: Float[Tensor, "b t 3 h w"]) -> Float[Tensor, "b t h w"]:
        """The network's own values, as :meth:`VideoDepthAnything.forward` gives them."""
        network = self.network
        b, t, _, height, width = images.shape
        size = (height, width)
        trained = any(value.requires_grad for value in network.pretrained.parameters())
        with torch.set_grad_enabled(trained and torch.is_grad_enabled()):
            taps = network.pretrained(normalised(images.flatten(0, 1)))
        head = network.head
        maps = head.mixed(taps, network.pretrained.token_grid(size), t)
        chunks = zip(*(each.split(head.frames_at_once) for each in maps), strict=True)
        if self.recompute and torch.is_grad_enabled():
            finished = [checkpoint(head.finish, *chunk, size, use_reentrant=False) for chunk in chunks]
        else:
            finished = [head.finish(path3, level2, level1, size) for path3, level2, level1 in chunks]
        stacked: Tensor = torch.cat(finished).unflatten(0, (b, t))
        return stacked

    def borrowed(self, images: Float[Tensor, "b t 3 h w"]) -> ClipCameras:
        """The source's cameras of these clips.

        Raises:
            GeometryError: If there is no source.
        """
        if self.cameras is None:
            raise GeometryError("a clip came without cameras, and there is no system to take them from")
        return self.cameras(images)

    def frozen_copy(self) -> Self:
        """The network as it is now, never trained: whose valid pixels the losses may be held to.

        The source of cameras is shared, not copied.
        """
        memo = {} if self.cameras is None else {id(self.cameras): self.cameras}
        return copy.deepcopy(self, memo).requires_grad_(False).eval()

    @torch.no_grad()
    def _units(self, values: Tensor, depth: Tensor | None, inside: Tensor) -> Tensor | float:
        """Units of the poses in a metre, (b, 1, 1, 1) where depth tells them clip by clip."""
        if depth is None:
            return self.units_a_metre
        ratios = []
        for clip, each in enumerate(values):
            counted = inside[clip].expand_as(each) & (depth[clip] > 0)
            wanted, found = (centre_and_spread(maps[counted])[0] for maps in (depth[clip], each))
            ratios.append(wanted / found.clamp_min(1e-6))
        return torch.stack(ratios)[:, None, None, None]

    @torch.no_grad()
    def _fit(self, values: Tensor, depth: Tensor | None, inside: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Scale, shift and median inverse depth (b, 1, 1, 1) of each clip."""
        fits = []
        for clip, each in enumerate(values):
            counted = inside[clip].expand_as(each)
            middle, spread = centre_and_spread(each[counted])
            if depth is not None:
                known = depth[clip][counted & (depth[clip] > 0)]
                wanted = centre_and_spread(1 / known)
            elif self.nominal_depth is not None:
                median = each.new_tensor(1 / self.nominal_depth)
                wanted = median, median * spread / middle.clamp_min(1e-6)
            else:
                raise GeometryError(
                    "disparity is known up to scale and shift; give cameras that come with depth, or a nominal depth"
                )
            scale = wanted[1] / spread.clamp_min(1e-6)
            fits.append(torch.stack((scale, wanted[0] - scale * middle, wanted[0])))
        scale, shift, median = torch.stack(fits, 1)[..., None, None, None]
        return scale, shift, median


def centre_and_spread(values: Float[Tensor, "n"]) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Median, and mean absolute deviation from it.

    Raises:
        GeometryError: If there are no values.
    """
    if values.numel() == 0:
        raise GeometryError("no pixel inside the field of view has depth to fit to")
    middle = values.median()
    return middle, (values - middle).abs().mean()


def softly_positive(values: Tensor, median: Tensor) -> Tensor:
    """``values`` where they are well above 0, a small positive number where they are below; has gradients anywhere."""
    sharpness = _SHARPNESS / median
    return F.softplus(sharpness * values) / sharpness
