"""What differs between the samples that are made of one clip, and how it is drawn."""

import hashlib
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from tensorsim.config.checks import is_finite, require_counts
from tensorsim.config.scene import Body
from tensorsim.errors import TensorsimError

Range = tuple[float, float]


@dataclass(frozen=True)
class VariationConfig:
    """Ranges (low, high) are drawn uniformly; a range of equal numbers is fixed. None leaves a quantity as it is.

    Attributes:
        count: samples made of every clip.
        height_m: body height.
        distance_m: y of the hips of the first person at the start.
        side_m: x of the hips of the first person at the start.
        keep_m: nearest and farthest y of anybody; people are moved along y by the least amount to stay inside.
        heading_deg: turn of the whole motion about the vertical. Generated people face the radar at 0.
        mirror: probability that left and right are exchanged.
        speed: factor on the speed of the motion.
        people: least and most people (clips, for recordings) of a scene; the label is that of the first.
        spacing_m: distance in x of neighbours at the start.
        bodies: scatterers of a person to choose from, see :class:`~tensorsim.SceneConfig`.
        snr_db: signal-to-noise ratio per IF sample; None takes that of the scene.
        sway, vital_signs: probability that people sway, and that they breathe.
        wall_permittivity, wall_thickness_m: of the walls that radars have.

    Raises:
        TensorsimError: a range that does not ascend or is out of bounds, a probability outside of 0 to 1.
    """

    count: int = 1
    height_m: Range | None = (1.55, 1.9)
    distance_m: Range | None = (2.0, 5.0)
    side_m: Range = (-0.3, 0.3)
    keep_m: Range = (1.5, 7.0)
    heading_deg: Range = (-30.0, 30.0)
    mirror: float = 0.5
    speed: Range = (1.0, 1.0)
    people: tuple[int, int] = (1, 1)
    spacing_m: float = 0.8
    bodies: tuple[str, ...] = ("joints",)
    snr_db: Range | None = (10.0, 50.0)
    sway: float = 0.0
    vital_signs: float = 0.0
    wall_permittivity: Range | None = None
    wall_thickness_m: Range | None = None

    def __post_init__(self) -> None:
        require_counts(self, "count")
        for name, least, most in (
            ("height_m", 0.5, 2.5),
            ("distance_m", 0.3, 1000.0),
            ("side_m", -1000.0, 1000.0),
            ("keep_m", 0.3, 1000.0),
            ("heading_deg", -360.0, 360.0),
            ("speed", 0.2, 5.0),
            ("people", 1, 16),
            ("snr_db", -200.0, 300.0),
            ("wall_permittivity", 1.0, 1000.0),
            ("wall_thickness_m", 0.0, 10.0),
        ):
            value = getattr(self, name)
            if value is not None and not (len(value) == 2 and least <= value[0] <= value[1] <= most):
                raise TensorsimError(
                    f"VariationConfig.{name}: got {list(value)}, expected two numbers that ascend within {least} to "
                    f"{most}"
                )
        for name in ("mirror", "sway", "vital_signs"):
            value = getattr(self, name)
            if not (is_finite(value) and 0 <= value <= 1):
                raise TensorsimError(
                    f"VariationConfig.{name}: got {value!r}, expected a probability from 0 to 1"
                )
        known = Body.__args__  # type: ignore[attr-defined]
        if not self.bodies or set(self.bodies) - set(known):
            raise TensorsimError(
                f"VariationConfig.bodies: got {list(self.bodies)}, expected some of {', '.join(known)}"
            )


@dataclass(frozen=True)
class Variation:
    """What was drawn for one sample; a row of the manifest has these fields, from which the sample is made again.

    Attributes:
        seed: of body, manner and noise.
        height_m, distance_m, side_m, heading_deg, mirrored, speed: of the first person.
        start: beginning of the part of a long clip, as a share of what there is to choose from.
        companions: seeds of further people, by comma.
        body, snr_db, sway, vital_signs, wall_permittivity, wall_thickness_m: of the scene.
    """

    seed: int
    height_m: float | None
    distance_m: float | None
    side_m: float
    heading_deg: float
    mirrored: bool
    speed: float
    start: float
    companions: str
    body: str
    snr_db: float | None
    sway: bool
    vital_signs: bool
    wall_permittivity: float | None
    wall_thickness_m: float | None

    def row(self) -> dict[str, Any]:
        """As columns of the manifest."""
        return asdict(self)

    @classmethod
    def of_row(cls, row: dict[str, Any]) -> "Variation":
        """The inverse of :meth:`row`; other columns are left aside."""
        return cls(**{field.name: row[field.name] for field in fields(cls)})


def seed_of(*words: object) -> int:
    """A seed from 0 to 2^63 - 1 that depends on these words alone."""
    text = "\0".join(str(word) for word in words)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def draw(config: VariationConfig, seed: int) -> Variation:
    """The variation of this seed. One number is drawn for each field, so that ranges do not affect one another."""
    numbers = np.random.Generator(np.random.PCG64(seed)).random(32)
    place = iter(numbers.tolist())

    def between(limits: Range | None) -> float | None:
        share = next(place)
        return None if limits is None else limits[0] + (limits[1] - limits[0]) * share

    def some(limits: Range) -> float:
        return limits[0] + (limits[1] - limits[0]) * next(place)

    least, most = config.people
    others = least - 1 + int((most - least + 1) * next(place))
    return Variation(
        seed=seed,
        companions=",".join(str(seed_of(seed, "companion", k)) for k in range(others)),
        height_m=between(config.height_m),
        distance_m=between(config.distance_m),
        side_m=some(config.side_m),
        heading_deg=some(config.heading_deg),
        mirrored=next(place) < config.mirror,
        speed=some(config.speed),
        start=next(place),
        body=config.bodies[int(len(config.bodies) * next(place))],
        snr_db=between(config.snr_db),
        sway=next(place) < config.sway,
        vital_signs=next(place) < config.vital_signs,
        wall_permittivity=between(config.wall_permittivity),
        wall_thickness_m=between(config.wall_thickness_m),
    )
