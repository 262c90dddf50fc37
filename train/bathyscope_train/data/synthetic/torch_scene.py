"""The scenes of several clips as tensors on one device, for the renderer in torch.

Maps of all scenes lie in one flat tensor each, with the place where a scene's part begins; numbers are columns
``(s, 1)``, so that they meet rays ``(s, n)`` without being copied. All scenes of a batch have one kind of surface.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bathyscope_train.data.synthetic.clip import ClipPlan
from bathyscope_train.data.synthetic.scene import TUBE, Surface, Tissue


@dataclass(frozen=True, slots=True)
class Atlas:
    """Maps of different sizes, one a scene, as rows of one table."""

    table: Float[Tensor, "m c"]
    first: Int[Tensor, "s 1"]
    """Row of the table where the scene's map begins."""
    rows: Int[Tensor, "s 1"]
    columns: Int[Tensor, "s 1"]

    def at(self, i: Int[Tensor, "s n"], j: Int[Tensor, "s n"]) -> Float[Tensor, "s n c"]:
        """What the maps hold at row i and column j."""
        index = self.first + i * self.columns + j
        return self.table.index_select(0, index.flatten()).view(*index.shape, -1)


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
    first: tuple[Float[Tensor, "s 1"], Float[Tensor, "s 1"]]
    density: tuple[Float[Tensor, "s 1"], Float[Tensor, "s 1"]]
    row_step: Float[Tensor, "s 1"]
    stride_mm: Float[Tensor, "s 1"]
    leap_mm: Float[Tensor, "s 1"]
    feature_mm: Float[Tensor, "s 1"]


@dataclass(frozen=True, slots=True)
class TissueTensors:
    """See :class:`~bathyscope_train.data.synthetic.scene.Tissue`."""

    albedo: Atlas
    vessels: tuple[Atlas, ...]
    """One a level."""
    vessel_step_mm: Float[Tensor, "s 1"]
    vessel_tint: Float[Tensor, "s 1 3"]
    solid: Atlas
    """Blocks of ``columns`` cubed samples; ``rows`` counts samples along two axes at once."""
    solid_step_mm: Float[Tensor, "s 1"]
    mottle: Float[Tensor, "s 1"]
    spots: Float[Tensor, "s 1"]
    bump: Float[Tensor, "s 1"]
    specular: Float[Tensor, "s 1"]
    shininess: Float[Tensor, "s 1"]


@dataclass(frozen=True, slots=True)
class LampTensors:
    """See :class:`~bathyscope_train.data.synthetic.shading.Lamp`."""

    offsets: Float[Tensor, "s l 3"]
    lit: Float[Tensor, "s l"]
    """1 / number of the clip's lights, 0 where it has no such light."""
    falloff: Float[Tensor, "s 1"]
    spot: Float[Tensor, "s 1"]
    ambient: Float[Tensor, "s 1"]
    soft_mm: Float[Tensor, "s 1"]


@dataclass(frozen=True, slots=True)
class SceneTensors:
    """The scenes of some clips, their lamps and cameras."""

    surface: SurfaceTensors
    tissue: TissueTensors
    lamp: LampTensors
    scene_from_camera: Float[Tensor, "s t 4 4"]
    intrinsics: Float[Tensor, "s 3 3"]


def scene_tensors(
    plans: Sequence[ClipPlan], device: torch.device | str, dtype: torch.dtype = torch.float32
) -> SceneTensors:
    """Put the scenes of ``plans`` on a device. A scene that several plans share is there once.

    Args:
        plans: Clips of one length, size and kind of surface.
        device: Where to.
        dtype: float32, or float64 to look for differences.
    """
    builder = _Builder(plans, device, dtype)
    return SceneTensors(
        surface=_surface(builder),
        tissue=_tissue(builder),
        lamp=_lamp(builder),
        scene_from_camera=builder.tensor(np.stack([plan.scene_from_camera for plan in plans])),
        intrinsics=builder.tensor(np.stack([plan.intrinsics for plan in plans])),
    )


class _Builder:
    """Makes tensors of what the plans have in common."""

    def __init__(self, plans: Sequence[ClipPlan], device: torch.device | str, dtype: torch.dtype) -> None:
        self.plans, self.device, self.dtype = plans, torch.device(device), dtype
        self.surfaces = [plan.scene.surface for plan in plans]
        self.tissues = [plan.scene.tissue for plan in plans]

    def tensor(self, values: npt.ArrayLike) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device, self.dtype)

    def integers(self, values: Sequence[int]) -> Int[Tensor, "s 1"]:
        return torch.tensor(values, dtype=torch.int64, device=self.device)[:, None]

    def column(self, values: Sequence[float]) -> Float[Tensor, "s 1"]:
        return torch.tensor(values, dtype=self.dtype, device=self.device)[:, None]

    def atlas(
        self,
        maps: Sequence[npt.NDArray[np.float32]],
        widen: Callable[[Tensor], Tensor] = lambda every: every,
    ) -> Atlas:
        """Maps ``(rows, columns, channels)``, widened on the device, one below the other."""
        unique = {id(one): one for one in maps}
        parts = {key: widen(self.tensor(one)) for key, one in unique.items()}
        starts = np.cumsum([0, *(len(part.flatten(0, 1)) for part in parts.values())])
        first = dict(zip(parts, (int(start) for start in starts), strict=False))
        return Atlas(
            table=torch.cat([part.flatten(0, 1) for part in parts.values()]),
            first=self.integers([first[id(one)] for one in maps]),
            rows=self.integers([parts[id(one)].shape[0] for one in maps]),
            columns=self.integers([parts[id(one)].shape[1] for one in maps]),
        )

    def of_surface(self, pick: Callable[[Surface], float]) -> Float[Tensor, "s 1"]:
        return self.column([pick(surface) for surface in self.surfaces])

    def of_tissue(self, pick: Callable[[Tissue], float]) -> Float[Tensor, "s 1"]:
        return self.column([pick(tissue) for tissue in self.tissues])


def _surface(builder: _Builder) -> SurfaceTensors:
    surfaces = builder.surfaces
    kind = surfaces[0].kind
    assert all(surface.kind == kind for surface in surfaces), "a batch has one kind of surface"

    def corners(heights: Tensor) -> Tensor:
        wide = torch.cat([heights, heights[:, :1]], 1) if kind == TUBE else heights
        return torch.stack([wide[:-1, :-1], wide[:-1, 1:], wide[1:, :-1], wide[1:, 1:]], -1)

    def segments(centre: Tensor) -> Tensor:
        return torch.cat([centre[:-1], centre[1:]], -1)[:, None]

    return SurfaceTensors(
        kind=kind,
        cells=builder.atlas([surface.heights for surface in surfaces], corners),
        rows=builder.integers([surface.heights.shape[0] for surface in surfaces]),
        columns=builder.integers([surface.heights.shape[1] for surface in surfaces]),
        centre=builder.atlas([surface.centre for surface in surfaces], segments),
        core=builder.atlas([surface.core for surface in surfaces], lambda core: core[..., None]),
        first=(builder.of_surface(lambda s: s.first[0]), builder.of_surface(lambda s: s.first[1])),
        density=(builder.of_surface(lambda s: s.density[0]), builder.of_surface(lambda s: s.density[1])),
        row_step=builder.of_surface(lambda s: s.step[0]),
        stride_mm=builder.of_surface(lambda s: s.stride_mm),
        leap_mm=builder.of_surface(lambda s: s.leap_mm),
        feature_mm=builder.of_surface(lambda s: s.feature_mm),
    )


def _tissue(builder: _Builder) -> TissueTensors:
    tissues = builder.tissues
    levels = range(len(tissues[0].vessels))
    return TissueTensors(
        albedo=builder.atlas([tissue.albedo for tissue in tissues]),
        vessels=tuple(
            builder.atlas([tissue.vessels[level] for tissue in tissues], lambda density: density[..., None])
            for level in levels
        ),
        vessel_step_mm=builder.of_tissue(lambda tissue: tissue.vessel_step_mm),
        vessel_tint=builder.tensor(np.array([tissue.vessel_tint for tissue in tissues]))[:, None],
        solid=builder.atlas([tissue.solid for tissue in tissues], lambda solid: solid.flatten(0, 1)),
        solid_step_mm=builder.of_tissue(lambda tissue: tissue.solid_step_mm),
        mottle=builder.of_tissue(lambda tissue: tissue.mottle),
        spots=builder.of_tissue(lambda tissue: tissue.spots),
        bump=builder.of_tissue(lambda tissue: tissue.bump),
        specular=builder.of_tissue(lambda tissue: tissue.specular),
        shininess=builder.of_tissue(lambda tissue: tissue.shininess),
    )


def _lamp(builder: _Builder) -> LampTensors:
    lamps = [plan.lamp for plan in builder.plans]
    most = max(len(lamp.offsets) for lamp in lamps)
    offsets, lit = np.zeros((len(lamps), most, 3)), np.zeros((len(lamps), most))
    for index, lamp in enumerate(lamps):
        offsets[index, : len(lamp.offsets)] = lamp.offsets
        lit[index, : len(lamp.offsets)] = 1.0 / len(lamp.offsets)
    return LampTensors(
        offsets=builder.tensor(offsets),
        lit=builder.tensor(lit),
        falloff=builder.column([lamp.falloff for lamp in lamps]),
        spot=builder.column([lamp.spot for lamp in lamps]),
        ambient=builder.column([lamp.ambient for lamp in lamps]),
        soft_mm=builder.column([lamp.soft_mm for lamp in lamps]),
    )
