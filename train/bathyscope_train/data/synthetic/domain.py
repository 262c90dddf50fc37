"""What a rendered domain may look like: ranges as data, read from a file or named in ``domains``."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, ValidationError, model_validator

from bathyscope.errors import SettingsError

Family = Literal["lumen", "cavity", "sinus", "larynx", "closeup", "indoor"]
Name = TypeVar("Name", bound=str)
View = Literal["round", "corners", "rectangle"]
Motion = Literal["forward", "sideways", "turning", "still", "orbit", "parallel"]


def _ordered(bounds: tuple[float, float]) -> tuple[float, float]:
    if not bounds[0] <= bounds[1]:
        raise ValueError(f"a range runs from low to high, got {bounds}")
    return bounds


Range = Annotated[tuple[float, float], AfterValidator(_ordered)]
"""A uniform range, both ends included."""

Share = Annotated[float, Field(ge=0.0, le=1.0)]


class _Ranges(BaseModel, frozen=True, extra="forbid"):
    """Strict and frozen, so that a domain can be written down beside what it rendered."""


class LightRanges(_Ranges):
    """The light at the tip of the endoscope."""

    falloff: Range = (1.9, 2.1)
    """Exponent p of E ~ distance^-p; 2 is a point source."""
    spot: Range = (0.0, 0.6)
    """Exponent of the cosine between beam axis and ray; 0 shines equally everywhere."""
    offset_mm: Range = (1.5, 2.5)
    """Distance of the light guides from the lens."""
    second_light: Share = 0.4
    """Share of clips with a second light guide opposite to the first."""
    ambient: Range = (0.0, 0.012)
    """Light that bounced before it reached the surface, against the direct light at 20 mm."""
    tilt_deg: Range = (0.0, 0.0)
    """Angle between the beam's axis and the lens's."""
    coned: Share = 0.0
    """Share of clips whose beam has an edge."""
    cone_deg: Range = (34.0, 60.0)
    """Angle of that edge from the beam's axis."""
    edge_deg: Range = (4.0, 18.0)
    """Half width of the edge."""


class Palette(_Ranges):
    """Another family of tissue colours; see ``MaterialRanges``."""

    red: Range
    green_over_red: Range
    blue_over_green: Range


class MaterialRanges(_Ranges):
    """Wet tissue. Colours are linear reflectances, built so that red >= green >= blue."""

    red: Range = (0.72, 0.92)
    green_over_red: Range = (0.18, 0.36)
    blue_over_green: Range = (0.72, 0.98)
    variety: Range = (0.1, 0.4)
    """How far organs, folds and patches of one scene leave its palette; 0 is one colour."""
    specular: Range = (0.15, 0.5)
    shininess: Range = (30.0, 80.0)
    bump: Range = (0.03, 0.09)
    """Root mean square slope of the fine relief, which breaks up the highlights."""
    mottle: Range = (0.05, 0.16)
    """Relative strength of the blotches, whose size is in millimetres."""
    spots: Range = (0.0, 0.0)
    """Relative strength of small dark spots."""
    vessels: Range = (25.0, 60.0)
    """Vessel trees a scene."""
    vessel_contrast: Range = (0.25, 0.6)
    fading: bool = False
    """Whether a cavity's vessels and films fade on steep walls, where their map stretches them into streaks."""
    palettes: tuple[Palette, ...] = ()
    """Other palettes, each as likely for a scene as the one above."""
    regions: Range = (0.0, 0.0)
    """Logarithm of the contrast of large light and dark regions, which have nothing to do with the shape."""
    region_edge: Range = (0.5, 5.0)
    """Steepness of their borders: above 2 a region is even inside."""
    banded: Share = 0.0
    """Share of scenes with painted bands, light or dark."""
    bloody: Share = 0.0
    """Share of scenes with blood on the surface."""
    slimy: Share = 0.0
    """Share of scenes with mucus."""
    foamy: Share = 0.0
    """Share of scenes with bubbles."""
    coated: Share = 0.0
    """Share of scenes under a wet film with sharp highlights of its own."""
    coat: Range = (0.5, 4.0)
    """Strength of the film's highlights; more than that of the tissue, as they are smaller."""
    coat_shininess: Range = (60.0, 260.0)
    coat_bump: Range = (0.01, 0.09)
    """Root mean square slope of the film, which bends and breaks its highlights."""
    dry: Range = (-2.0, 0.8)
    """Where the film is broken, in standard deviations of the blotches; -2 is wet everywhere."""
    fine: Range = (0.0, 0.0)
    """Strength of the third octave of blotches and relief, finer than a millimetre."""
    capillaries: Range = (0.0, 0.0)
    """Density of the finest vessels, seen from near."""


class CameraRanges(_Ranges):
    """Lens and hand."""

    fov_deg: Range = (65.0, 100.0)
    """Horizontal field of view; drawn evenly in its tangent's logarithm."""
    distorted: Share = 0.0
    """Share of clips whose lens bends straight lines."""
    bend: Range = (-0.22, 0.06)
    """Radial distortion k1 times the squared radius of the image's corner; below 0 is a barrel."""
    bend_ratio: Range = (0.5, 1.2)
    """k2 / k1^2; above 0.45 every ray has a pixel of its own."""
    speed: Range = (0.7, 1.3)
    """1 moves about 3 % of the mean depth a frame; narrow views move less."""
    motions: dict[Motion, float] = {"forward": 0.4, "sideways": 0.3, "turning": 0.25, "still": 0.05}
    """Weights of the kinds of path."""
    slow: Share = 0.0
    """Share of clips that move at ``slow_speed``, drawn evenly in its logarithm, in place of ``speed``."""
    slow_speed: Range = (0.04, 0.4)
    trembling: Share = 0.0
    """Share of clips whose camera is held by a hand that trembles."""
    tremor_deg: Range = (0.02, 0.35)
    """Amplitude of the tremor's turns; its shifts match them at the distance looked at."""
    pausing: Share = 0.0
    """Share of clips in which the camera stops for a while."""
    hugging: Share = 0.0
    """Share of clips through tubes whose camera keeps near the wall, as a colonoscope mostly does: millimetres and the
    far end of the lumen in one picture."""


class LifeRanges(_Ranges):
    """What moves beside the camera."""

    instruments: Share = 0.0
    """Share of clips in which one or two instruments pass through the view; none in rooms."""
    breathing: Share = 0.0
    """Share of clips whose tissue heaves in place."""
    peristalsis: Share = 0.0
    """Share of clips along whose tissue a wave travels."""
    amplitude: Range = (0.01, 0.06)
    """Height of either, against the radius of a tube or a third of a field's width."""
    period: Range = (14.0, 60.0)
    """Frames a breath or a wave takes."""


class SensorRanges(_Ranges):
    """From radiance to eight bits."""

    gamma: Range = (2.2, 2.2)
    exposure: Range = (0.42, 0.55)
    """Displayed brightness that the automatic exposure steers the metered percentile to."""
    metering: Range = (58.0, 62.0)
    """The metered percentile: low lets near tissue burn out, high leaves the distance in the dark."""
    lag: Range = (0.0, 0.5)
    """Share of the last gain that the automatic exposure keeps a frame."""
    vignette: Range = (0.0, 0.4)
    """Loss of light in the corners."""
    clipping: Range = (1.0, 1.1)
    """Gain before the sensor saturates."""
    shoulder: Range = (0.3, 0.8)
    """How softly highlights roll off; 0 clips hard."""
    noise: Range = (0.002, 0.012)
    """Standard deviation at middle grey."""
    blur_px: Range = (0.0, 0.5)
    """Standard deviation of the blur, for an image 140 pixels wide."""
    blurred: Share = 0.3
    round_view: Share = 0.0
    """Share of clips that show a part of the image only; outside is black and not valid."""
    views: dict[View, float] = {"round": 0.7, "corners": 0.3}
    """Weights of the shapes of such a part."""
    view_offset: Range = (-0.03, 0.03)
    """Distance of its middle from the image's along each axis, in image widths."""
    compressed: Share = 0.0
    """Share of clips that went through JPEG."""
    quality: Range = (60.0, 95.0)
    held: Share = 0.0
    """Share of the compressed clips that are video: blocks that hardly change are not sent again."""
    hold: Range = (0.5, 4.0)
    """Mean change of such a block in levels."""
    unfocused: Share = 0.0
    """Share of clips whose lens blurs what is out of focus."""
    aperture_mm: Range = (0.05, 0.6)
    """Opening of the lens."""
    focus: Range = (0.6, 2.5)
    """Distance in focus, in median depths of the first frame."""
    smeared: Share = 0.0
    """Share of clips with motion blur."""
    shutter: Range = (0.15, 0.9)
    """Share of the time between two frames that the shutter is open."""
    interlaced: Share = 0.0
    """Share of clips whose odd rows show the instant half a frame later."""
    glaring: Share = 0.0
    """Share of clips with glare."""
    glare: Range = (0.03, 0.2)
    """Share of the light that the lens scatters widely over the image."""
    fringed: Share = 0.0
    """Share of clips with lateral colour."""
    fringe_px: Range = (0.2, 0.9)
    """How far red and blue part at the sides of an image 140 pixels wide."""
    tinted: Share = 0.0
    """Share of clips with a wrong white balance."""
    warmth: Range = (-0.3, 0.3)
    """Logarithm of red over blue."""
    tint: Range = (-0.08, 0.03)
    """Logarithm of green over the mean of red and blue."""
    drift: Range = (0.0, 0.08)
    """Amplitude with which both wander during a clip."""
    grainy: Share = 0.0
    """Share of clips with the noise of a chip in linear light, coloured by demosaicing."""
    shot: Range = (0.01, 0.06)
    """Standard deviation of the photon noise at full light; it goes with the root of light."""
    read: Range = (0.0005, 0.006)
    """Standard deviation of the read-out noise at full light."""
    grain_px: Range = (0.0, 0.8)
    """Standard deviation of the blur that demosaicing gives the noise; its colour gets twice that."""
    chroma: Range = (0.2, 1.0)
    """Strength of the noise's colour against its brightness; 1 is independent noise in red, green and blue."""
    sharpened: Share = 0.0
    """Share of clips that the processor sharpens, which leaves halos."""
    sharpen: Range = (0.2, 1.4)
    """Strength of the sharpening."""
    sharpen_px: Range = (0.6, 1.6)
    """Standard deviation of the blur that it subtracts."""
    overlay: Share = 0.0
    """Share of clips with writing in the black around a round view."""


class AirRanges(_Ranges):
    """What floats between lens and tissue."""

    smoky: Share = 0.0
    """Share of clips with smoke or haze."""
    opacity: Range = (0.1, 0.6)
    """Share of light that it takes on the way from the median depth."""
    veil: Range = (0.3, 1.2)
    """Brightness of the smoke against the metered radiance of the first frame."""
    wisps: Range = (0.0, 0.6)
    """How uneven it is."""


class Domain(_Ranges):
    """One rendered domain; the defaults are the source domain that the small model starts on."""

    name: str
    families: dict[Family, float] = {"lumen": 0.5, "cavity": 0.5}
    """Weights of the kinds of scene."""
    light: LightRanges = LightRanges()
    material: MaterialRanges = MaterialRanges()
    air: AirRanges = AirRanges()
    camera: CameraRanges = CameraRanges()
    life: LifeRanges = LifeRanges()
    sensor: SensorRanges = SensorRanges()

    @model_validator(mode="after")
    def _something_to_draw(self) -> Self:
        for what, weights in (
            ("families", self.families),
            ("camera.motions", self.camera.motions),
            ("sensor.views", self.sensor.views),
        ):
            if min(weights.values(), default=0.0) < 0 or sum(weights.values()) <= 0:
                raise ValueError(f"{what} needs weights of at least 0 with a positive sum, got {weights}")
        return self

    @classmethod
    def from_file(cls, path: Path) -> Self:
        """Read a domain from a JSON file; what the file leaves out keeps its default.

        Raises:
            SettingsError: If the file cannot be read or holds something else.
        """
        try:
            return cls.model_validate(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, json.JSONDecodeError, ValidationError) as error:
            raise SettingsError(f"{path}: not a domain of rendered clips: {error}") from error


def draw(random: np.random.Generator, bounds: tuple[float, float]) -> float:
    """A number from a range."""
    return float(random.uniform(*bounds))


def choose(random: np.random.Generator, weights: Mapping[Name, float]) -> Name:
    """A key, as often as its weight says; independent of the order in which the file lists them."""
    names = sorted(weights)
    share = np.array([weights[name] for name in names])
    return names[int(random.choice(len(names), p=share / share.sum()))]
