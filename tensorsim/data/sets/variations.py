"""What differs between samples made from one clip, and how it is drawn."""

import hashlib
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from tensorsim.config import ReceiverConfig
from tensorsim.config.checks import is_finite, require_counts
from tensorsim.config.scene import Body
from tensorsim.enhance.choice import check_denoiser
from tensorsim.errors import TensorsimError

Range = tuple[float, float]


@dataclass(frozen=True)
class VariationConfig:
    """Ranges (low, high) to draw from uniformly; equal numbers fix a value. None leaves a quantity as it is.

    Attributes:
        count: samples made from each clip.
        height_m: body height.
        distance_m: y of the hips of the first person at the start.
        side_m: x of the hips of the first person at the start; for generated people, of the middle of their path.
        keep_m: nearest and farthest y of anybody; people are moved along y by the smallest amount to stay inside.
        heading_deg: rotation of the whole motion about the vertical. Generated people face the radar at 0.
        mirror: probability that left and right are swapped.
        speed: factor on the speed of the motion.
        people: smallest and largest number of people (for recordings, clips) in a scene; the first gives the label.
        spacing_m: distance in x between neighbours at the start.
        bodies: scatterer models to choose from, see :class:`~tensorsim.SceneConfig`.
        snr_db: signal-to-noise ratio per IF sample; None takes that of the scene.
        sway, vital_signs: probability that people sway, and that they breathe.
        wall_permittivity, wall_thickness_m: of the radars' walls, if they have any.
        phase_noise_dbc_hz, iq_imbalance_db, iq_phase_rad, dc_offset_db, adc_bits, adc_headroom_db: of the receivers,
            see :class:`~tensorsim.config.ReceiverConfig`. Samples with such effects use the engine ``"time"``.
        real_receiver: probability that receivers have one channel instead of I and Q.
        denoisers: denoisers to choose from, see :class:`~tensorsim.config.ProcessingConfig`; none keeps that of the
            recipe.

    Raises:
        TensorsimError: a range that does not ascend or is out of bounds, a probability outside 0 to 1, or an unknown
            scatterer model or denoiser.
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
    phase_noise_dbc_hz: Range | None = None
    iq_imbalance_db: Range | None = None
    iq_phase_rad: Range | None = None
    dc_offset_db: Range | None = None
    adc_bits: tuple[int, int] | None = None
    adc_headroom_db: Range | None = None
    real_receiver: float = 0.0
    denoisers: tuple[str, ...] = ()

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
            ("phase_noise_dbc_hz", -200.0, 0.0),
            ("iq_imbalance_db", -20.0, 20.0),
            ("iq_phase_rad", -1.5, 1.5),
            ("dc_offset_db", -200.0, 300.0),
            ("adc_bits", 1, 24),
            ("adc_headroom_db", -100.0, 100.0),
        ):
            value = getattr(self, name)
            if value is not None and not (len(value) == 2 and least <= value[0] <= value[1] <= most):
                raise TensorsimError(
                    f"VariationConfig.{name}: got {list(value)}, expected two ascending numbers within {least} to "
                    f"{most}"
                )
        if not (is_finite(self.spacing_m) and 0 <= self.spacing_m <= 1000):
            raise TensorsimError(
                f"VariationConfig.spacing_m: got {self.spacing_m!r}, expected metres from 0 to 1000"
            )
        for name in ("mirror", "sway", "vital_signs", "real_receiver"):
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
        for name in self.denoisers:
            check_denoiser(name)


@dataclass(frozen=True)
class Variation:
    """What was drawn for one sample; the sample can be recreated from these fields, which are in its manifest row.

    Attributes:
        seed: for body, manner and noise.
        height_m, distance_m, side_m, heading_deg, mirrored, speed: of the first person.
        start: start of the section of a long clip, as a fraction of the possible start times.
        companions: seeds of further people, comma-separated.
        body, snr_db, sway, vital_signs, wall_permittivity, wall_thickness_m: of the scene.
        phase_noise_dbc_hz, iq_imbalance_db, iq_phase_rad, dc_offset_db, adc_bits, adc_headroom_db, real_receiver: of
            the receivers.
        denoiser: of the maps.
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
    phase_noise_dbc_hz: float | None
    iq_imbalance_db: float | None
    iq_phase_rad: float | None
    dc_offset_db: float | None
    adc_bits: int | None
    adc_headroom_db: float | None
    real_receiver: bool
    denoiser: str | None

    def row(self) -> dict[str, Any]:
        """The fields as manifest columns."""
        return asdict(self)

    @classmethod
    def of_row(cls, row: dict[str, Any]) -> "Variation":
        """The inverse of :meth:`row`; other columns are ignored."""
        return cls(**{field.name: row[field.name] for field in fields(cls)})

    def receiver(self, usual: ReceiverConfig) -> ReceiverConfig:
        """A receiver with the drawn values; the rest is as in ``usual``."""
        names = [field.name for field in fields(ReceiverConfig) if field.name != "real"]
        drawn = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return replace(usual, real=usual.real or self.real_receiver, **drawn)


def seed_of(*words: object) -> int:
    """A seed from 0 to 2^63 - 1 that depends only on these words."""
    text = "\0".join(str(word) for word in words)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def draw(config: VariationConfig, seed: int) -> Variation:
    """The variation of this seed. One number is drawn for each field, so that ranges do not affect each other."""
    numbers = np.random.Generator(np.random.PCG64(seed)).random(32)
    place = iter(numbers.tolist())

    def between(limits: Range | None) -> float | None:
        share = next(place)
        return None if limits is None else limits[0] + (limits[1] - limits[0]) * share

    def some(limits: Range) -> float:
        return limits[0] + (limits[1] - limits[0]) * next(place)

    def whole(limits: tuple[int, int] | None) -> int | None:
        share = next(place)
        return None if limits is None else limits[0] + int((limits[1] - limits[0] + 1) * share)

    def one_of(choices: tuple[str, ...]) -> str | None:
        share = next(place)
        return choices[int(len(choices) * share)] if choices else None

    others = (whole(config.people) or 1) - 1
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
        body=one_of(config.bodies) or "joints",
        snr_db=between(config.snr_db),
        sway=next(place) < config.sway,
        vital_signs=next(place) < config.vital_signs,
        wall_permittivity=between(config.wall_permittivity),
        wall_thickness_m=between(config.wall_thickness_m),
        phase_noise_dbc_hz=between(config.phase_noise_dbc_hz),
        iq_imbalance_db=between(config.iq_imbalance_db),
        iq_phase_rad=between(config.iq_phase_rad),
        dc_offset_db=between(config.dc_offset_db),
        adc_bits=whole(config.adc_bits),
        adc_headroom_db=between(config.adc_headroom_db),
        real_receiver=next(place) < config.real_receiver,
        denoiser=one_of(config.denoisers),
    )
