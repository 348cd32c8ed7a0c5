"""Frozen configurations: the radar, the wall, the camera, and the names of joints and classes.

Every default is the control panel of the original application (RadHARSimulator V2).
"""

import math
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

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


def _is_finite(value: Any) -> bool:
    return isinstance(value, Real) and math.isfinite(value)


def _require_positive(owner: str, **values: float) -> None:
    for name, value in values.items():
        if not (_is_finite(value) and value > 0):
            raise TensorsimError(f"{owner}.{name}: got {value!r}, expected a positive finite number")


def _require_dielectric(owner: str, relative_permittivity: float, loss_tangent: float) -> None:
    for name, value, least in (
        ("relative_permittivity", relative_permittivity, 1),
        ("loss_tangent", loss_tangent, 0),
    ):
        if not (_is_finite(value) and value >= least):
            raise TensorsimError(f"{owner}.{name}: got {value}, expected a finite number >= {least}")


def _as_positions(value: Any) -> Any:
    """Arrays and lists as tuples, so that a configuration is hashable; a tuple of numbers stays as it is."""
    value = value.tolist() if hasattr(value, "tolist") else value
    return tuple(_as_positions(v) for v in value) if isinstance(value, list | tuple) else value


def _listed(positions: Any) -> tuple[Vector, ...]:
    """One position, or several, as several."""
    several = isinstance(positions, tuple) and len(positions) > 0 and isinstance(positions[0], tuple)
    return positions if several else (positions,)


def _require_vector(owner: str, **values: Vector) -> None:
    for name, value in values.items():
        if not (isinstance(value, tuple) and len(value) == 3 and all(_is_finite(v) for v in value)):
            raise TensorsimError(
                f"{owner}.{name}: got {value!r}, expected three finite numbers (x, y, z) in metres"
            )


@dataclass(frozen=True)
class RadarConfig:
    """An FMCW radar. World frame: x right, y range, z height, metres.

    The chirp sweeps upwards from ``carrier_hz``, the **start** of the sweep: ``f(t) = fc + (B / T) t``.
    Defaults are the free-space preset of the original's panel.

    ``tx_m`` and ``rx_m`` are one position (x, y, z) each, or K and A of them: ``((x, y, z), ...)`` or anything
    of shape (A, 3). Several give the echo an antenna dimension of K * A channels, transmitter by transmitter.
    Transmitters fire in turn (time division): number k at ``k / (K PRF)`` after the start of a pulse interval.

    Raises:
        TensorsimError: a frequency or duration that is not positive, a position without three finite numbers,
            or K chirps that do not fit a pulse interval.
    """

    carrier_hz: float = 77e9
    bandwidth_hz: float = 4e9
    chirp_s: float = 40e-6
    prf_hz: float = 8192.0
    sample_rate_hz: float = 10e6
    tx_m: Vector | tuple[Vector, ...] = (-0.1, 0.0, 1.5)
    rx_m: Vector | tuple[Vector, ...] = (0.1, 0.0, 1.5)
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
        for name in ("tx_m", "rx_m"):
            object.__setattr__(self, name, _as_positions(getattr(self, name)))
        for tx in self.tx_positions_m:
            _require_vector("RadarConfig", tx_m=tx)
        for rx in self.rx_positions_m:
            _require_vector("RadarConfig", rx_m=rx)
        for name in ("antenna_gain_dbi", "isolation_db"):
            if not _is_finite(getattr(self, name)):
                raise TensorsimError(
                    f"RadarConfig.{name}: got {getattr(self, name)!r}, expected a finite number of dB"
                )
        if self.samples_per_chirp < 2:
            raise TensorsimError(
                f"RadarConfig: {self.sample_rate_hz} Hz over a chirp of {self.chirp_s} s gives "
                f"{self.samples_per_chirp} samples, expected at least 2"
            )
        turns = len(self.tx_positions_m)
        if self.chirp_s * self.prf_hz * turns > 1.0:
            chirps = (
                f"a chirp of {self.chirp_s} s does"
                if turns == 1
                else f"{turns} chirps of {self.chirp_s} s do"
            )
            raise TensorsimError(
                f"RadarConfig: {chirps} not fit the pulse interval {1.0 / self.prf_hz} s of prf_hz {self.prf_hz}"
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
    def tx_positions_m(self) -> tuple[Vector, ...]:
        """Every transmitter, also where there is one."""
        return _listed(self.tx_m)

    @property
    def rx_positions_m(self) -> tuple[Vector, ...]:
        """Every receiver, also where there is one."""
        return _listed(self.rx_m)

    @property
    def has_array(self) -> bool:
        """Whether the echo has an antenna dimension: ``tx_m`` or ``rx_m`` is a list of positions."""
        return self.tx_positions_m != (self.tx_m,) or self.rx_positions_m != (self.rx_m,)

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
        for name in ("center_m", "size_m"):
            object.__setattr__(self, name, _as_positions(getattr(self, name)))
        _require_vector("WallConfig", center_m=self.center_m, size_m=self.size_m)
        if self.size_m[0] <= 0 or self.size_m[1] < 0 or self.size_m[2] <= 0:
            raise TensorsimError(
                f"WallConfig.size_m: got {self.size_m}, expected positive width and height and thickness >= 0"
            )
        _require_dielectric("WallConfig", self.relative_permittivity, self.loss_tangent)

    @property
    def refractive_index(self) -> complex:
        """n = sqrt(eps_r (1 - j tan d)) = n' - j n''."""
        return (self.relative_permittivity * (1 - 1j * self.loss_tangent)) ** 0.5


@dataclass(frozen=True)
class FloorConfig:
    """A smooth floor, the plane z = 0, that reflects.

    Attributes:
        relative_permittivity: of the material; the default is concrete (ITU-R P.2040-3, table 3).
        loss_tangent: of the material.
        reflection: a constant reflection coefficient in place of Fresnel's, for a floor that was measured.

    Raises:
        TensorsimError: numbers that are not physical.
    """

    relative_permittivity: float = 5.24
    loss_tangent: float = 0.03
    reflection: float | None = None

    def __post_init__(self) -> None:
        _require_dielectric("FloorConfig", self.relative_permittivity, self.loss_tangent)
        if self.reflection is not None and not (_is_finite(self.reflection) and -1 <= self.reflection <= 1):
            raise TensorsimError(f"FloorConfig.reflection: got {self.reflection}, expected between -1 and 1")


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
        TensorsimError: a focal length or field of view that is not physical, a position, principal point or angle
            that is not finite.
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
        if not (_is_finite(self.horizontal_fov_rad) and 0 < self.horizontal_fov_rad < math.pi):
            raise TensorsimError(
                f"CameraConfig.horizontal_fov_rad: got {self.horizontal_fov_rad}, expected between 0 and pi"
            )
        for name in ("position_m", "center_px"):
            object.__setattr__(self, name, _as_positions(getattr(self, name)))
        _require_vector("CameraConfig", position_m=self.position_m)
        center = self.center_px
        if center is not None and not (
            isinstance(center, tuple) and len(center) == 2 and all(_is_finite(v) for v in center)
        ):
            raise TensorsimError(
                f"CameraConfig.center_px: got {center!r}, expected two finite numbers (u, v) or None"
            )
        for name in ("pitch_rad", "yaw_rad"):
            if not _is_finite(getattr(self, name)):
                raise TensorsimError(
                    f"CameraConfig.{name}: got {getattr(self, name)}, expected finite radians"
                )
