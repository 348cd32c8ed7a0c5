"""The parameters of the original's control panel as options, under the panel's names."""

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import tyro

from tensorsim.commands.arguments import Option, numbers

_XYZ = numbers("X Y Z")


class Parameter(NamedTuple):
    """A parameter of the panel.

    Attributes:
        group: of the panel.
        name: in the panel.
        option: of the command line, with underscores.
        field: of :class:`~tensorsim.SimulationConfig`, sections joined by two underscores.
        unit: of the option; "" without.
    """

    group: str
    name: str
    option: str
    field: str
    unit: str


PANEL = (
    Parameter("VISION", "Person height", "person_height", "pose__person_height_m", "m"),
    Parameter("VISION", "Person weight", "person_weight", "pose__person_weight_kg", "kg"),
    Parameter("VISION", "Initial distance", "initial_distance", "pose__initial_distance_m", "m"),
    Parameter("VISION", "Keypoint threshold", "keypoint_threshold", "pose__keypoint_threshold", ""),
    Parameter("VISION", "Minimum detection size", "min_detection_size", "tracking__min_box_px", "px"),
    Parameter("VISION", "Detection interval", "detection_interval", "tracking__detection_interval", "frames"),
    Parameter("VISION", "Maximum number of tracks", "max_tracks", "tracking__max_tracks", "people"),
    Parameter(
        "VISION", "Confirmation threshold, hits", "confirmation_hits", "tracking__confirm_hits", "frames"
    ),
    Parameter(
        "VISION", "Confirmation threshold, of", "confirmation_window", "tracking__confirm_window", "frames"
    ),
    Parameter("VISION", "Deletion threshold, misses", "deletion_misses", "tracking__delete_misses", "frames"),
    Parameter("VISION", "Deletion threshold, of", "deletion_window", "tracking__delete_window", "frames"),
    Parameter("VISION", "Assignment threshold", "assignment_threshold", "tracking__assignment_threshold", ""),
    Parameter("VISION", "Process noise", "process_noise", "tracking__process_noise", "size^2 / frame^3"),
    Parameter("VISION", "Measurement noise", "measurement_noise", "tracking__measurement_noise", "size^2"),
    Parameter("RADAR", "Carrier frequency", "carrier_hz", "scene__radar__carrier_hz", "Hz"),
    Parameter("RADAR", "Chirp duration", "chirp_s", "scene__radar__chirp_s", "s"),
    Parameter("RADAR", "Bandwidth", "bandwidth_hz", "scene__radar__bandwidth_hz", "Hz"),
    Parameter("RADAR", "PRF", "prf_hz", "scene__radar__prf_hz", "Hz"),
    Parameter("RADAR", "Sampling frequency", "sample_rate_hz", "scene__radar__sample_rate_hz", "Hz"),
    Parameter("RADAR", "Tx position", "tx_position", "scene__radar__tx_m", "m"),
    Parameter("RADAR", "Rx position", "rx_position", "scene__radar__rx_m", "m"),
    Parameter("RADAR", "Antenna gain", "antenna_gain_dbi", "scene__radar__antenna_gain_dbi", "dBi"),
    Parameter("RADAR", "Isolation", "isolation_db", "scene__radar__isolation_db", "dB"),
    Parameter("RADAR", "SNR", "snr", "scene__snr_db", "dB"),
    Parameter("WALL", "Relative permittivity", "wall_permittivity", "scene__wall__relative_permittivity", ""),
    Parameter("WALL", "Loss tangent", "wall_loss_tangent", "scene__wall__loss_tangent", ""),
    Parameter("WALL", "Wall size", "wall_size", "scene__wall__size_m", "m"),
    Parameter("WALL", "Wall center", "wall_center", "scene__wall__center_m", "m"),
    Parameter("PROCESSING", "Smoothing ratio", "smoothing_ratio", "smoothing__smoothing_ratio", "s"),
    Parameter("PROCESSING", "Range window", "range_window", "processing__range_window", ""),
    Parameter("PROCESSING", "MTI", "mti", "processing__mti", ""),
    Parameter("PROCESSING", "STFT window", "stft_window", "processing__window_s", "s"),
    Parameter("PROCESSING", "STFT overlap", "stft_overlap", "processing__overlap", ""),
    Parameter("PROCESSING", "Number of ridges", "ridges", "processing__ridge_count", ""),
    Parameter("PROCESSING", "Denoiser", "denoiser", "processing__denoiser", "file or name"),
)


@dataclass(frozen=True, kw_only=True)
class PanelOptions:
    """Parameters of the control panel."""

    keypoint_threshold: Option[float] = None
    """Minimum score of a visible keypoint. Default: 0.3."""
    person_weight: Annotated[Option[tuple[float, ...]], tyro.conf.arg(metavar="KG ...")] = None
    """Body weights in kg in order of appearance; cross sections scale with body surface area. Default: 84.24 75.00."""
    min_detection_size: Option[float] = None
    """Minimum width and height of a detection in pixels. Default: 5."""
    detection_interval: Option[int] = None
    """Run the detector on every n-th frame, less often from 45 frames per second. Default: 2."""
    max_tracks: Option[int] = None
    """Maximum number of people tracked at once. Default: 5."""
    confirmation_hits: Option[int] = None
    """Detections within --confirmation-window needed to confirm a track. Default: 2."""
    confirmation_window: Option[int] = None
    """Number of detector runs over which --confirmation-hits are counted. Default: 5."""
    deletion_misses: Option[int] = None
    """Misses within --deletion-window after which a track ends. Default: 23."""
    deletion_window: Option[int] = None
    """Number of detector runs over which --deletion-misses are counted. Default: 23."""
    assignment_threshold: Option[float] = None
    """Maximum squared Mahalanobis distance of a detection from its track. Default: 150."""
    process_noise: Option[float] = None
    """Kalman process noise of a track's box in size^2 / frame^3, where size is the longer side of the box. Default:
    0.001."""
    measurement_noise: Option[float] = None
    """Kalman measurement noise of a track's box in size^2. Default: 0.0004 (panel: 0.01)."""
    carrier_hz: Option[float] = None
    """Start frequency of the sweep in Hz. Default: 77e9 (through-wall: 2e9)."""
    chirp_s: Option[float] = None
    """Duration of the sweep in seconds. Default: 40e-6."""
    bandwidth_hz: Option[float] = None
    """Bandwidth of the sweep in Hz. Default: 4e9 (through-wall: 1e9)."""
    prf_hz: Option[float] = None
    """Pulse repetition frequency in Hz. Default: 8192 (through-wall: 128)."""
    sample_rate_hz: Option[float] = None
    """Sample rate of the intermediate-frequency (IF) signal in Hz. Default: 10e6."""
    tx_position: Annotated[Option[tuple[float, float, float]], _XYZ] = None
    """Position of the transmitter in metres. Default: -0.1 0 1.5."""
    rx_position: Annotated[Option[tuple[float, float, float]], _XYZ] = None
    """Position of the receiver in metres. Default: 0.1 0 1.5."""
    antenna_gain_dbi: Option[float] = None
    """Gain of each antenna in dBi. Default: 10."""
    isolation_db: Option[float] = None
    """Isolation between transmitter and receiver in dB, for --leakage. Default: 20."""
    wall_permittivity: Option[float] = None
    """Relative permittivity of the wall. Default: 6."""
    wall_loss_tangent: Option[float] = None
    """Loss tangent of the wall. Default: 0.03."""
    wall_size: Annotated[Option[tuple[float, float, float]], _XYZ] = None
    """Width, thickness and height of the wall in metres. Default: 5 0.24 2.5."""
    wall_center: Annotated[Option[tuple[float, float, float]], _XYZ] = None
    """Centre of the wall in metres. Default: the near face touches the plane of the antennas."""
    smoothing_ratio: Option[float] = None
    """Length in seconds of a Savitzky-Golay filter along the pulses (panel: 0.25). Default: none, see --motion."""
    range_window: Option[Literal["hamming", "hann", "blackman"]] = None
    """Window function over fast time. Default: hamming."""
    mti: Option[Literal["two-pulse", "n-pulse"]] = None
    """Method of moving target indication (MTI). Default: two-pulse."""
    stft_window: Option[float] = None
    """Length of the STFT window in seconds. Default: 0.1."""
    stft_overlap: Option[float] = None
    """Overlap of neighbouring STFT windows, as a fraction. Default: 0.9."""
    ridges: Option[int] = None
    """Number of ridges in the Doppler-time map. Default: 3."""


#: The field of the configuration that an option of :class:`PanelOptions` sets.
PANEL_FIELDS = {
    parameter.option: parameter.field
    for parameter in PANEL
    if parameter.option in PanelOptions.__dataclass_fields__
}
