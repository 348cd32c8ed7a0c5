"""Appearance of people: skin, hair and patterned clothes, as colours of points on the body."""

from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.render.body import PARTS

#: sRGB in [0, 1], light to dark.
SKIN_TONES = (
    (0.95, 0.78, 0.69),
    (0.87, 0.67, 0.55),
    (0.78, 0.57, 0.43),
    (0.55, 0.38, 0.27),
    (0.38, 0.26, 0.19),
)
HAIR_COLOURS = (
    (0.08, 0.07, 0.06),
    (0.20, 0.13, 0.08),
    (0.36, 0.24, 0.13),
    (0.62, 0.48, 0.28),
    (0.50, 0.48, 0.46),
)
SHIRT_COLOURS = (
    (0.80, 0.16, 0.15), (0.13, 0.27, 0.60), (0.92, 0.92, 0.90), (0.10, 0.42, 0.25), (0.93, 0.72, 0.15),
    (0.15, 0.15, 0.17), (0.45, 0.68, 0.85), (0.55, 0.22, 0.45), (0.85, 0.45, 0.20), (0.55, 0.56, 0.58),
)  # fmt: skip
TROUSER_COLOURS = (
    (0.14, 0.19, 0.34), (0.10, 0.10, 0.11), (0.40, 0.42, 0.45), (0.62, 0.53, 0.40), (0.26, 0.34, 0.50),
    (0.30, 0.24, 0.20),
)  # fmt: skip
SHOE_COLOURS = ((0.10, 0.10, 0.10), (0.88, 0.88, 0.88), (0.30, 0.18, 0.12), (0.55, 0.10, 0.12))
PATTERNS = ("plain", "stripes", "checks", "print", "jacket")


class Look(NamedTuple):
    """Appearance of one person; colours are (3,) sRGB in [0, 1].

    Attributes:
        skin: skin tone.
        hair: hair colour.
        shirt: main colour above the belt.
        accent: second colour of the pattern.
        trousers: colour below the belt.
        shoes: colour of the shoes.
        pattern: index into PATTERNS.
        sleeve: how far sleeves reach: 0 to 1 along the upper arm, 1 to 2 along the forearm.
        leg: how far trousers reach along the leg, likewise.
        girth: thickness of the body, 1 for the median adult.
        long_hair: whether hair falls to the shoulders.
        folds: (4, 3) wave vectors of folds in the cloth, in radians per metre.
    """

    skin: Tensor
    hair: Tensor
    shirt: Tensor
    accent: Tensor
    trousers: Tensor
    shoes: Tensor
    pattern: int
    sleeve: float
    leg: float
    girth: float
    long_hair: bool
    folds: Tensor

    @classmethod
    def draw(cls, generator: torch.Generator) -> "Look":
        """A random appearance."""

        def number(low: float, high: float) -> float:
            return low + (high - low) * float(torch.rand((), generator=generator))

        def one_of(colours: tuple[tuple[float, float, float], ...]) -> Tensor:
            colour = torch.tensor(colours[int(torch.randint(len(colours), (), generator=generator))])
            return (colour + 0.03 * torch.randn(3, generator=generator)).clamp(0.02, 0.97)

        folds = torch.randn(4, 3, generator=generator)
        wave = torch.tensor([35.0, 50.0, 70.0, 95.0])[:, None]
        return cls(
            skin=one_of(SKIN_TONES),
            hair=one_of(HAIR_COLOURS),
            shirt=one_of(SHIRT_COLOURS),
            accent=one_of(SHIRT_COLOURS),
            trousers=one_of(TROUSER_COLOURS),
            shoes=one_of(SHOE_COLOURS),
            pattern=int(torch.randint(len(PATTERNS), (), generator=generator)),
            sleeve=(0.55, 0.65, 2.0)[int(torch.randint(3, (), generator=generator))],
            leg=2.0 if number(0, 1) < 0.75 else number(0.8, 1.05),
            girth=number(0.92, 1.12),
            long_hair=number(0, 1) < 0.3,
            folds=folds / folds.norm(dim=-1, keepdim=True) * wave,
        )


class Surface(NamedTuple):
    """Visible points of one body.

    Attributes:
        point: (K, 3) metres from the origin of its part along right, front and up.
        normal: (K, 3) in the same axes.
        part: (K,) int64 index into PARTS.
        share: (K,) position along the limb from its upper joint, or up the trunk from the hips, 0 to 1.
        scale: height of the body relative to the reference height.
    """

    point: Tensor
    normal: Tensor
    part: Tensor
    share: Tensor
    scale: float


class Paint(NamedTuple):
    """Albedo (K, 3) sRGB, gloss (K,) and how folds tilt the normal (K, 3, in the part's axes)."""

    albedo: Tensor
    gloss: Tensor
    folds: Tensor


def paint(look: Look, surface: Surface) -> Paint:
    """Colours of the points of one body."""
    x, y, z = (surface.point / surface.scale).unbind(-1)
    is_part = {name: surface.part == i for i, name in enumerate(PARTS)}
    like = surface.point
    albedo = look.skin.to(like).expand(like.shape[0], 3)

    def put(where: Tensor, colour: Tensor) -> None:
        nonlocal albedo
        albedo = torch.where(where[:, None], colour.to(albedo), albedo)

    face = _face(look, x, y, z, albedo)
    albedo = torch.where(is_part["head"][:, None], face, albedo)

    arm = surface.share + is_part["forearm"]
    leg = surface.share + is_part["shank"]
    neckline = (
        is_part["trunk"] & (surface.share > 0.9) & (y > 0) & (x.abs() + 0.5 * (1.06 - surface.share) < 0.075)
    )
    shirt = (is_part["trunk"] & ~neckline) | (
        (is_part["upper_arm"] | is_part["forearm"]) & (arm < look.sleeve)
    )
    # The hem of the shirt hangs over the belt.
    hem = 0.0 if PATTERNS[look.pattern] != "jacket" else -0.05
    shirt = shirt | (is_part["hips"] & (z > hem))
    legs = is_part["thigh"] | is_part["shank"]
    trousers = (is_part["hips"] & ~shirt) | (legs & (leg < look.leg))
    put(shirt, _pattern(look, x, y, z, is_part["trunk"] | is_part["hips"], like))
    put(trousers, look.trousers)
    shoe = is_part["shoe"]
    put(shoe, torch.where((z < -0.062)[:, None], 0.5 + 0.4 * look.shoes.to(like), look.shoes.to(like)))
    cloth = shirt | trousers

    # Folds run along the limbs: waves that modulate each other's phases.
    phase = surface.point @ look.folds.to(like).mT
    phase = phase + 0.8 * torch.sin(0.5 * phase.roll(1, dims=-1))
    amount = torch.where(cloth, 0.10, 0.0)[:, None]
    folds = amount * torch.cos(phase) @ (look.folds / look.folds.norm(dim=-1, keepdim=True)).to(like)
    albedo = albedo * (1 + 0.06 * torch.sin(phase).mean(-1, keepdim=True) * cloth[:, None])
    gloss = torch.where(cloth, 0.02, torch.where(shoe, 0.15, 0.10))
    return Paint(albedo.clamp(0, 1), gloss, folds)


def _pattern(look: Look, x: Tensor, y: Tensor, z: Tensor, front: Tensor, like: Tensor) -> Tensor:
    """Colours of shirts (K, 3)."""
    shirt, accent = look.shirt.to(like), look.accent.to(like)
    name = PATTERNS[look.pattern]
    if name == "stripes":
        where = torch.remainder(z, 0.08) < 0.035
    elif name == "checks":
        return (
            shirt
            + (accent - shirt)
            * 0.35
            * (
                (torch.remainder(z, 0.09) < 0.04).to(like) + (torch.remainder(x + 0.02, 0.09) < 0.04).to(like)
            )[:, None]
        )
    elif name == "print":
        where = front & (y > 0) & (((x / 0.09) ** 2 + ((z - 0.36) / 0.055) ** 2) < 1)
    elif name == "jacket":
        where = front & (y > 0) & (x.abs() < 0.02 + 0.09 * (z - 0.05).clamp(0, 0.5))
    else:
        where = torch.zeros_like(front)
    return torch.where(where[:, None], accent, shirt)


def _face(look: Look, x: Tensor, y: Tensor, z: Tensor, skin: Tensor) -> Tensor:
    """Colours of heads (K, 3): hair above the line from brow to nape, brows, eyes, mouth."""
    side = x.abs()

    def ellipse(cx: float, cz: float, rx: float, rz: float) -> Tensor:
        return (((side - cx) / rx) ** 2 + ((z - cz) / rz) ** 2 < 1) & (y > 0.03)

    red = skin.new_tensor([0.62, 0.30, 0.28])
    # Soft shades first: cheeks and the shadow of the eye sockets.
    face = torch.where(ellipse(0.033, 0.026, 0.022, 0.016)[:, None], skin * 0.78, skin)
    face = torch.where(
        ellipse(0.033, 0.026, 0.014, 0.0075)[:, None], skin.new_tensor([0.88, 0.86, 0.84]), face
    )
    face = torch.where(
        ellipse(0.032, 0.026, 0.0075, 0.0075)[:, None], skin.new_tensor([0.12, 0.08, 0.06]), face
    )
    face = torch.where(ellipse(0.033, 0.050, 0.021, 0.0055)[:, None], look.hair.to(skin) * 0.8, face)
    face = torch.where(ellipse(0.0, -0.055, 0.026, 0.009)[:, None], 0.5 * (red + skin * 0.7), face)
    face = torch.where(ellipse(0.008, -0.018, 0.006, 0.004)[:, None], skin * 0.5, face)
    hair = 0.175 * (z - 0.068) > 0.14 * (y - 0.085) + 0.0010 * torch.sin(60 * x)
    hair = hair & ~((side > 0.070) & (z < 0.035) & (y > -0.03))  # ears stay uncovered
    if look.long_hair:
        hair = hair | (y < -0.03)
    strands = 0.92 + 0.16 * torch.sin(150 * x + 60 * torch.sin(25 * y + 15 * z)).square()[:, None]
    return torch.where(hair[:, None], look.hair.to(skin) * strands, face)
