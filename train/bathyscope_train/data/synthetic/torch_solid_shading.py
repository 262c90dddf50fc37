"""Shading of solids in torch: what ``solid_shading`` does a point at a time."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bathyscope_train.data.synthetic.solid_shading import _OFF_SURFACE_MM as OFF_SURFACE_MM
from bathyscope_train.data.synthetic.solids import (
    BALL,
    CLOUDS,
    COLLAGE,
    FRUSTUM,
    PLAIN,
    PRINT,
    ROOM,
    STRIPES,
    TILES,
    WOOD,
)
from bathyscope_train.data.synthetic.torch_scene import CameraTensors, LampTensors
from bathyscope_train.data.synthetic.torch_shading import View, lamp_light
from bathyscope_train.data.synthetic.torch_solids import Points, SolidTensors, Values, trace_solids

Integers = Int[Tensor, "s n"]

_FEW = 0x7FFFFFFF


def shade_solids(
    solids: SolidTensors, which: Integers, lamp: LampTensors, camera: CameraTensors, view: View
) -> tuple[Points, Values]:
    """Radiance of points of the solids ``which``, and how much of it is highlight."""
    numbers = solids.every.at(which, torch.zeros_like(which)).permute(2, 0, 1)
    kind, local, size, look = numbers[0], numbers[2:14].unflatten(0, (3, 4)), numbers[14:17], numbers[17:]
    place = (local[:, :3] * view.points).sum(1) + local[:, 3]
    facing = _local_normal(kind, size, place)
    colour = _solid_colour(solids, which, place, facing, view.footprint)
    normals = (local[:, :3] * facing[:, None]).sum(0)
    direct, highlight = torch.zeros_like(view.distance), torch.zeros_like(view.distance)
    for to_lamp, power in lamp_light(lamp, camera, view.points):
        more, gloss = _add(look, solids.lamp_share * power, to_lamp, normals, view.to_camera)
        direct, highlight = direct + more, highlight + gloss
    for light in solids.lights:
        arm = light[:3] - view.points
        reach = arm.square().sum(0).sqrt()
        to_lamp = arm / reach
        blocked, _ = trace_solids(solids, OFF_SURFACE_MM * reach, reach, view.points, to_lamp)
        power = light[3] * 4 / (1 + 3 * (reach / solids.reach_mm).square())
        power = torch.where(blocked >= reach, power, 0.12 * power)
        more, gloss = _add(look, power, to_lamp, normals, view.to_camera)
        direct, highlight = direct + more, highlight + gloss
    direct = direct + solids.sky * (0.75 - 0.25 * normals[1])
    return colour * direct + highlight, highlight


def _add(
    look: Float[Tensor, "12 s n"], power: Values, to_lamp: Points, normals: Points, to_camera: Points
) -> tuple[Values, Values]:
    """Scattered and mirrored light of one lamp."""
    facing = (normals * to_lamp).sum(0)
    specular, shininess, metal = look[9:]
    middle = to_lamp + to_camera
    half = (normals * middle).sum(0) / (middle.square().sum(0).sqrt() + 1e-12)
    gloss = power * half.clamp_min(0) ** (4 * shininess) * (shininess + 2) / 10 * specular
    scattered = power * ((1 - metal) * facing + 0.8 * metal * facing**4)
    return torch.where(facing > 0, scattered, 0.0), torch.where(facing > 0, gloss, 0.0)


def _local_normal(kind: Values, size: Points, place: Points) -> Points:
    """Unit normals into the free space at points on solids, both in the solids' frames."""
    x, y, z = place
    slope = 0.5 * (size[1] - size[0]) / size[2]
    across = torch.sqrt(x * x + y * y)
    lid = (across - 0.5 * (size[0] + size[1]) - slope * z).abs() > size[2] - z.abs()
    mantle = torch.stack([x / across.clamp_min(1e-12), y / across.clamp_min(1e-12), -slope])
    mantle = mantle / torch.sqrt(1 + slope * slope)
    up = torch.stack([torch.zeros_like(z), torch.zeros_like(z), torch.where(z > 0, 1.0, -1.0)])
    gap = size - place.abs()
    first = (gap[0] <= gap[1]) & (gap[0] <= gap[2])
    second = ~first & (gap[1] <= gap[2])
    faces = torch.stack([first, second, ~first & ~second]) * place.sign()
    faces = torch.where(kind == ROOM, -faces, faces)
    round_body = torch.where(lid, up, mantle)
    return torch.where(kind == BALL, place / size[0], torch.where(kind == FRUSTUM, round_body, faces))


def _solid_colour(solids: SolidTensors, which: Integers, place: Points, facing: Points, footprint: Values) -> Points:
    """Reflectance at points of solids, points and normals in the solids' frames."""
    numbers = solids.every.at(which, torch.zeros_like(which)).permute(2, 0, 1)
    kind, size, look = numbers[0], numbers[14:17], numbers[17:]
    x, y, z = place
    across, wide, grain = facing[2].abs(), facing[0].abs() > 0.5, look[7]
    mantle = (kind == FRUSTUM) & (across < 0.9)
    level = ~mantle & ((kind == BALL) | (across > 0.5))
    side = ~mantle & ~level & wide
    u = torch.where(mantle | side, z, x)
    v = torch.where(mantle, torch.atan2(y, x) * 0.5 * (size[0] + size[1]), torch.where(level | side, y, z))
    face = torch.where(facing[1] > 0, 5, 6)
    face = torch.where(side, torch.where(facing[0] > 0, 3, 4), face)
    face = torch.where(level, torch.where(facing[2] > 0, 1, 2), face)
    seed = 31 * which + torch.where(mantle, 0, face)
    u, v = u / grain + 100, v / grain + 100
    share = torch.zeros_like(u)
    for pattern in solids.patterns:
        if pattern != PLAIN:
            share = torch.where(look[6] == pattern, _PATTERNS[pattern](u, v, seed), share)
    sharp = 1 / (1 + (2 * footprint / grain).square())
    share = torch.where(look[6] == PLAIN, 0.0, 0.35 + (share - 0.35) * sharp) * look[8]
    return torch.lerp(look[:3], look[3:6], share)


def _scatter(i: Tensor, j: Tensor, k: Tensor | int, like: Values) -> Values:
    """Numbers in [0, 1) that look random and depend on three integers alone."""
    n = (i * 73856093) ^ (j * 19349663) ^ (k * 83492791)
    n = (n ^ (n >> 13)) & _FEW
    n = (n * 1274126177) & _FEW
    n = n ^ (n >> 16)
    return (n & 0xFFFF).to(like.dtype) / 65536


def _noise(u: Values, v: Values, seed: Integers) -> Values:
    """Smooth noise in [0, 1] with a grain of 1."""
    i, j = u.floor().long(), v.floor().long()
    s, t = u - i, v - j
    s, t = s * s * (3 - 2 * s), t * t * (3 - 2 * t)
    above = torch.lerp(_scatter(i, j, seed, u), _scatter(i, j + 1, seed, u), t)
    below = torch.lerp(_scatter(i + 1, j, seed, u), _scatter(i + 1, j + 1, seed, u), t)
    return torch.lerp(above, below, s)


def _clouds(u: Values, v: Values, seed: Integers) -> Values:
    return 0.6 * _noise(u, v, seed) + 0.4 * _noise(2.7 * u, 2.7 * v, seed + 1)


def _wood(u: Values, v: Values, seed: Integers) -> Values:
    board = (0.5 * v).floor()
    rings = _noise(0.12 * u + 7 * board, 2.5 * v, seed) * 5
    veins = 0.7 * (rings - rings.floor()) + 0.3 * _scatter(board.long(), seed, 3, u)
    return torch.where(0.5 * v - board < 0.03, veins.clamp_min(1), veins)


def _tiles(u: Values, v: Values, seed: Integers) -> Values:
    joint = (u - u.floor() < 0.06) | (v - v.floor() < 0.06)
    return torch.where(joint, 1.0, 0.25 * _scatter(u.floor().long(), v.floor().long(), seed, u))


def _stripes(u: Values, v: Values, seed: Integers) -> Values:
    del v, seed
    return (u - u.floor() < 0.5).to(u.dtype)


def _print(u: Values, v: Values, seed: Integers) -> Values:
    """Lines of words, a title, a margin."""
    line = v.floor().long()
    word = (0.7 * u + 5 * _scatter(line, seed, 1, u)).floor().long()
    written = (v - line < 0.5) & (_scatter(word, line, seed, u) < 0.75) & (_scatter(line, seed, 2, u) < 0.8)
    letter = 0.5 + 0.5 * _scatter((5 * u).floor().long(), line, seed, u)
    return torch.where(written, letter, 0.0)


def _collage(u: Values, v: Values, seed: Integers) -> Values:
    """Rectangles of two sizes."""
    i = u.floor().long()
    j = (v + 7 * _scatter(i, seed, 5, u)).floor().long()
    inner = _scatter((3 * u).floor().long(), (4 * v).floor().long(), seed, u)
    return 0.75 * _scatter(i, j, seed, u) + 0.25 * inner


_PATTERNS = {
    CLOUDS: _clouds,
    WOOD: _wood,
    TILES: _tiles,
    STRIPES: _stripes,
    PRINT: _print,
    COLLAGE: _collage,
}
