"""One configuration for a whole run."""

import os
from dataclasses import dataclass, field, replace
from typing import Any

from tensorsim.config.checks import require_counts
from tensorsim.config.documents import from_document, suggestion, to_document
from tensorsim.config.limited_yaml import dump_limited_yaml
from tensorsim.config.people import PANEL_DISTANCES_M, PoseConfig, SmoothingConfig, TrackerConfig
from tensorsim.config.processing import ProcessingConfig
from tensorsim.config.radar import RadarConfig
from tensorsim.config.receiver import ReceiverConfig
from tensorsim.config.scene import SceneConfig
from tensorsim.config.surroundings import WallConfig
from tensorsim.exceptions import TensorsimError
from tensorsim.files import write_text


@dataclass(frozen=True)
class SimulationConfig:
    """Everything that a simulation depends on besides its input.

    Attributes:
        scene: radar, wall, floor, propagation paths, scatterers, noise.
        processing: signal to maps.
        tracking: detection and tracking.
        pose: keypoints to joints in the world.
        smoothing: smoothing and interpolation along time.
        classifier: name or file of the activity classifier; None is the shipped one, ``"none"`` gives no label.
        seed: for the receiver noise and everything else that is random.

    Example:
        >>> config = SimulationConfig.through_wall().replace(seed=3)
        >>> config.scene.radar.prf_hz
        128.0
    """

    scene: SceneConfig = field(default_factory=SceneConfig)
    processing: ProcessingConfig = field(default_factory=ProcessingConfig)
    tracking: TrackerConfig = field(default_factory=TrackerConfig)
    pose: PoseConfig = field(default_factory=PoseConfig)
    smoothing: SmoothingConfig = field(default_factory=SmoothingConfig)
    classifier: str | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        for name, kind in (
            ("scene", SceneConfig),
            ("processing", ProcessingConfig),
            ("tracking", TrackerConfig),
            ("pose", PoseConfig),
            ("smoothing", SmoothingConfig),
        ):
            if not isinstance(getattr(self, name), kind):
                raise TensorsimError(
                    f"SimulationConfig.{name}: got {getattr(self, name)!r}, expected a {kind.__name__}"
                )
        self.scene.check_engine(self.processing.engine)
        require_counts(self, "seed", least=0, most=2**32 - 1)

    @classmethod
    def free_space(cls) -> "SimulationConfig":
        """The panel's free-space scene."""
        return cls()

    @classmethod
    def through_wall(cls) -> "SimulationConfig":
        """The panel's through-wall scene."""
        return cls(scene=SceneConfig(RadarConfig.through_wall(), WallConfig()))

    @classmethod
    def paper(cls, base: "SimulationConfig | None" = None) -> "SimulationConfig":
        """The literal formulas of the paper, including wrong or ambiguous ones.

        Rectangular range window; STFT of the sum of the range bins' magnitudes; only ``T1^2`` of the bounces in the
        wall, and the propagation phase of the wall counted twice; noise relative to the total power; metres per pixel
        from the current frame, position by increments, each frame matched on its own to its nearest pose; a forward
        Kalman filter, linear interpolation between frames and a Savitzky-Golay filter over a quarter of a second.
        Bodies neither sway nor breathe, the room is empty, and the receiver is ideal.

        Args:
            base: provides radar, wall, people and networks; None is the free-space scene of the panel.
        """
        base = cls() if base is None else base
        return base.replace(
            scene__wall_paths="paper",
            scene__body="joints",
            scene__sway=False,
            scene__vital_signs=False,
            scene__clutter=None,
            scene__interference=None,
            scene__receiver=ReceiverConfig(),
            scene__noise_reference="total",
            processing__range_window=None,
            processing__mti="two-pulse",
            processing__integration="paper",
            tracking__measurement_noise=0.01,
            pose__position="paper",
            pose__lifter="nearest",
            pose__neighbours=1,
            pose__temporal=0.0,
            pose__initial_distance_m=base.pose.initial_distance_m or PANEL_DISTANCES_M,
            smoothing__mode="forward",
            smoothing__resampling="linear",
            smoothing__smoothing_ratio=0.25,
            smoothing__polynomial_order=3,
        )

    def replace(self, **changes: Any) -> "SimulationConfig":
        """A copy with some values changed; ``section__field=value`` changes a field of a section, at any depth.

        Raises:
            TensorsimError: an unknown field, a field of a part that is None, or invalid values.

        Example:
            >>> config = SimulationConfig().replace(scene__snr_db=20.0, scene__radar__prf_hz=4096.0)
            >>> config.scene.snr_db, config.scene.radar.prf_hz
            (20.0, 4096.0)
        """
        config = self
        for name, value in changes.items():
            config = _replaced(config, name.split("__"), value)
        return config

    @classmethod
    def from_document(cls, document: dict[str, Any], where: str = "configuration") -> "SimulationConfig":
        """The configuration in a mapping such as the one in ``summary.json``.

        Raises:
            TensorsimError: unknown keys, or values that the configuration refuses.
        """
        config: SimulationConfig = from_document(where, cls, document)
        return config

    def to_document(self) -> dict[str, Any]:
        """Mappings, lists, numbers and strings that :meth:`from_document` turns back into the same configuration."""
        document: dict[str, Any] = to_document(self)
        return document

    @classmethod
    def from_yaml(cls, path: str | os.PathLike[str]) -> "SimulationConfig":
        """The configuration in a YAML file; values that it omits keep their defaults.

        The ``summary.json`` of a run also works: its ``config`` section is read.

        Raises:
            TensorsimError: no such file, not YAML, unknown keys, or values that the configuration refuses.
        """
        from tensorsim.config.yaml_files import read_yaml

        document = read_yaml(path)
        return cls.from_document(document.get("config", document), str(path))

    def to_yaml(self, path: str | os.PathLike[str]) -> None:
        """Write a file that :meth:`from_yaml` reads back unchanged.

        Raises:
            TensorsimError: the disk is full, or the folder is not writable.
        """
        write_text(path, dump_limited_yaml(self.to_document()))


def _replaced(config: Any, path: list[str], value: Any) -> Any:
    """A copy of a configuration with the field at the end of a path of names changed."""
    known = list(config.__dataclass_fields__) if hasattr(config, "__dataclass_fields__") else []
    if path[0] not in known:
        raise TensorsimError(
            f"got no {path[0]!r} in {type(config).__name__}, expected one of its fields{suggestion(path[0], known)}"
        )
    if len(path) > 1:
        part = getattr(config, path[0])
        if part is None:
            hint = " (--scene through-wall has one)" if path[0] == "wall" else ""
            raise TensorsimError(f"got {path[1]!r}, but this scene has no {path[0]!r}{hint}")
        value = _replaced(part, path[1:], value)
    return replace(config, **{path[0]: value})
