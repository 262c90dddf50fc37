"""The scenes of several clips as tensors on one device, for the renderer in torch.

Every frame of every clip is a row (see ``torch_layout``), in the order of the clips; frames of one clip share its maps.
All clips of a batch have one kind of surface.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bathyscope_train.data.synthetic.clip import ClipPlan
from bathyscope_train.data.synthetic.scene import NOTHING, TUBE, Surface, Tissue
from bathyscope_train.data.synthetic.solids import Solids, joined, placed
from bathyscope_train.data.synthetic.swell import Swell, now
from bathyscope_train.data.synthetic.torch_layout import Atlas
from bathyscope_train.data.synthetic.torch_solids import SolidTensors, solid_tensors


@dataclass(frozen=True, slots=True)
class SurfaceTensors:
    """See :class:`~bathyscope_train.data.synthetic.scene.Surface`."""

    kind: int
    cells: Atlas
    """Heights at the corners of each cell of the map: (i, j), (i, j+1), (i+1, j), (i+1, j+1); tubes close."""
    rows: Int[Tensor, "s 1"]
    """Samples of the map, one more than cells along each axis that does not close."""
    columns: Int[Tensor, "s 1"]
    centre: Atlas
    """x and y of a tube's centreline at row i, then at row i + 1."""
    core: Atlas
    rise_mm: Float[Tensor, "s 1"]
    """By how much the tissue swells at most."""
    first: tuple[Float[Tensor, "s 1"], Float[Tensor, "s 1"]]
    density: tuple[Float[Tensor, "s 1"], Float[Tensor, "s 1"]]
    row_step: Float[Tensor, "s 1"]
    stride_mm: Float[Tensor, "s 1"]
    leap_mm: Float[Tensor, "s 1"]
    feature_mm: Float[Tensor, "s 1"]
    compiled: bool
    """Whether rays are traced and shaded by compiled code."""
    waves: Float[Tensor, "4 w s 1"] | None
    """By what the heights of each row differ from those at rest, filled up with waves of nothing; None: all rest."""


@dataclass(frozen=True, slots=True)
class TissueTensors:
    """See :class:`~bathyscope_train.data.synthetic.scene.Tissue`."""

    albedo: Atlas
    vessels: tuple[Atlas, ...]
    """One a level."""
    vessel_step_mm: Float[Tensor, "s 1"]
    vessel_tint: Float[Tensor, "3 s 1"]
    gloss: Atlas
    coated: bool
    """Whether any has a wet film."""
    finer: bool
    """Whether any has a third octave."""
    varied: bool
    """Whether any has light and dark regions."""
    solid: Atlas
    """Blocks of ``columns`` cubed samples; ``rows`` counts samples along two axes at once."""
    solid_step_mm: Float[Tensor, "s 1"]
    mottle: Float[Tensor, "s 1"]
    spots: Float[Tensor, "s 1"]
    bump: Float[Tensor, "s 1"]
    specular: Float[Tensor, "s 1"]
    shininess: Float[Tensor, "s 1"]
    coat: Float[Tensor, "s 1"]
    coat_shininess: Float[Tensor, "s 1"]
    coat_bump: Float[Tensor, "s 1"]
    dry: Float[Tensor, "s 1"]
    fine: Float[Tensor, "s 1"]
    capillaries: Float[Tensor, "s 1"]
    regions: Float[Tensor, "s 1"]
    region_level: Float[Tensor, "s 1"]
    region_edge: Float[Tensor, "s 1"]


@dataclass(frozen=True, slots=True)
class LampTensors:
    """See :class:`~bathyscope_train.data.synthetic.shading.Lamp`."""

    offsets: Float[Tensor, "l 3 s 1"]
    lit: Float[Tensor, "l s 1"]
    """1 / number of the clip's lights, 0 where it has no such light."""
    falloff: Float[Tensor, "s 1"]
    spot: Float[Tensor, "s 1"]
    ambient: Float[Tensor, "s 1"]
    soft_mm: Float[Tensor, "s 1"]
    axis: Float[Tensor, "3 s 1"]
    cone: Float[Tensor, "2 s 1"]


@dataclass(frozen=True, slots=True)
class CameraTensors:
    """Cameras in the scene."""

    turn: Float[Tensor, "3 3 s 1"]
    """Columns are the camera's axes."""
    position: Float[Tensor, "3 s 1"]
    focal: Float[Tensor, "2 s 1"]
    centre: Float[Tensor, "2 s 1"]
    distortion: Float[Tensor, "2 s 1"]
    bent: bool
    """Whether any lens is no pinhole."""


@dataclass(frozen=True, slots=True)
class SceneTensors:
    """What the rows' rays meet."""

    surface: SurfaceTensors | None
    """Nothing in a room, nor tissue."""
    tissue: TissueTensors | None
    solids: SolidTensors | None
    """Nothing where no row has any."""
    lamp: LampTensors
    camera: CameraTensors


def scene_tensors(
    plans: Sequence[ClipPlan],
    device: torch.device | str,
    dtype: torch.dtype = torch.float32,
    *,
    compiled: bool = False,
) -> SceneTensors:
    """Put the scenes of ``plans`` on a device, s = plans * frames. A scene that several plans share is there once.

    Args:
        plans: Clips of one length, size and kind of surface.
        device: Where to.
        dtype: float32, or float64 to look for differences.
        compiled: Trace and shade by code that ``torch.compile`` makes when it is first needed; the same to rounding.
    """
    builder = _Builder(plans, device, dtype)
    soft = plans[0].scene.surface.kind != NOTHING
    rows = [solids_of(plan, frame) for plan in plans for frame in range(builder.frames)]
    return SceneTensors(
        surface=_surface(builder, compiled=compiled) if soft else None,
        tissue=_tissue(builder) if soft else None,
        solids=solid_tensors(rows, device, dtype) if any(len(solids.kind) for solids in rows) else None,
        lamp=_lamp(builder),
        camera=_camera(builder),
    )


def solids_of(plan: ClipPlan, frame: int) -> Solids:
    """The scene's solids and the instruments, in place."""
    if plan.instruments.scene_from_mover.shape[1] == 0:
        return plan.scene.solids
    moving = placed(plan.instruments.solids, plan.instruments.scene_from_mover[frame])
    return joined(plan.scene.solids, moving)


class _Builder:
    """Makes tensors of what the plans have in common."""

    def __init__(self, plans: Sequence[ClipPlan], device: torch.device | str, dtype: torch.dtype) -> None:
        self.plans, self.device, self.dtype = plans, torch.device(device), dtype
        self.frames = len(plans[0].scene_from_camera)
        self.surfaces = [plan.scene.surface for plan in plans]
        self.tissues = [plan.scene.tissue for plan in plans]

    def tensor(self, values: npt.ArrayLike) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device, self.dtype)

    def of_plans(self, values: npt.ArrayLike) -> Tensor:
        """Values ``(b, ...)`` of the plans for their rows: ``(..., s, 1)``."""
        moved = np.moveaxis(np.asarray(values), 0, -1)
        return self.tensor(moved).repeat_interleave(self.frames, -1)[..., None]

    def of_rows(self, values: npt.ArrayLike) -> Tensor:
        """Values ``(b, t, ...)`` of every frame: ``(..., s, 1)``."""
        flat = np.asarray(values)
        return self.tensor(np.moveaxis(flat.reshape(-1, *flat.shape[2:]), 0, -1))[..., None]

    def integers(self, values: Sequence[int]) -> Int[Tensor, "s 1"]:
        return torch.tensor(values, dtype=torch.int64, device=self.device)[:, None]

    def atlas(self, keys: Sequence[Hashable], make: Callable[[int], Tensor]) -> Atlas:
        """Maps ``(rows, columns, channels)`` of the rows.

        Args:
            keys: One a row; equal keys have one map.
            make: The map of a row, on the device.
        """
        number = {key: row for row, key in reversed(list(enumerate(keys)))}
        parts = {key: make(row) for key, row in number.items()}
        starts = np.cumsum([0, *(part.shape[0] * part.shape[1] for part in parts.values())])
        first = dict(zip(parts, (int(start) for start in starts), strict=False))
        return Atlas(
            table=torch.cat([part.flatten(0, 1) for part in parts.values()]),
            first=self.integers([first[key] for key in keys]),
            rows=self.integers([parts[key].shape[0] for key in keys]),
            columns=self.integers([parts[key].shape[1] for key in keys]),
        )

    def plan_atlas(self, maps: Sequence[npt.NDArray[np.float32]], widen: Callable[[Tensor], Tensor]) -> Atlas:
        """Maps of the plans, widened on the device, for all their frames."""
        keys = [id(one) for one in maps for _ in range(self.frames)]
        return self.atlas(keys, lambda row: widen(self.tensor(maps[row // self.frames])))

    def of_surface(self, pick: Callable[[Surface], float]) -> Float[Tensor, "s 1"]:
        return self.of_plans([pick(surface) for surface in self.surfaces])

    def of_tissue(self, pick: Callable[[Tissue], float]) -> Float[Tensor, "s 1"]:
        return self.of_plans([pick(tissue) for tissue in self.tissues])


def _surface(builder: _Builder, *, compiled: bool) -> SurfaceTensors:
    surfaces = builder.surfaces
    kind = surfaces[0].kind
    assert all(surface.kind == kind for surface in surfaces), "a batch has one kind of surface"

    def corners(heights: Tensor) -> Tensor:
        wide = torch.cat([heights, heights[:, :1]], 1) if kind == TUBE else heights
        return torch.stack([wide[:-1, :-1], wide[:-1, 1:], wide[1:, :-1], wide[1:, 1:]], -1)

    def segments(centre: Tensor) -> Tensor:
        return torch.cat([centre[:-1], centre[1:]], -1)[:, None]

    swells = [plan.swell for plan in builder.plans]
    rise = builder.of_plans([0.0 if swell is None else float(np.abs(swell.waves[:, 0]).sum()) for swell in swells])
    core = builder.plan_atlas([surface.core for surface in surfaces], lambda core: core[..., None])
    return SurfaceTensors(
        kind=kind,
        cells=_cells(builder, corners),
        rise_mm=rise,
        rows=builder.of_surface(lambda surface: surface.heights.shape[0]).long(),
        columns=builder.of_surface(lambda surface: surface.heights.shape[1]).long(),
        centre=builder.plan_atlas([surface.centre for surface in surfaces], segments),
        core=core,
        first=(builder.of_surface(lambda s: s.first[0]), builder.of_surface(lambda s: s.first[1])),
        density=(builder.of_surface(lambda s: s.density[0]), builder.of_surface(lambda s: s.density[1])),
        row_step=builder.of_surface(lambda s: s.step[0]),
        stride_mm=builder.of_surface(lambda s: s.stride_mm),
        leap_mm=builder.of_surface(lambda s: s.leap_mm),
        feature_mm=builder.of_surface(lambda s: s.feature_mm),
        compiled=compiled,
        waves=_waves(builder),
    )


def _waves(builder: _Builder) -> Float[Tensor, "4 w s 1"] | None:
    """``Surface.waves`` of every row."""
    most = max(0 if plan.swell is None else len(plan.swell.waves) for plan in builder.plans)
    if most == 0:
        return None
    table = np.zeros((len(builder.plans), builder.frames, 4, most))
    for number, plan in enumerate(builder.plans):
        if plan.swell is not None:
            for frame in range(builder.frames):
                table[number, frame, :, : len(plan.swell.waves)] = now(plan.swell, frame).T
    return builder.of_rows(table)


def _cells(builder: _Builder, corners: Callable[[Tensor], Tensor]) -> Atlas:
    """Heights of every row: one map a clip, or one a frame where the tissue moves."""
    frames = builder.frames
    keys: list[Hashable] = []
    for number, plan in enumerate(builder.plans):
        still = plan.swell is None
        keys += [id(plan.scene.surface.heights) if still else (number, frame) for frame in range(frames)]

    def make(row: int) -> Tensor:
        plan = builder.plans[row // frames]
        heights = builder.tensor(plan.scene.surface.heights)
        return corners(heights if plan.swell is None else heights + _gain(builder, plan, plan.swell, row % frames))

    return builder.atlas(keys, make)


def _gain(builder: _Builder, plan: ClipPlan, swell: Swell, frame: int) -> Float[Tensor, "rows columns"]:
    """What a surface's heights gain in one frame; see ``swell``."""
    along, across = (builder.tensor(axis) for axis in map_axes(plan.scene.surface))
    waves = [
        amplitude * torch.cos(k_along * along[:, None] + (k_across * across - turn * frame + phase))
        for amplitude, k_along, k_across, turn, phase in swell.waves.tolist()
    ]
    return torch.stack(waves).sum(0)


def map_axes(surface: Surface) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Z and angle of the samples of a tube's map, y and x of a field's."""
    along, across = (
        first + step * np.arange(count)
        for first, step, count in zip(surface.first, surface.step, surface.heights.shape, strict=True)
    )
    if surface.kind == TUBE:
        quarter, rest = np.divmod(across, 1.0)
        across = quarter * np.pi / 2 + np.arctan2(rest, 1.0 - rest)
    return along, across


def _tissue(builder: _Builder) -> TissueTensors:
    tissues = builder.tissues
    levels = range(len(tissues[0].vessels))
    return TissueTensors(
        albedo=builder.plan_atlas([tissue.albedo for tissue in tissues], lambda albedo: albedo),
        vessels=tuple(
            builder.plan_atlas([tissue.vessels[level] for tissue in tissues], lambda density: density[..., None])
            for level in levels
        ),
        vessel_step_mm=builder.of_tissue(lambda tissue: tissue.vessel_step_mm),
        vessel_tint=builder.of_plans([tissue.vessel_tint for tissue in tissues]),
        gloss=builder.plan_atlas([tissue.gloss for tissue in tissues], lambda gloss: gloss[..., None]),
        coated=any(tissue.coat > 0 for tissue in tissues),
        finer=any(tissue.fine > 0 or tissue.capillaries > 0 for tissue in tissues),
        varied=any(tissue.regions > 0 for tissue in tissues),
        solid=builder.plan_atlas([tissue.solid for tissue in tissues], lambda solid: solid.flatten(0, 1)),
        solid_step_mm=builder.of_tissue(lambda tissue: tissue.solid_step_mm),
        mottle=builder.of_tissue(lambda tissue: tissue.mottle),
        spots=builder.of_tissue(lambda tissue: tissue.spots),
        bump=builder.of_tissue(lambda tissue: tissue.bump),
        specular=builder.of_tissue(lambda tissue: tissue.specular),
        shininess=builder.of_tissue(lambda tissue: tissue.shininess),
        coat=builder.of_tissue(lambda tissue: tissue.coat),
        coat_shininess=builder.of_tissue(lambda tissue: tissue.coat_shininess),
        coat_bump=builder.of_tissue(lambda tissue: tissue.coat_bump),
        dry=builder.of_tissue(lambda tissue: tissue.dry),
        fine=builder.of_tissue(lambda tissue: tissue.fine),
        capillaries=builder.of_tissue(lambda tissue: tissue.capillaries),
        regions=builder.of_tissue(lambda tissue: tissue.regions),
        region_level=builder.of_tissue(lambda tissue: tissue.region_level),
        region_edge=builder.of_tissue(lambda tissue: tissue.region_edge),
    )


def _lamp(builder: _Builder) -> LampTensors:
    lamps = [plan.lamp for plan in builder.plans]
    most = max(len(lamp.offsets) for lamp in lamps)
    offsets, lit = np.zeros((len(lamps), most, 3)), np.zeros((len(lamps), most))
    for index, lamp in enumerate(lamps):
        offsets[index, : len(lamp.offsets)] = lamp.offsets
        lit[index, : len(lamp.offsets)] = 1.0 / len(lamp.offsets)
    return LampTensors(
        offsets=builder.of_plans(offsets),
        lit=builder.of_plans(lit),
        falloff=builder.of_plans([lamp.falloff for lamp in lamps]),
        spot=builder.of_plans([lamp.spot for lamp in lamps]),
        ambient=builder.of_plans([lamp.ambient for lamp in lamps]),
        soft_mm=builder.of_plans([lamp.soft_mm for lamp in lamps]),
        axis=builder.of_plans([lamp.axis for lamp in lamps]),
        cone=builder.of_plans([lamp.cone for lamp in lamps]),
    )


def _camera(builder: _Builder) -> CameraTensors:
    poses = np.stack([plan.scene_from_camera for plan in builder.plans])
    intrinsics = np.stack([plan.intrinsics for plan in builder.plans])
    return CameraTensors(
        turn=builder.of_rows(poses[..., :3, :3]),
        position=builder.of_rows(poses[..., :3, 3]),
        focal=builder.of_plans(intrinsics[:, [0, 1], [0, 1]]),
        centre=builder.of_plans(intrinsics[:, :2, 2]),
        distortion=builder.of_plans([tuple(plan.distortion) for plan in builder.plans]),
        bent=any(any(plan.distortion) for plan in builder.plans),
    )
