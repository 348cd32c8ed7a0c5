"""Surroundings of rendered people: procedural rooms and background images, with geometry for shadows."""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.render.cast import View

#: Reflectances are multiplied in linear light; images are sRGB, approximated here by a plain power law.
GAMMA = 2.2


class Light(NamedTuple):
    """A distant lamp and ambient light, in linear RGB.

    Attributes:
        towards: (3,) unit vector to the lamp.
        key: (3,) irradiance from the lamp on a surface that faces it.
        ambient: (3,) ambient irradiance on a surface that faces up; one that faces down gets half.
    """

    towards: Tensor
    key: Tensor
    ambient: Tensor

    @classmethod
    def draw(cls, yaw_rad: float, generator: torch.Generator) -> "Light":
        """A lamp in the half space behind a camera with this yaw, 35 to 65 degrees up."""
        u = torch.rand(5, generator=generator, dtype=torch.float64).tolist()
        azimuth = yaw_rad + math.pi + (u[0] - 0.5) * 2.2
        elevation = math.radians(35 + 30 * u[1])
        flat = math.cos(elevation)
        towards = (math.sin(azimuth) * flat, math.cos(azimuth) * flat, math.sin(elevation))
        warmth = 0.08 * (u[2] - 0.5)
        strength, fill = 0.55 + 0.35 * u[3], 0.40 + 0.20 * u[4]
        key = torch.tensor([1 + warmth, 1.0, 1 - warmth]) * strength
        return cls(torch.tensor(towards), key, torch.tensor([1 - warmth, 1.0, 1 + warmth]) * fill)

    def irradiance(self, normal: Tensor, lit: Tensor) -> Tensor:
        """Light (..., 3) on surfaces with normals (..., 3) that a fraction ``lit`` (...) of the lamp reaches."""
        facing = (normal @ self.towards.to(normal)).clamp(min=0) * lit
        sky = 0.75 + 0.25 * normal[..., 2:]
        return facing[..., None] * self.key.to(normal) + sky * self.ambient.to(normal)


class Scene(NamedTuple):
    """The scene without people.

    Attributes:
        shade: (H * W, 3) linear RGB under ambient light alone.
        lamp: (H * W, 3) linear RGB that the lamp adds outside shadows.
        points: (H * W, 3) world metres of each pixel; not finite where it is infinitely far.
        depth: (H * W,) ray parameter; anything further away is hidden.
    """

    shade: Tensor
    lamp: Tensor
    points: Tensor
    depth: Tensor


def picture_scene(picture: Tensor, view: View, light: Light) -> Scene:
    """A background image (3, H, W) in [0, 1] behind people who stand on the floor z = 0 that it shows.

    The image already includes the light of the lamp, so a shadow takes away its share.
    """
    colour = picture.flatten(1).T.clamp(0, 1) ** GAMMA
    up = view.directions[:, 2]
    reach = torch.where(up < -1e-3, -view.origins[:, 2] / up, math.inf)
    reach = torch.where(reach > 0, reach, math.inf)
    points = view.origins + reach[:, None] * view.directions
    floor = light.irradiance(up.new_tensor([0.0, 0.0, 1.0]), up.new_ones(()))
    share = light.ambient.to(floor) / floor
    return Scene(colour * share, colour * (1 - share), points, torch.full_like(up, math.inf))


class _Draw:
    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def number(self, low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def index(self, count: int) -> int:
        return int(torch.randint(count, (), generator=self.generator))

    def colour(self, low: float, high: float, spread: float) -> Tensor:
        grey = self.number(low, high)
        return (grey + spread * (torch.rand(3, generator=self.generator) - 0.5)).clamp(0.03, 0.97)


def _noise(a: Tensor, b: Tensor, generator: torch.Generator) -> Tensor:
    """Smooth noise of two coordinates in about [-1, 1]: octaves of a repeating random lattice."""
    lattice = torch.randn(1, 1, 64, 64, generator=generator).to(a)
    lattice = F.pad(lattice, (0, 1, 0, 1), mode="circular")
    total = torch.zeros_like(a)
    for octave in range(3):
        place = torch.stack([a, b], dim=-1) * 2**octave / 64
        place = (place - place.floor()) * 2 - 1
        sample = F.grid_sample(lattice, place[None, None], mode="bilinear", align_corners=True)
        total = total + sample[0, 0, 0] * 0.5**octave
    return total / 1.75


def _floor(a: Tensor, b: Tensor, draw: _Draw) -> Tensor:
    """Planks, tiles or carpet at coordinates in metres: sRGB (K, 3)."""
    kind = draw.index(3)
    if kind == 0:
        wood = draw.number(0.35, 0.7) * torch.tensor([1.0, 0.78, 0.56]).to(a)
        width, length = draw.number(0.1, 0.2), draw.number(0.9, 1.6)
        row = (a / width).floor()
        board = (b / length + row * 0.618).floor()
        tone = torch.frac((torch.sin(row * 12.99 + board * 78.23) * 43758.5).abs())
        seam = (torch.frac(a / width + 1e3) < 0.02) | (torch.frac(b / length + row * 0.618 + 1e3) < 0.004)
        grain = _noise(a * 60, b * 4, draw.generator)
        return wood * (0.85 + 0.25 * tone + 0.06 * grain)[:, None] * torch.where(seam, 0.6, 1.0)[:, None]
    if kind == 1:
        side = draw.number(0.3, 0.6)
        tile, grout = draw.colour(0.45, 0.85, 0.1).to(a), draw.colour(0.3, 0.6, 0.03).to(a)
        seam = (torch.frac(a / side + 1e3) < 0.02) | (torch.frac(b / side + 1e3) < 0.02)
        return torch.where(
            seam[:, None], grout, tile * (1 + 0.04 * _noise(a * 6, b * 6, draw.generator))[:, None]
        )
    carpet = draw.colour(0.25, 0.6, 0.3).to(a)
    return (
        carpet
        * (1 + 0.08 * _noise(a * 40, b * 40, draw.generator) + 0.05 * _noise(a, b, draw.generator))[:, None]
    )


def _wall(a: Tensor, z: Tensor, draw: _Draw) -> Tensor:
    """Paint, wallpaper or bricks at (along the wall, height) in metres: sRGB (K, 3)."""
    kind = draw.index(4)
    base = draw.colour(0.55, 0.9, 0.15).to(a)
    tone = 1 + 0.02 * _noise(a, z, draw.generator)
    if kind == 1:
        tone = tone * torch.where(torch.frac(a / draw.number(0.15, 0.4) + 1e3) < 0.5, 0.93, 1.0)
    elif kind == 2:
        base = torch.tensor([0.62, 0.36, 0.28]).to(a) * draw.number(0.8, 1.2)
        row = (z / 0.075).floor()
        column = a / 0.24 + 0.5 * torch.remainder(row, 2)
        mortar = (torch.frac(z / 0.075 + 1e3) < 0.13) | (torch.frac(column + 1e3) < 0.04)
        brick = torch.frac((torch.sin(row * 12.99 + column.floor() * 78.23) * 43758.5).abs())
        tone = tone * (0.85 + 0.3 * brick)
        base = torch.where(mortar[:, None], torch.tensor([0.66, 0.64, 0.60]).to(a), base)
    colour = base * tone[:, None]
    # Pictures, doors and windows on the wall, each a frame around tinted noise.
    for _ in range(draw.index(3) + 1):
        door = draw.number(0, 1) < 0.25
        width, height = (0.9, 2.05) if door else (draw.number(0.4, 1.3), draw.number(0.3, 0.9))
        left, low = draw.number(float(a.min()) - 0.3, float(a.max())), 0.0 if door else draw.number(1.0, 1.6)
        da, dz = (a - left - width / 2).abs() - width / 2, (z - low - height / 2).abs() - height / 2
        inside = torch.maximum(da, dz)
        frame, tint = draw.colour(0.1, 0.9, 0.15).to(a), draw.colour(0.2, 0.9, 0.35).to(a)
        content = tint * (1 + (0.03 if door else 0.35) * _noise(a * 3, z * 3, draw.generator))[:, None]
        colour = torch.where(
            (inside < 0)[:, None], torch.where((inside > -0.05)[:, None], frame, content), colour
        )
    skirting = draw.colour(0.6, 0.95, 0.03).to(a)
    return torch.where((z < 0.09)[:, None], skirting, colour)


def room_scene(view: View, light: Light, low: Tensor, high: Tensor, generator: torch.Generator) -> Scene:
    """A furnished room around the box from ``low`` to ``high`` (3,) that holds the people and the camera.

    Args:
        view: the camera's rays.
        light: the lamp.
        low: (3,) lower corner in metres; the floor is z = 0.
        high: (3,) upper corner in metres.
        generator: draws sizes, textures and furniture.
    """
    draw = _Draw(generator)
    margin = torch.tensor([[draw.number(0.9, 2.0) for _ in range(2)] for _ in range(2)]).to(low)
    walls = torch.stack([low[:2] - margin[0], high[:2] + margin[1]])
    ceiling = max(draw.number(2.5, 3.2), float(high[2]) + 0.2)
    bounds = torch.cat([walls, walls.new_tensor([[0.0], [ceiling]])], dim=1)

    origin, direction = view.origins.expand_as(view.directions), view.directions
    # A ray leaves a box through the nearest of the three planes ahead of it.
    ahead = torch.where(direction > 0, bounds[1], bounds[0])
    reach = torch.where(direction.abs() > 1e-9, (ahead - origin) / direction, math.inf)
    depth, axis = reach.min(dim=-1)
    positive = direction.gather(1, axis[:, None])[:, 0] > 0
    points = origin + depth[:, None] * direction
    normal = F.one_hot(axis, 3).to(direction) * torch.where(positive, -1.0, 1.0)[:, None]
    colour = torch.full_like(points, 0.9)  # the ceiling
    for plane in range(5):  # walls at low x, high x, low y, high y, and the floor
        here = (axis == plane // 2) & (positive == bool(plane % 2))
        x, y, z = points[here].unbind(-1)
        if here.any():
            colour[here] = _floor(x, y, draw) if plane == 4 else _wall(y if plane < 2 else x, z, draw)
    # Corners are darker: less light reaches them.
    gap = torch.minimum(points - bounds[0], bounds[1] - points)
    gap = torch.where(F.one_hot(axis, 3).bool(), math.inf, gap).amin(dim=-1)
    colour = colour * (1 - 0.25 * torch.exp(-gap / 0.25))[:, None]

    for _ in range(draw.index(4) + 1):
        size = points.new_tensor([draw.number(0.4, 1.4), draw.number(0.35, 0.6), draw.number(0.4, 1.9)])
        wall = draw.index(3)  # left, right or far wall
        if wall < 2:
            size = size[[1, 0, 2]]
        corner = bounds[0] + (bounds[1] - bounds[0] - size).clamp(min=0) * points.new_tensor(
            [(0.0, 1.0, draw.number(0, 1))[wall], (draw.number(0, 1), draw.number(0, 1), 1.0)[wall], 0.0]
        )
        tint = draw.colour(0.15, 0.75, 0.22).to(points)
        near = (corner - origin) / direction
        far = (corner + size - origin) / direction
        enter, leave = torch.minimum(near, far), torch.maximum(near, far)
        t, side = enter.max(dim=-1)
        # Neither the camera nor people stand inside furniture: they keep a margin from the walls.
        hit = (t < leave.amin(dim=-1)) & (t > 0.3) & (t < depth)
        at = origin + t.nan_to_num(0.0, 0.0, 0.0)[:, None] * direction
        local = (at - corner) / size
        panel = ((local - 0.5).abs() > 0.47).sum(dim=-1) > 1  # edges of doors and drawers
        drawn = (
            tint
            * torch.where(panel, 0.7, 1.0)[:, None]
            * (1 + 0.05 * _noise(at[:, 0] * 8 + at[:, 1] * 8, at[:, 2] * 2, generator))[:, None]
        )
        colour = torch.where(hit[:, None], drawn, colour)
        facing = F.one_hot(side, 3).to(direction) * -direction.gather(1, side[:, None]).sign()
        normal = torch.where(hit[:, None], facing, normal)
        points = torch.where(hit[:, None], at, points)
        depth = torch.where(hit, t, depth)

    linear = colour.clamp(0, 1) ** GAMMA
    shade = linear * light.irradiance(normal, torch.zeros_like(depth))
    return Scene(shade, linear * light.irradiance(normal, torch.ones_like(depth)) - shade, points, depth)
