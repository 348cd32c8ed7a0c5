"""Frozen configurations: the radar, the wall, the camera, and the names of joints and classes.

Every default is the control panel of the original application (RadHARSimulator V2).
"""

import math
from dataclasses import dataclass, replace

from tensorsim.errors import TensorsimError

SPEED_OF_LIGHT_M_S = 299_792_458.0

#: The 14 joints of the radar body, the OpenPose order that the paper indexes.
JOINTS = (
    "head",
    "neck",
    "right_shoulder",
    "right_elbow",
    "right_wrist",
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "right_hip",
    "right_knee",
    "right_ankle",
    "left_hip",
    "left_knee",
    "left_ankle",
)

#: Radar cross section of each joint in m^2 (the legs are not legible in the panel: hip 0.1, knee 0.4, ankle 0.3).
JOINT_RCS_M2 = (0.5, 1.0, 0.1, 0.3, 0.2, 0.1, 0.3, 0.2, 0.1, 0.4, 0.3, 0.1, 0.4, 0.3)

#: The 17 keypoints of COCO, in the order of its annotations.
COCO_KEYPOINTS = (
    "nose",
    "left_eye",
    "right_eye",
    "left_ear",
    "right_ear",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hip",
    "right_hip",
    "left_knee",
    "right_knee",
    "left_ankle",
    "right_ankle",
)

#: The 12 activity classes of the paper.
ACTIVITIES = (
    "S1 Empty",
    "S2 Punching",
    "S3 Kicking",
    "S4 Grabbing",
    "S5 Sitting Down",
    "S6 Standing Up",
    "S7 Rotating",
    "S8 Walking",
    "S9 Sitting to Walking",
    "S10 Walking to Sitting",
    "S11 Falling to Walking",
    "S12 Walking to Falling",
)

Vector = tuple[float, float, float]


def _require_positive(owner: str, **values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise TensorsimError(f"{owner}.{name}: got {value}, expected a positive finite number")


def _require_vector(owner: str, **values: Vector) -> None:
    for name, value in values.items():
        if len(value) != 3 or not all(math.isfinite(v) for v in value):
            raise TensorsimError(
                f"{owner}.{name}: got {value}, expected three finite numbers (x, y, z) in metres"
            )


@dataclass(frozen=True)
class RadarConfig:
    """An FMCW radar with one transmitter and one receiver. World frame: x right, y range, z height, metres.

    The chirp sweeps upwards from ``carrier_hz``, the **start** of the sweep: ``f(t) = fc + (B / T) t``.
    Defaults are the free-space preset of the original's panel.

    Raises:
        TensorsimError: a frequency or duration that is not positive, or a position without three finite numbers.
    """

    carrier_hz: float = 77e9
    bandwidth_hz: float = 4e9
    chirp_s: float = 40e-6
    prf_hz: float = 8192.0
    sample_rate_hz: float = 10e6
    tx_m: Vector = (-0.1, 0.0, 1.5)
    rx_m: Vector = (0.1, 0.0, 1.5)
    antenna_gain_dbi: float = 10.0
    isolation_db: float = 20.0

    def __post_init__(self) -> None:
        _require_positive(
            "RadarConfig",
            carrier_hz=self.carrier_hz,
            bandwidth_hz=self.bandwidth_hz,
            chirp_s=self.chirp_s,
            prf_hz=self.prf_hz,
            sample_rate_hz=self.sample_rate_hz,
        )
        _require_vector("RadarConfig", tx_m=self.tx_m, rx_m=self.rx_m)
        for name in ("antenna_gain_dbi", "isolation_db"):
            if not math.isfinite(getattr(self, name)):
                raise TensorsimError(
                    f"RadarConfig.{name}: got {getattr(self, name)}, expected a finite number of dB"
                )
        if self.samples_per_chirp < 2:
            raise TensorsimError(
                f"RadarConfig: {self.sample_rate_hz} Hz over a chirp of {self.chirp_s} s gives "
                f"{self.samples_per_chirp} samples, expected at least 2"
            )
        if self.chirp_s * self.prf_hz > 1.0:
            raise TensorsimError(
                f"RadarConfig: a chirp of {self.chirp_s} s does not fit the pulse interval "
                f"{1.0 / self.prf_hz} s of prf_hz {self.prf_hz}"
            )

    @classmethod
    def free_space(cls, **overrides: float | Vector) -> "RadarConfig":
        """The panel's free-space radar: 77 GHz, 4 GHz of bandwidth, PRF 8192 Hz."""
        return replace(cls(), **overrides)  # type: ignore[arg-type]

    @classmethod
    def through_wall(cls, **overrides: float | Vector) -> "RadarConfig":
        """The panel's through-wall radar: 2 GHz, 1 GHz of bandwidth, PRF 128 Hz."""
        return replace(cls(carrier_hz=2e9, bandwidth_hz=1e9, prf_hz=128.0), **overrides)  # type: ignore[arg-type]

    @property
    def slope_hz_per_s(self) -> float:
        """Chirp slope mu = B / T."""
        return self.bandwidth_hz / self.chirp_s

    @property
    def samples_per_chirp(self) -> int:
        """N = round(fs T)."""
        return round(self.sample_rate_hz * self.chirp_s)

    @property
    def wavelength_m(self) -> float:
        """c / fc, the wavelength of the amplitude (radar equation)."""
        return SPEED_OF_LIGHT_M_S / self.carrier_hz

    @property
    def doppler_wavelength_m(self) -> float:
        """c / (fc + B/2): Doppler of a range bin scales with the centre of the sweep."""
        return SPEED_OF_LIGHT_M_S / (self.carrier_hz + self.bandwidth_hz / 2)

    @property
    def range_resolution_m(self) -> float:
        """Spacing of range bins, c / (2B)."""
        return SPEED_OF_LIGHT_M_S / (2 * self.bandwidth_hz)

    @property
    def unambiguous_speed_m_s(self) -> float:
        """Largest radial speed without Doppler aliasing, lambda PRF / 4 (7.8 m/s and 3.8 m/s in the presets)."""
        return self.doppler_wavelength_m * self.prf_hz / 4


@dataclass(frozen=True)
class WallConfig:
    """A homogeneous slab normal to y.

    The default centre puts the near face of the panel's wall on the antenna plane. (The paper's centre
    (-0.1, 0, 1.5) has the antennas inside the slab; the simulator then moves it here, with a warning.)

    Raises:
        TensorsimError: a size or permittivity that is not physical.
    """

    center_m: Vector = (-0.1, 0.12, 1.5)
    size_m: Vector = (5.0, 0.24, 2.5)
    relative_permittivity: float = 6.0
    loss_tangent: float = 0.03

    def __post_init__(self) -> None:
        _require_vector("WallConfig", center_m=self.center_m, size_m=self.size_m)
        if self.size_m[0] <= 0 or self.size_m[1] < 0 or self.size_m[2] <= 0:
            raise TensorsimError(
                f"WallConfig.size_m: got {self.size_m}, expected positive width and height and thickness >= 0"
            )
        if not (math.isfinite(self.relative_permittivity) and self.relative_permittivity >= 1):
            raise TensorsimError(
                f"WallConfig.relative_permittivity: got {self.relative_permittivity}, expected a finite number >= 1"
            )
        if not (math.isfinite(self.loss_tangent) and self.loss_tangent >= 0):
            raise TensorsimError(
                f"WallConfig.loss_tangent: got {self.loss_tangent}, expected a finite number >= 0"
            )

    @property
    def refractive_index(self) -> complex:
        """n = sqrt(eps_r (1 - j tan d)) = n' - j n''."""
        return (self.relative_permittivity * (1 - 1j * self.loss_tangent)) ** 0.5


@dataclass(frozen=True)
class CameraConfig:
    """A pinhole camera. By default it stands at the radar and looks along +y with the x axis level.

    Attributes:
        focal_px: focal length in pixels; None derives it from ``horizontal_fov_rad``.
        horizontal_fov_rad: horizontal field of view in radians, used when ``focal_px`` is None.
        center_px: principal point (u, v); None is the middle of the image, ((W - 1) / 2, (H - 1) / 2).
        position_m: the camera in the world.
        pitch_rad: upward tilt of the optical axis.
        yaw_rad: turn of the optical axis from +y towards +x.

    Raises:
        TensorsimError: a focal length or field of view that is not physical.
    """

    focal_px: float | None = None
    horizontal_fov_rad: float = math.pi / 3
    center_px: tuple[float, float] | None = None
    position_m: Vector = (0.0, 0.0, 1.5)
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        if self.focal_px is not None:
            _require_positive("CameraConfig", focal_px=self.focal_px)
        if not 0 < self.horizontal_fov_rad < math.pi:
            raise TensorsimError(
                f"CameraConfig.horizontal_fov_rad: got {self.horizontal_fov_rad}, expected between 0 and pi"
            )
        _require_vector("CameraConfig", position_m=self.position_m)
        for name in ("pitch_rad", "yaw_rad"):
            if not math.isfinite(getattr(self, name)):
                raise TensorsimError(
                    f"CameraConfig.{name}: got {getattr(self, name)}, expected finite radians"
                )
