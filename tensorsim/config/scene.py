"""What the radar looks at: the radar itself, wall, floor, propagation paths, body scatterers, receiver."""

from dataclasses import dataclass, field
from typing import Literal

from tensorsim.config.checks import (
    make_plain,
    require_choices,
    require_counts,
    require_positive,
    require_ranges,
)
from tensorsim.config.radar import RadarConfig
from tensorsim.config.receiver import ClutterConfig, InterferenceConfig, ReceiverConfig
from tensorsim.config.surroundings import FloorConfig, WallConfig
from tensorsim.exceptions import TensorsimError

WallPaths = Literal["series", "paper"]
Incidence = Literal["normal", "oblique", "airy"]
Polarization = Literal["te", "tm"]
NoiseReference = Literal["echo", "total", "absolute"]
Body = Literal["joints", "limbs", "version1", "surface"]


@dataclass(frozen=True)
class SceneConfig:
    """The radar and its surroundings.

    Attributes:
        radar: the radar (panel: RADAR group).
        wall: the wall (panel: WALL group); None is free space.
        floor: a reflecting floor; None means no floor reflection.
        multipath: paths reflected inside the wall or by it; None: on if there is a wall (and no ``paths``).
        direct: the direct path to the scatterer and back.
        leakage: direct signal from transmitter to receiver (panel: isolation).
        wall_echo: static specular reflection from the wall, if there is one.
        wall_paths: internal reflections in the wall, complete to first order (``"series"``) or as in the paper.
        wall_attenuation: False removes the power loss of echoes through the wall but keeps their delay.
        incidence: ``"normal"``, ``"oblique"`` (refraction, Fresnel) or ``"airy"`` (closed slab per frequency).
        polarization: ``"te"`` or ``"tm"`` at the wall.
        bounces: largest number of bounce pairs inside the wall on each leg.
        paths: names of propagation paths, replacing the switches above, see :class:`tensorsim.radar.EchoSynthesizer`.
        body: scatterers of a person: the 14 joints of the panel, 36 points along the limbs, the 13 points of the
            original's first version, or 59 points on torso and limbs whose power over speed matches measured walks
            (``"surface"``, :class:`tensorsim.motion.BodyScatterers`).
        sway: people sway while they stand, see :class:`tensorsim.motion.PosturalSway`.
        vital_signs: people breathe and their hearts beat, see :class:`tensorsim.motion.VitalSigns`.
        clutter: furniture and walls of a room, or None.
        interference: an interfering radar, or None.
        receiver: imperfections of the receiver.
        snr_db: signal-to-noise ratio per IF sample in dB (panel: SNR, 50 dB); None means no noise.
        noise_reference: signal power that ``snr_db`` refers to, see :class:`tensorsim.radar.ReceiverNoise`.
        noise_figure_db: noise figure of the receiver in dB for ``noise_reference="absolute"``.
        transmit_power_w: transmit power in watts for ``noise_reference="absolute"``.

    Raises:
        TensorsimError: an unknown choice, or numbers out of range.
    """

    radar: RadarConfig = field(default_factory=RadarConfig)
    wall: WallConfig | None = None
    floor: FloorConfig | None = None
    multipath: bool | None = None
    direct: bool = True
    leakage: bool = False
    wall_echo: bool = False
    wall_paths: WallPaths = "series"
    wall_attenuation: bool = True
    incidence: Incidence = "normal"
    polarization: Polarization = "te"
    bounces: int = 1
    paths: tuple[str, ...] | None = None
    body: Body = "joints"
    sway: bool = False
    vital_signs: bool = False
    clutter: ClutterConfig | None = None
    interference: InterferenceConfig | None = None
    receiver: ReceiverConfig = field(default_factory=ReceiverConfig)
    snr_db: float | None = 50.0
    noise_reference: NoiseReference = "echo"
    noise_figure_db: float = 10.0
    transmit_power_w: float = 0.01

    def __post_init__(self) -> None:
        make_plain(self)
        for name, kind in (
            ("radar", RadarConfig),
            ("wall", WallConfig),
            ("floor", FloorConfig),
            ("clutter", ClutterConfig),
            ("interference", InterferenceConfig),
            ("receiver", ReceiverConfig),
        ):
            part = getattr(self, name)
            if not (isinstance(part, kind) or (part is None and name not in ("radar", "receiver"))):
                raise TensorsimError(f"SceneConfig.{name}: got {part!r}, expected a {kind.__name__}")
        require_choices(
            self,
            wall_paths=WallPaths,
            incidence=Incidence,
            polarization=Polarization,
            body=Body,
            noise_reference=NoiseReference,
        )
        switched = [name for name in ("multipath", "leakage", "wall_echo") if getattr(self, name)]
        switched += ["direct"] * (not self.direct)
        if self.paths is not None and switched:
            raise TensorsimError(
                f"SceneConfig.paths: got names of paths and {', '.join(switched)}, expected one or the other"
            )
        require_counts(self, "bounces", most=50)
        require_ranges(self, noise_figure_db="ratio of powers")
        if self.snr_db is not None:
            require_ranges(self, snr_db="ratio of powers")
        require_positive("SceneConfig", transmit_power_w=self.transmit_power_w)

    @property
    def has_multipath(self) -> bool:
        """``multipath``; if it is None, whether there is a wall (and no list of ``paths``)."""
        if self.multipath is None:
            return self.wall is not None and self.paths is None
        return self.multipath

    @property
    def sampled_effects(self) -> tuple[str, ...]:
        """Names of the effects that act on samples of the intermediate frequency."""
        return self.receiver.effects + ("interference",) * (self.interference is not None)

    def check_engine(self, engine: str) -> None:
        """Refuse the engine ``"range-bins"``, which computes no samples, for effects that act on them.

        Raises:
            TensorsimError: such a combination.
        """
        if engine != "time" and self.sampled_effects:
            raise TensorsimError(
                f"engine: got {engine!r} with {', '.join(self.sampled_effects)}, which act on samples; expected 'time'"
            )
