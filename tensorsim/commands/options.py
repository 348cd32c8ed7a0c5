"""Options that describe a simulation; each changes a field of its :class:`~tensorsim.SimulationConfig`."""

import dataclasses
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from tensorsim.commands.arguments import Option
from tensorsim.commands.panel import PANEL_FIELDS, PanelOptions
from tensorsim.commands.receiver import RECEIVER_FIELDS, ReceiverOptions
from tensorsim.exceptions import TensorsimError, TensorsimWarning, check_seed
from tensorsim.files import check_folder

if TYPE_CHECKING:
    from tensorsim.config import SceneConfig, SimulationConfig
    from tensorsim.pipeline import PoseToDoppler
    from tensorsim.recognition import ActivityRecognizer

#: Columns per second of the written range-time maps, unless every pulse is requested.
DISPLAY_RATE_HZ = 256.0

#: The field of the configuration that an option sets.
FIELDS: dict[str, str] = {
    "body": "scene__body",
    "integration": "processing__integration",
    "wall_paths": "scene__wall_paths",
    "multipath": "scene__multipath",
    "snr": "scene__snr_db",
    "denoiser": "processing__denoiser",
    "classifier": "classifier",
    "seed": "seed",
    "people": "pose__people",
    "flip_test": "pose__flip_test",
    "leakage": "scene__leakage",
    "wall_echo": "scene__wall_echo",
    "sway": "scene__sway",
    "vital_signs": "scene__vital_signs",
}
FIELDS |= PANEL_FIELDS | RECEIVER_FIELDS


def _has_wall(scene: "SceneConfig") -> bool:
    return scene.wall is not None


def _has_leakage(scene: "SceneConfig") -> bool:
    return scene.leakage or "leakage" in (scene.paths or ())


def _has_converters(scene: "SceneConfig") -> bool:
    return scene.receiver.adc_bits is not None


#: The thing that an option changes: its name, and whether a scene has it. Without it the option has no effect.
_NEEDED: dict[str, tuple[str, Callable[["SceneConfig"], bool]]] = {
    "multipath": ("a wall", _has_wall),
    "wall_echo": ("a wall", _has_wall),
    "wall_paths": ("a wall", _has_wall),
    "isolation_db": ("--leakage", _has_leakage),
    "adc_headroom_db": ("--adc-bits", _has_converters),
}


@dataclass(frozen=True, kw_only=True)
class RadarOptions(PanelOptions, ReceiverOptions):
    """How people's joints become maps, and how these look. Options not given keep the configured value."""

    config: Annotated[Option[Path], tyro.conf.arg(metavar="YAML")] = None
    """Configuration of a run: a YAML file with fields of SimulationConfig, or the summary.json of an earlier run. Other
    options override it."""
    paper: bool = False
    """Use the paper's literal formulas throughout (SimulationConfig.paper)."""
    scene: Option[Literal["free-space", "through-wall"]] = None
    """A 77 GHz radar in free space, or a 2 GHz radar behind a wall, with multipath. Default: free-space."""
    radar: Annotated[Option[str], tyro.conf.arg(metavar="NAME|FILE")] = None
    """Another radar for the scene: a preset (tensorsim.radar.presets: ti-awr1642, ti-awr1843, ti-iwr6843,
    infineon-bgt60tr13c, infineon-bgt24mtr12, cw-24ghz, glasgow-ancortek, radhar-iwr1443, free-space, through-wall, and
    the arrays ti-awr1843-array, infineon-bgt60tr13c-array) or a YAML file with fields of RadarConfig; its wall, if
    any, replaces that of the scene; its floor, if any, adds reflections."""
    body: Option[Literal["joints", "limbs", "version1", "surface"]] = None
    """Scatterers of a person: the 14 joints with the panel's cross sections (joints), 36 points along ellipsoidal limbs
    with aspect-dependent cross sections (limbs), the 13 points of the original's first version (version1), or 59 points
    on torso and limbs whose power at each speed matches measured walks (surface). Default: joints."""
    integration: Option[Literal["noncoherent", "paper"]] = None
    """How the Doppler-time map sums over range bins; "paper" loses the sign of Doppler. Default: noncoherent."""
    wall_paths: Option[Literal["series", "paper"]] = None
    """Internal reflections in the wall: complete to first order, or as in the paper. Default: series."""
    multipath: Annotated[Option[bool], tyro.conf.FlagConversionOff] = None
    """Paths reflected by the wall or inside it. Default: True if there is a wall."""
    leakage: Option[bool] = None
    """Direct signal from transmitter to receiver. Default: off."""
    wall_echo: Option[bool] = None
    """Static specular reflection from the wall. Default: off."""
    snr: Option[float] = None
    """Signal-to-noise ratio of the people's echo in dB, per IF sample. Default: 50."""
    classifier: Option[str] = None
    """Activity classifier: SPGNet or SPNet as .safetensors, or a name from `tensorsim models list`; "none" for no
    label. Default: the shipped one."""
    least_probability: float = 0.2
    """Labels with a lower probability become "not sure"; 0 always returns the most probable class."""
    seed: Option[int] = None
    """Random seed. Default: 0."""
    colormap: Literal["turbo", "viridis", "jet", "parula", "gray"] = "turbo"
    """Colour scale of the maps."""
    dynamic_range: float = 50.0
    """Dynamic range of the maps, in dB below the peak."""
    quiet: bool = False
    """No progress bars."""

    def check(self, out: Path) -> None:
        """Refuse options that cannot work, before anything heavy is imported."""
        if self.seed is not None:
            check_seed(self.seed, "--seed")
        if self.snr is not None and not math.isfinite(self.snr):
            raise TensorsimError(f"--snr: got {self.snr}, expected a finite number of dB")
        if not (math.isfinite(self.dynamic_range) and self.dynamic_range > 0):
            raise TensorsimError(
                f"--dynamic-range: got {self.dynamic_range}, expected a positive number of dB"
            )
        if not 0 <= self.least_probability <= 1:
            raise TensorsimError(
                f"--least-probability: got {self.least_probability}, expected a number from 0 to 1"
            )
        check_folder(out)

    def configuration(self) -> "SimulationConfig":
        """The configuration of the run: that of ``--config``, with fields overridden by the other options.

        Raises:
            TensorsimError: a file that cannot be read, values out of range, or an option without effect.
        """
        config = self.with_receiver(self._begun())
        own = {field.name for field in dataclasses.fields(self)}
        for option, field in FIELDS.items():
            value = getattr(self, option) if option in own else None
            if value is not None:
                try:
                    config = config.replace(**{field: value})
                except TensorsimError as error:
                    raise TensorsimError(f"--{option.replace('_', '-')}: {error}") from None
        for option, (part, is_there) in _NEEDED.items():
            value = getattr(self, option)
            if value is not None and value is not False and not is_there(config.scene):
                raise TensorsimError(f"--{option.replace('_', '-')} has no effect without {part}")
        return config

    def _begun(self) -> "SimulationConfig":
        """The configuration before options that set one field each."""
        from tensorsim.config import SimulationConfig

        config = SimulationConfig() if self.config is None else SimulationConfig.from_yaml(self.config)
        config = self._with_scene(config)
        return SimulationConfig.paper(config) if self.paper else config

    def _with_scene(self, config: "SimulationConfig") -> "SimulationConfig":
        """The configuration with the radar, wall and floor that ``--scene`` and ``--radar`` name."""
        from tensorsim.radar.presets import PRESETS, radar_scene

        if self.scene is not None:
            preset = PRESETS[self.scene]
            config = config.replace(scene__radar=preset.radar, scene__wall=preset.wall)
        if self.radar is None:
            return config
        try:
            chosen = radar_scene(self.radar)
        except TensorsimError as error:
            raise TensorsimError(f"--radar: {error}") from None
        wall = chosen.wall if chosen.wall is not None else config.scene.wall
        return config.replace(scene__radar=chosen.radar, scene__wall=wall, scene__floor=chosen.floor)


def check_drawable(stage: "PoseToDoppler") -> None:
    """Refuse range-time maps of one row, before people are detected."""
    if stage.simulator.range_profile.range_m.shape[0] < 2:
        raise TensorsimError("range_gate_m: got a gate that holds one range bin, expected two or more")


def number_of_people(count: int) -> str:
    """``1 person``, ``2 people``."""
    return f"{count} {'person' if count == 1 else 'people'}"


def described_label(label: dict[str, Any]) -> str:
    """``S8 Walking (0.98)``: the label and its probability, from :func:`tensorsim.summary.label_of`."""
    name = label["label"]
    probabilities = label["probabilities"] or {}
    return f"{name} ({probabilities[name]:.2f})" if name in probabilities else name or "no label"


def at_display_rate(config: "SimulationConfig", full_rate: bool = False) -> "SimulationConfig":
    """The configuration with range-time maps at a display rate, or of every pulse."""
    if full_rate:
        return config.replace(processing__display_rate_hz=None)
    if config.processing.display_rate_hz is None and config.scene.radar.prf_hz > DISPLAY_RATE_HZ:
        return config.replace(processing__display_rate_hz=DISPLAY_RATE_HZ)
    return config


#: Coarsest speed resolution of the radars in the classifiers' training (through-wall preset: 0.6 m/s), with a margin.
COARSEST_M_S = 0.8
#: A single-channel radar with a coarser range resolution confuses approaching and receding people in a room.
COARSEST_M = 1.5
#: Shortest scene for a reliable label: not much shorter than the classifiers' shortest training clips (2.4 s).
SHORTEST_S = 2.0


def load_recognizer(config: "SimulationConfig") -> "ActivityRecognizer | None":
    """The classifier for this radar's maps; None if no label is wanted or the radar is unlike those of training.

    The pictures of the shipped networks show speeds up to 3.8 m/s, resolved to 0.6 m/s or better. A radar that folds
    motion within these speeds, or has a coarser speed resolution, gets a warning instead of a label. Maps unlike those
    of training for other reasons (interference, both signs of Doppler mixed up) get a label and a warning.

    Raises:
        TensorsimError: weights are missing, of another network, or without the names of their classes.
    """
    from tensorsim.recognition import ActivityRecognizer

    if config.classifier == "none":
        return None
    try:
        recognizer = ActivityRecognizer.from_pretrained(config.scene.radar, config.classifier)
    except TensorsimError as error:
        raise TensorsimError(f"--classifier: {error}") from None
    radar, unlike = config.scene.radar, None
    resolution_m_s = radar.doppler_wavelength_m / 2 / config.processing.window_s
    if radar.unambiguous_speed_m_s < 0.9 * recognizer.speed_m_s:
        unlike = (
            f"sees speeds up to {radar.unambiguous_speed_m_s:.2g} m/s, but the classifier was trained on speeds up to "
            f"{recognizer.speed_m_s:.2g} m/s"
        )
    elif resolution_m_s > COARSEST_M_S:
        unlike = (
            f"resolves speeds {resolution_m_s:.2g} m/s apart, but the classifier was trained on radars that resolve "
            f"{COARSEST_M_S:.2g} m/s or less"
        )
    if unlike is not None:
        warnings.warn(f"no label: the radar {unlike}", TensorsimWarning, stacklevel=2)
        return None
    for reason in _unlike_training(config, recognizer):
        warnings.warn(f"the label is unreliable: {reason}", TensorsimWarning, stacklevel=2)
    return recognizer


def _unlike_training(config: "SimulationConfig", recognizer: "ActivityRecognizer") -> list[str]:
    """How the maps differ from those of the classifier's training."""
    from tensorsim.recognition import SPNet

    unlike = []
    if config.processing.integration == "paper":
        unlike.append(
            "integration 'paper' folds approaching and receding motion, but the classifier was trained on signed "
            "Doppler"
        )
    if config.scene.interference is not None:
        unlike.append(
            "another radar interferes, but the shipped classifiers were trained without interference"
        )
    one_channel = config.scene.receiver.real and config.scene.radar.range_resolution_m > COARSEST_M
    if one_channel and isinstance(recognizer.network, SPNet):
        unlike.append(
            "a radar of one channel without range folds approaching and receding motion, on which the shipped SPGNet "
            "was trained and the shipped SPNet was not"
        )
    return unlike


def warn_of_label(recognizer: "ActivityRecognizer | None", people: int, duration_s: float) -> None:
    """Warn of a label that is unreliable: several people, or a short scene."""
    if recognizer is None:
        return
    if people > 0 and duration_s < SHORTEST_S:
        warnings.warn(
            f"the label is unreliable: the scene lasts {duration_s:.3g} s, but the shipped classifiers were trained on "
            "clips of 2.4 to 5 s",
            TensorsimWarning,
            stacklevel=2,
        )
    if people > 1:
        warnings.warn(
            "several people are in the scene: the label refers to all of them, but the classifier was trained on "
            "single people",
            TensorsimWarning,
            stacklevel=2,
        )
