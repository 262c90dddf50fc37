"""What a network is made of: one frozen settings tree, from which :class:`~.network.Network` is built.

A checkpoint and a bundle carry the preset they were made with, so both are self-describing. A part that
comes in several kinds has a ``kind`` field; the factories beside the parts read it.
"""

from types import MappingProxyType
from typing import Annotated, Literal, Self

from pydantic import BaseModel, Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from bathyscope.errors import SettingsError

Repeats = Annotated[int, Field(ge=1, le=128)]
"""How often a part is repeated; bounded, because a preset may come out of somebody else's checkpoint."""


class VitSettings(BaseModel, frozen=True, extra="forbid"):
    """DINOv2 vision transformer as image encoder; its width is the aggregator's."""

    kind: Literal["vit"] = "vit"
    depth: Repeats = 24
    heads: PositiveInt = 16
    registers: NonNegativeInt = 4
    grid: PositiveInt = Field(default=37, description="Side of the learnt position grid, in patches (518 / 14).")
    layer_scale: PositiveFloat = 1.0


class ConvStemSettings(BaseModel, frozen=True, extra="forbid"):
    """Small convolutional pyramid as image encoder; keeps its maps for the heads."""

    kind: Literal["conv"] = "conv"
    channels: PositiveInt = Field(
        default=32, description="Of the half-size map; the quarter-size map has twice as many."
    )
    encoder: Literal["lite0"] | None = Field(
        default=None, description="Pre-trained encoder whose features are added: EfficientNet-Lite0."
    )


class AggregatorSettings(BaseModel, frozen=True, extra="forbid"):
    """Alternating attention within each frame and across the clip."""

    width: PositiveInt = 1024
    depth: Repeats = Field(default=24, description="Pairs of a frame block and a global block.")
    heads: PositiveInt = 16
    registers: NonNegativeInt = 4
    mlp_ratio: PositiveInt = 4
    rope_base: PositiveFloat = 100.0
    layer_scale: PositiveFloat = 0.01
    taps: tuple[NonNegativeInt, ...] = Field(default=(4, 11, 17, 23), description="Pairs whose output the heads read.")

    @model_validator(mode="after")
    def _sizes_fit(self) -> Self:
        if self.width % self.heads or (self.width // self.heads) % 4:
            raise ValueError(f"width {self.width} over {self.heads} heads must be a multiple of 4 a head")
        if list(self.taps) != sorted(set(self.taps)) or not self.taps or self.taps[-1] >= self.depth:
            raise ValueError(f"taps {self.taps} must rise and stay below the depth of {self.depth} pairs")
        return self


class IterativeCameraSettings(BaseModel, frozen=True, extra="forbid"):
    """Camera head that refines a pose encoding from the camera tokens alone."""

    kind: Literal["iterative"] = "iterative"
    depth: Repeats = 4
    heads: PositiveInt = 16
    iterations: Repeats = 4
    layer_scale: PositiveFloat = 0.01


class MatchingCameraSettings(BaseModel, frozen=True, extra="forbid"):
    """Camera head that solves for motion from learnt matches and the predicted depth."""

    kind: Literal["matching"] = "matching"
    rounds: Repeats = 2
    iterations: Repeats = Field(default=3, description="Solver iterations a round.")
    focal_steps: Repeats = Field(default=2, description="Corrections of the focal length by the motions.")
    final_iterations: Repeats = Field(default=2, description="Solver iterations with the corrected depth.")
    flow_noise: NonNegativeFloat = Field(
        default=0.0, description="How far small motions are held back: variance against the seen flow, cells^2."
    )
    settling: Repeats = Field(default=8, description="Steps that bring all motions of a clip together.")


class DptSettings(BaseModel, frozen=True, extra="forbid"):
    """Dense prediction transformer head: four tapped layers fused into one full-size map."""

    kind: Literal["dpt"] = "dpt"
    features: PositiveInt = Field(default=256, multiple_of=8)
    channels: tuple[PositiveInt, PositiveInt, PositiveInt, PositiveInt] = (256, 512, 1024, 1024)
    hidden: PositiveInt = Field(default=32, description="Width between the last two convolutions.")


class LightHeadSettings(BaseModel, frozen=True, extra="forbid"):
    """Small dense head that leans on the maps of a convolutional stem."""

    kind: Literal["light"] = "light"
    coarse: PositiveInt = Field(default=64, multiple_of=4, description="Channels at a quarter of the size.")
    fine: PositiveInt = Field(default=16, description="Channels at full size.")
    blocks: Repeats = Field(default=2, description="Residual convolutions a level.")


class SceneSettings(BaseModel, frozen=True, extra="forbid"):
    """How raw maps become cameras and Gaussians; the defaults are ours, the ``anysplat`` preset keeps its own."""

    pixel_center: float = Field(default=0.5, description="Added to the pixel index before unprojection: 0 or 0.5.")
    focal_epsilon: float = Field(default=0.0, description="Added to tan(fov / 2) when a focal length is decoded.")
    activation: Literal["anysplat", "footprint"] = "footprint"
    opacity_exponent: float = Field(default=0.0, description="x of the opacity mapping; 0 leaves the sigmoid alone.")
    voxel_size: PositiveFloat | None = Field(default=None, description="Cell of the voxel fusion, world units.")


class NetworkPreset(BaseModel, frozen=True, extra="forbid"):
    """Everything needed to build a network; defaults are the published full size."""

    name: str
    patch_size: PositiveInt = 14
    stem: Annotated[VitSettings | ConvStemSettings, Field(discriminator="kind")] = VitSettings()
    aggregator: AggregatorSettings = AggregatorSettings()
    camera: Annotated[IterativeCameraSettings | MatchingCameraSettings, Field(discriminator="kind")] = (
        IterativeCameraSettings()
    )
    depth: Annotated[DptSettings | LightHeadSettings, Field(discriminator="kind")] = DptSettings()
    gaussians: Annotated[DptSettings | LightHeadSettings, Field(discriminator="kind")] | None = DptSettings(hidden=128)
    harmonic_degree: int = Field(default=4, ge=0, le=4, description="Degree L of the spherical harmonics.")
    scene: SceneSettings = SceneSettings()

    @property
    def gaussian_channels(self) -> int:
        """Raw channels of a Gaussian without the fusion confidence: opacity, 3 scales, 4 rotation, 3 (L+1)^2 colour."""
        return 8 + 3 * (self.harmonic_degree + 1) ** 2

    @model_validator(mode="after")
    def _parts_that_read_the_stem_have_one(self) -> Self:
        light = [self.camera.kind == "matching", self.depth.kind == "light"]
        light.append(self.gaussians is not None and self.gaussians.kind == "light")
        if any(light) and self.stem.kind != "conv":
            raise ValueError(f"light heads and the matching camera head need a conv stem, got {self.stem.kind!r}")
        return self

    @model_validator(mode="after")
    def _dpt_reads_four_layers(self) -> Self:
        if self.depth.kind == "dpt" and len(self.aggregator.taps) != 4:
            raise ValueError(f"a DPT head reads 4 tapped layers, got taps {self.aggregator.taps}")
        return self


_ANYSPLAT_SCENE = SceneSettings(pixel_center=0.0, focal_epsilon=1e-3, activation="anysplat", voxel_size=0.002)

_TINY = NetworkPreset(
    name="tiny",
    stem=ConvStemSettings(),
    aggregator=AggregatorSettings(width=192, depth=3, heads=3, registers=1, layer_scale=1.0, taps=(0, 1, 2)),
    camera=MatchingCameraSettings(),
    depth=LightHeadSettings(),
    gaussians=LightHeadSettings(coarse=32, fine=8, blocks=1),
    harmonic_degree=0,
)

_TINY_LITE0 = _TINY.model_copy(update={"name": "tiny-lite0", "stem": ConvStemSettings(encoder="lite0")})

_SMALL = NetworkPreset(
    name="small",
    stem=ConvStemSettings(channels=48),
    aggregator=AggregatorSettings(width=320, depth=5, heads=5, registers=2, layer_scale=1.0, taps=(0, 2, 4)),
    camera=MatchingCameraSettings(),
    depth=LightHeadSettings(coarse=96, fine=24),
    gaussians=LightHeadSettings(coarse=48, fine=16, blocks=1),
    harmonic_degree=0,
)

PRESETS = MappingProxyType(
    {
        "tiny": _TINY,
        "tiny-lite0": _TINY_LITE0,
        "small": _SMALL,
        "anysplat": NetworkPreset(name="anysplat", scene=_ANYSPLAT_SCENE),
        "vggt": NetworkPreset(
            name="vggt", gaussians=None, scene=SceneSettings(pixel_center=0.0, activation="anysplat")
        ),
    }
)
"""Built-in presets by name."""


def get_preset(name: str) -> NetworkPreset:
    """The built-in preset called ``name``.

    Raises:
        SettingsError: If there is none of that name.
    """
    if name not in PRESETS:
        raise SettingsError(f"no preset {name!r}; built-in presets are {', '.join(sorted(PRESETS))}")
    return PRESETS[name]
