"""The parameters of the original's control panel as options, under the panel's names."""

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

_XYZ = tyro.conf.arg(metavar="X Y Z")

#: The field of the configuration that an option of the panel sets.
PANEL_FIELDS = {
    "keypoint_threshold": "pose__keypoint_threshold",
    "person_weight": "pose__person_weight_kg",
    "min_detection_size": "tracking__min_box_px",
    "detection_interval": "tracking__detection_interval",
    "max_tracks": "tracking__max_tracks",
    "confirmation_hits": "tracking__confirm_hits",
    "confirmation_window": "tracking__confirm_window",
    "deletion_misses": "tracking__delete_misses",
    "deletion_window": "tracking__delete_window",
    "assignment_threshold": "tracking__assignment_threshold",
    "process_noise": "tracking__process_noise",
    "measurement_noise": "tracking__measurement_noise",
    "carrier_hz": "scene__radar__carrier_hz",
    "chirp_s": "scene__radar__chirp_s",
    "bandwidth_hz": "scene__radar__bandwidth_hz",
    "prf_hz": "scene__radar__prf_hz",
    "sample_rate_hz": "scene__radar__sample_rate_hz",
    "tx_position": "scene__radar__tx_m",
    "rx_position": "scene__radar__rx_m",
    "antenna_gain_dbi": "scene__radar__antenna_gain_dbi",
    "isolation_db": "scene__radar__isolation_db",
    "wall_permittivity": "scene__wall__relative_permittivity",
    "wall_loss_tangent": "scene__wall__loss_tangent",
    "wall_size": "scene__wall__size_m",
    "wall_center": "scene__wall__center_m",
    "smoothing_ratio": "smoothing__smoothing_ratio",
    "range_window": "processing__range_window",
    "mti": "processing__mti",
    "stft_window": "processing__window_s",
    "stft_overlap": "processing__overlap",
    "ridges": "processing__ridge_count",
}


@dataclass(frozen=True, kw_only=True)
class PanelOptions:
    """Parameters of the control panel."""

    keypoint_threshold: float | None = None
    """Score from which a key point counts as seen. Default: 0.3."""
    person_weight: tuple[float, ...] | None = None
    """Body weights in kg in order of appearance; cross sections scale with the body surface. Default: 84.24 75.00."""
    min_detection_size: float | None = None
    """Smallest width and height of a detection in pixels. Default: 5."""
    detection_interval: int | None = None
    """The detector runs on every n-th frame. Default: 2."""
    max_tracks: int | None = None
    """People at a time. Default: 5."""
    confirmation_hits: int | None = None
    """Detections that confirm a track. Default: 2 ..."""
    confirmation_window: int | None = None
    """... of so many frames in which the detector ran. Default: 5."""
    deletion_misses: int | None = None
    """Misses that end a track. Default: 23 ..."""
    deletion_window: int | None = None
    """... of so many frames in which the detector ran. Default: 23."""
    assignment_threshold: float | None = None
    """Largest squared Mahalanobis distance of a detection from its track. Default: 150."""
    process_noise: float | None = None
    """Kalman process noise of a track's box, size^2 / frame^3. Default: 0.001."""
    measurement_noise: float | None = None
    """Kalman measurement noise of a track's box, size^2. Default: 0.0004 (panel: 0.01)."""
    carrier_hz: float | None = None
    """Start of the sweep. Default: 77e9, behind a wall 2e9."""
    chirp_s: float | None = None
    """Length of the sweep. Default: 40e-6."""
    bandwidth_hz: float | None = None
    """Width of the sweep. Default: 4e9, behind a wall 1e9."""
    prf_hz: float | None = None
    """Pulse repetition frequency. Default: 8192, behind a wall 128."""
    sample_rate_hz: float | None = None
    """Sample rate of the intermediate frequency. Default: 10e6."""
    tx_position: Annotated[tuple[float, float, float] | None, _XYZ] = None
    """Transmitter in metres. Default: -0.1 0 1.5."""
    rx_position: Annotated[tuple[float, float, float] | None, _XYZ] = None
    """Receiver in metres. Default: 0.1 0 1.5."""
    antenna_gain_dbi: float | None = None
    """Gain of both antennas. Default: 10."""
    isolation_db: float | None = None
    """Isolation of transmitter and receiver, for --leakage. Default: 20."""
    wall_permittivity: float | None = None
    """Relative permittivity of the wall. Default: 6."""
    wall_loss_tangent: float | None = None
    """Loss tangent of the wall. Default: 0.03."""
    wall_size: Annotated[tuple[float, float, float] | None, _XYZ] = None
    """Width, thickness and height of the wall in metres. Default: 5 0.24 2.5."""
    wall_center: Annotated[tuple[float, float, float] | None, _XYZ] = None
    """Centre of the wall in metres. Default: the near face touches the antenna plane."""
    smoothing_ratio: float | None = None
    """Length in seconds of a Savitzky-Golay filter along the pulses (panel: 0.25). Default: none, see --motion."""
    range_window: Literal["hamming", "hann", "blackman"] | None = None
    """Window over fast time. Default: hamming."""
    mti: Literal["two-pulse", "n-pulse"] | None = None
    """Moving target indicator. Default: two-pulse."""
    stft_window: float | None = None
    """Length of the STFT window in seconds. Default: 0.1."""
    stft_overlap: float | None = None
    """Shared part of neighbouring STFT windows. Default: 0.9."""
    ridges: int | None = None
    """Ridges of the Doppler-time map. Default: 3."""
