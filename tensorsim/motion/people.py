"""People: bodies and ways of moving, drawn at random from the distributions of a frozen config."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.body.proportions import Proportions
from tensorsim.config.checks import is_finite
from tensorsim.errors import TensorsimError, check_count, check_interval, check_positive

#: Largest count of numbers of a movement (angles, times) that vary from person to person.
VARIED_NUMBERS = 24

#: Largest distance that start and keep ranges may have.
FARTHEST_M = 1e6

Range = tuple[float, float]


@dataclass(frozen=True)
class PeopleConfig:
    """Distributions of people and of how they move; ranges are uniform, (low, high).

    Attributes:
        height_m: body height.
        body_mass_index: mean and standard deviation in kg/m^2, cut at 3 deviations; times height^2 gives the mass.
        female_share: probability of a female body: shoulders 4 % narrower and hips 4 % wider than the mean
            (male: the reverse).
        limb_deviation: standard deviation of each segment length, relative to it, cut at 2 deviations.
        speed_m_s: mean walking speed.
        heading_rad: largest deviation of the heading from the line of sight, to either side.
        facing_radar_share: probability of heading towards the radar rather than away from it.
        start_range_m: distance y of the body at the start.
        keep_range_m: nearest and farthest y of the hips; paths are shifted along y to stay inside (near limit first).
        start_side_m: largest absolute x of the middle of the path.
        left_handed_share: probability of the mirrored movement.
        variation: largest relative deviation of each angle and time of a movement.
        tempo: speed of punches, kicks and falls: 1 means trained strikes and a fall without resistance, in which
            ankles, fists and heads reach 8, 5 and 6 m/s; lower for people who act them out in a room. Nobody falls
            faster than at 1.

    Raises:
        TensorsimError: a range that is not ascending and finite, a share outside [0, 1], a number that is not
            finite, or impossible body sizes.
    """

    height_m: Range = (1.55, 1.90)
    body_mass_index: Range = (23.5, 3.0)
    female_share: float = 0.5
    limb_deviation: float = 0.03
    speed_m_s: Range = (0.7, 1.4)
    heading_rad: float = math.pi / 6
    facing_radar_share: float = 0.5
    start_range_m: Range = (2.0, 5.0)
    keep_range_m: Range = (1.5, 7.0)
    start_side_m: float = 0.3
    left_handed_share: float = 0.5
    variation: float = 0.15
    tempo: Range = (1.0, 1.0)

    def __post_init__(self) -> None:
        for name, least, most in (
            ("height_m", 0.5, 2.5),
            ("speed_m_s", 0.2, 2.0),
            ("tempo", 0.3, 1.5),
            ("start_range_m", 0.0, FARTHEST_M),
            ("keep_range_m", 0.0, FARTHEST_M),
        ):
            check_interval(getattr(self, name), least, most, f"PeopleConfig.{name}")
        index = self.body_mass_index
        pair = index if isinstance(index, tuple | list) and len(index) == 2 else ()
        numbers = [x for x in pair if is_finite(x)]
        if len(numbers) != 2 or not 0 <= 3 * numbers[1] < numbers[0]:
            raise TensorsimError(
                f"PeopleConfig.body_mass_index: got {index!r}, expected a mean above 3 deviations"
            )
        for name, most in (
            ("female_share", 1.0),
            ("facing_radar_share", 1.0),
            ("left_handed_share", 1.0),
            ("limb_deviation", 0.1),
            ("variation", 0.2),
            ("heading_rad", math.pi),
            ("start_side_m", FARTHEST_M),
        ):
            value = getattr(self, name)
            if not (is_finite(value) and 0 <= value <= most):
                raise TensorsimError(
                    f"PeopleConfig.{name}: got {value!r}, expected a number from 0 to {most}"
                )


class People(NamedTuple):
    """Drawn bodies and ways of moving; every field has one entry per person.

    Attributes:
        height_m, mass_kg: (B,).
        female, left_handed: (B,) bool.
        proportions: segments as fractions of the height, each (B,).
        speed_m_s: (B,) mean walking speed.
        heading_rad: (B,) direction of the body at the start, 0 = +y (away from the radar), counter-clockwise.
        start_m: (B, 2) middle of the path in x, and y at the start, before the path is shifted to stay in range.
        gait_phase: (B,) gait phase in cycles at time 0.
        factor: (B, VARIED_NUMBERS) factors around 1, one for each varying number of a movement.
        tempo: (B,) speed of punches, kicks and falls.
    """

    height_m: Tensor
    mass_kg: Tensor
    female: Tensor
    left_handed: Tensor
    proportions: Proportions
    speed_m_s: Tensor
    heading_rad: Tensor
    start_m: Tensor
    gait_phase: Tensor
    factor: Tensor
    tempo: Tensor

    def take(self, index: Tensor) -> "People":
        """The people with these indices (N,)."""
        fields = self._asdict()
        fields["proportions"] = Proportions(*(torch.as_tensor(p)[index] for p in self.proportions))
        return People(**{k: v if k == "proportions" else v[index] for k, v in fields.items()})

    def double(self) -> "People":
        """The same people with float64 numbers."""
        fields = {
            k: v.double() if v.is_floating_point() else v
            for k, v in self._asdict().items()
            if k != "proportions"
        }
        sizes = Proportions(*(torch.as_tensor(p).double() for p in self.proportions))
        return People(**fields, proportions=sizes)


def nominal_people(count: int, height_m: float = 1.75, speed_m_s: float = 1.1) -> People:
    """Mean bodies without individual deviations: right-handed, facing the radar from 4 m.

    Raises:
        TensorsimError: a count below 1, a height or a speed that is not positive.
    """
    check_count(count, "nominal_people.count")
    check_positive(height_m, "height_m")
    check_positive(speed_m_s, "speed_m_s")

    def full(value: float, *tail: int) -> Tensor:
        return torch.full((count, *tail), value, dtype=torch.float64)

    no = torch.zeros(count, dtype=torch.bool)
    return People(
        height_m=full(height_m),
        mass_kg=full(23.5 * height_m**2),
        female=no,
        left_handed=no,
        proportions=Proportions(*(full(float(p)) for p in Proportions())),
        speed_m_s=full(speed_m_s),
        heading_rad=full(math.pi),
        start_m=torch.stack([full(0.0), full(4.0)], dim=-1),
        gait_phase=full(0.0),
        factor=full(1.0, VARIED_NUMBERS),
        tempo=full(1.0),
    )


def draw_people(count: int, config: PeopleConfig, generator: torch.Generator) -> People:
    """Draw people. The generator lives on the CPU; all numbers are float64.

    Raises:
        TensorsimError: a count below 1.
    """
    check_count(count, "draw_people.count")

    def uniform(low: float, high: float, *tail: int) -> Tensor:
        return low + (high - low) * torch.rand(count, *tail, generator=generator, dtype=torch.float64)

    def normal(deviation: float, cut: float, *tail: int) -> Tensor:
        z = torch.randn(count, *tail, generator=generator, dtype=torch.float64)
        return deviation * z.clamp(-cut, cut)

    height = uniform(*config.height_m)
    female = uniform(0, 1) < config.female_share
    broad = 0.04 - 0.08 * female.double()
    limbs = 1 + normal(config.limb_deviation, 2.0, len(Proportions._fields))
    sizes = [float(mean) * limbs[:, i] for i, mean in enumerate(Proportions())]
    proportions = Proportions(*sizes)
    proportions = proportions._replace(
        half_shoulders=proportions.half_shoulders * (1 + broad), half_hips=proportions.half_hips * (1 - broad)
    )
    mean_index, index_deviation = config.body_mass_index
    slowest, fastest = config.tempo
    facing = uniform(0, 1) < config.facing_radar_share
    return People(
        height_m=height,
        mass_kg=(mean_index + normal(index_deviation, 3.0)) * height**2,
        female=female,
        left_handed=uniform(0, 1) < config.left_handed_share,
        proportions=proportions,
        speed_m_s=uniform(*config.speed_m_s),
        heading_rad=math.pi * facing + uniform(-config.heading_rad, config.heading_rad),
        start_m=torch.stack(
            [uniform(-config.start_side_m, config.start_side_m), uniform(*config.start_range_m)], dim=-1
        ),
        gait_phase=uniform(0, 1),
        factor=1 + uniform(-config.variation, config.variation, VARIED_NUMBERS),
        # A fixed tempo is not drawn, so that the generator's state does not change.
        tempo=uniform(slowest, fastest) if slowest < fastest else torch.full_like(height, slowest),
    )
