"""What a runtime must know of a network to feed it and to read its answers; a bundle's manifest says it.

Two kinds: *scene* networks give depth, cameras and (most of them) Gaussians of a window of frames in one world; *video*
networks give one map a frame and nothing else.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field, PositiveFloat, PositiveInt, model_validator

from bathyscope.depth_range import DepthRange
from bathyscope.keyed_windows import KeyedWindows

Kind = Literal["scene", "video"]
Output = Literal["depth", "disparity", "confidence", "cameras", "gaussians"]


class _Strict(BaseModel, frozen=True, extra="forbid"):
    """Frozen, and unknown fields are refused."""


class InputSpec(_Strict):
    """What the network wants to be fed."""

    patch: PositiveInt = Field(description="Height and width must be multiples of this.")
    pixels: PositiveInt = Field(description="Area (height x width) that the network works best at.")
    window: PositiveInt = Field(description="Frames the network sees at once.")
    overlap: int = Field(ge=0, description="Frames that neighbouring windows share.")

    @model_validator(mode="after")
    def _windows_advance(self) -> InputSpec:
        if self.overlap >= self.window:
            raise ValueError(f"overlap ({self.overlap}) must be smaller than window ({self.window})")
        return self


class SceneSpec(_Strict):
    """How raw outputs of a scene network become cameras and Gaussians."""

    pixel_centre: float = Field(ge=0, le=0.5, description="Where in a pixel its depth is unprojected; AnySplat: 0.")
    focal_epsilon: float = Field(ge=0, le=0.1, description="Added to tan(fov / 2); AnySplat 1e-3, VGGT 0.")
    activation: Literal["anysplat", "footprint"]
    sh_degree: int = Field(ge=0, le=4)
    voxel_size: PositiveFloat | None = Field(default=None, description="Fuse Gaussians in cubes of this side.")
    opacity_exponent: float = Field(default=0.0, description="x of AnySplat's opacity mapping; 0 is no mapping.")
    gaussians: bool = Field(default=True, description="Whether there are any; without, depth is the depth head's.")


class ResizeSpec(_Strict):
    """How a frame becomes a video network's input: aspect kept, sides multiples of the patch, bicubic."""

    least: tuple[PositiveInt, PositiveInt] = Field(description="Height and width that the input has at least.")
    lower_long: bool = Field(default=False, description="Lower `least` for frames longer than 16:9.")
    back: Literal["corners", "centres"] = Field(
        default="corners",
        description="How values go back to the size of the frame, bilinearly: 'corners' keeps the values of the corner "
        "pixels, 'centres' has the centre of the first pixel at (0.5, 0.5), as OpenCV has.",
    )

    @model_validator(mode="after")
    def _long_frames_are_measured_by_one_side(self) -> ResizeSpec:
        if self.lower_long and self.least[0] != self.least[1]:
            raise ValueError(f"lower_long lowers one shorter side; least must be a square, got {self.least}")
        return self


class VideoSpec(_Strict):
    """What a video network's values are, and how they are made."""

    quantity: Literal["depth", "disparity"]
    scale: Literal["metric", "relative", "affine"] = Field(
        description="'metric': in `unit`; 'relative': right up to one factor a clip; 'affine': up to factor and shift."
    )
    unit: Literal["m", "mm"] | None = Field(default=None, description="Of metric values.")
    resize: ResizeSpec
    windows: KeyedWindows | None = Field(description="How windows are cut and stitched; null: frame by frame.")
    depth_range: DepthRange | None = Field(
        default=None,
        description="The network says disparity between two depths, and that is resized and stitched; it becomes depth "
        "last, frame by frame, by this range. `quantity` is 'depth' then.",
    )

    @model_validator(mode="after")
    def _unit_fits(self) -> VideoSpec:
        if self.depth_range is not None and self.quantity != "depth":
            raise ValueError(f"with a depth_range the quantity is 'depth', got {self.quantity!r}")
        if (self.scale == "metric") != (self.unit is not None):
            raise ValueError(f"metric values, and only they, have a unit; scale is {self.scale!r}, unit {self.unit!r}")
        return self


class ModelSpec(_Strict):
    """A network: what it is called, how it is fed, what its outputs mean."""

    name: str
    version: str
    preset: str
    kind: Kind = "scene"
    input: InputSpec
    scene: SceneSpec | None = None
    video: VideoSpec | None = None
    licence: str

    @model_validator(mode="after")
    def _says_what_its_outputs_mean(self) -> ModelSpec:
        given = [name for name in ("scene", "video") if getattr(self, name) is not None]
        if given != [self.kind]:
            raise ValueError(f"a {self.kind} network must have the field {self.kind!r} and no other, got {given}")
        windows = None if self.video is None else self.video.windows
        if windows is not None and (self.input.window, self.input.overlap) != (windows.length, windows.overlap):
            raise ValueError(
                f"input says windows of {self.input.window} frames that share {self.input.overlap}, "
                f"video {windows.length} and {windows.overlap}"
            )
        return self

    @property
    def outputs(self) -> tuple[Output, ...]:
        """What a result holds."""
        if self.video is not None:
            return (self.video.quantity,)
        gaussians: tuple[Output, ...] = ("gaussians",) if self.scene is not None and self.scene.gaussians else ()
        return ("depth", "confidence", "cameras", *gaussians)
