"""Options of the radar that several commands share, and the stage that they describe."""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from tensorsim.errors import TensorsimError

if TYPE_CHECKING:
    from torch import nn

    from tensorsim.pipeline import PoseToDoppler
    from tensorsim.radar.presets import RadarScene
    from tensorsim.recognition import ActivityRecognizer

#: Above this many pulses (16 s in free space) range-time maps are kept at a display rate instead of every pulse.
FULL_RATE_PULSES = 1 << 17
DISPLAY_RATE_HZ = 256.0


def check_seed(seed: int, option: str = "--seed") -> None:
    """Refuse a seed that some generator would not take."""
    if not 0 <= seed < 2**32:
        raise TensorsimError(f"{option}: got {seed}, expected an integer from 0 to 2^32 - 1")


@dataclass(frozen=True, kw_only=True)
class RadarOptions:
    """How people's joints become maps."""

    scene: Literal["free-space", "through-wall"] = "free-space"
    """77 GHz radar in the open, or 2 GHz radar behind a wall with multipath."""
    radar: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Another radar for the scene: a preset (tensorsim.radar.presets: ti-awr1642, ti-awr1843, ti-iwr6843,
    infineon-bgt60tr13c, infineon-bgt24mtr12, cw-24ghz, free-space, through-wall) or a YAML file with fields of
    RadarConfig; a wall that it comes with replaces the scene's, a floor adds its reflections."""
    body: Literal["joints", "limbs", "version1"] = "joints"
    """Scatterers of a person: the 14 joints with the panel's cross sections, 36 points along ellipsoidal limbs whose
    cross section follows the aspect, or the 13 points of the original's first version."""
    motion: Literal["smooth", "paper"] = "smooth"
    """Two-sided smoothing and a spline, or the paper's forward filter, straight lines and Savitzky-Golay."""
    integration: Literal["noncoherent", "paper"] = "noncoherent"
    """How the Doppler-time map sums range bins; "paper" loses the sign of Doppler."""
    wall_paths: Literal["series", "paper"] = "series"
    """Bounces inside the wall: complete to first order, or the paper's."""
    multipath: bool | None = None
    """Wall bounces; default on behind a wall."""
    leakage: bool = False
    """Direct signal from transmitter to receiver."""
    wall_echo: bool = False
    """Static mirror reflection of the wall."""
    snr: float = 50.0
    """Signal-to-noise ratio in dB of the people's echo, per IF sample."""
    denoiser: str | None = None
    """DnCNN weights (.pth or .safetensors, or a name such as dncnn-radar-maps) to clean the shown maps."""
    classifier: str | None = None
    """Activity classifier: SPNet or its light sibling as .safetensors, or a name of `tensorsim models list`; "none"
    for no label. Default: the shipped one."""
    seed: int = 0
    """Seed of everything that is random."""
    device: str = "auto"
    """cpu, cuda, cuda:1, ...; auto takes a GPU where there is one."""
    quiet: bool = False
    """No progress bars."""

    def check(self, out: Path) -> None:
        """Refuse options that cannot work, before anything heavy is imported."""
        check_seed(self.seed)
        if not math.isfinite(self.snr):
            raise TensorsimError(f"--snr: got {self.snr}, expected a finite number of dB")
        if out.exists() and not out.is_dir():
            raise TensorsimError(f"--out: {out} is a file, expected a folder")

    def described(self) -> dict[str, Any]:
        """The options as ``summary.json`` has them."""
        return {name: str(v) if isinstance(v, Path) else v for name, v in asdict(self).items()}

    def radar_scene(self) -> "RadarScene":
        """The radar and what surrounds it."""
        from tensorsim.radar.presets import PRESETS, RadarScene, radar_scene

        scene = PRESETS[self.scene]
        if self.radar is None:
            return scene
        try:
            chosen = radar_scene(self.radar)
        except TensorsimError as error:
            raise TensorsimError(f"--radar: {error}") from None
        if chosen.radar.has_array:
            raise TensorsimError(
                f"--radar: {self.radar} has several antennas, expected one transmitter and one receiver: the maps "
                "of this command have no antenna dimension"
            )
        return RadarScene(chosen.radar, chosen.wall if chosen.wall is not None else scene.wall, chosen.floor)

    def pose_to_doppler(self, scene: "RadarScene", length_s: float) -> "PoseToDoppler":
        """The stage from joints to maps, for people over about this many seconds."""
        from tensorsim.enhance.dncnn import MapDenoiser
        from tensorsim.motion.resample import PoseResampler
        from tensorsim.motion.savgol import SavitzkyGolay
        from tensorsim.pipeline import PoseToDoppler
        from tensorsim.radar.simulator import RadarSimulator

        radar, wall, floor = scene
        behind_wall = wall is not None
        simulator = RadarSimulator(
            radar,
            wall,
            multipath=behind_wall if self.multipath is None else self.multipath,
            leakage=self.leakage,
            wall_echo=self.wall_echo,
            wall_paths=self.wall_paths,
            floor=floor,
            snr_db=self.snr,
            integration=self.integration,
            display_rate_hz=DISPLAY_RATE_HZ if length_s * radar.prf_hz > FULL_RATE_PULSES else None,
        )
        resampler, pulse_smoother = None, None
        if self.motion == "paper":
            # The panel's smoothing ratio of 0.25, read as a quarter of a second of pulses.
            window = round(0.25 * radar.prf_hz) // 2 * 2 + 1
            resampler = PoseResampler(radar.prf_hz, method="linear")
            pulse_smoother = SavitzkyGolay(window, 3)
        return PoseToDoppler(
            simulator,
            resampler=resampler,
            pulse_smoother=pulse_smoother,
            scatterers=self._scatterers(scene),
            denoiser=None if self.denoiser is None else MapDenoiser.from_pretrained(self.denoiser),
        )

    def recognizer(self, scene: "RadarScene") -> "ActivityRecognizer | None":
        """What tells the activity from the maps of this radar; None if it is not wanted."""
        from tensorsim.config import ACTIVITIES
        from tensorsim.recognition import ActivityRecognizer

        if self.classifier == "none":
            return None
        try:
            recognizer = ActivityRecognizer.from_pretrained(scene.radar, self.classifier)
        except TensorsimError as error:
            raise TensorsimError(f"--classifier: {error}") from None
        if recognizer.network.num_classes != len(ACTIVITIES):
            raise TensorsimError(
                f"--classifier: {self.classifier} tells {recognizer.network.num_classes} classes, expected the "
                f"{len(ACTIVITIES)} activities"
            )
        return recognizer

    def _scatterers(self, scene: "RadarScene") -> "nn.Module":
        from tensorsim.motion import Body13Scatterers, JointScatterers, LimbScatterers

        if self.body == "limbs":
            return LimbScatterers(scene.radar.tx_positions_m[0], scene.radar.rx_positions_m[0])
        return JointScatterers() if self.body == "joints" else Body13Scatterers()
