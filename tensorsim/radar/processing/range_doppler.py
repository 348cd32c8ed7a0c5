"""Range, Doppler and angle of each frame of an array's pulses, and the points detected in them."""

import math

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.config.checks import is_finite
from tensorsim.errors import TensorsimError, check_tensor
from tensorsim.radar.processing.array import array_steering, beam_weights, row_spacing_m
from tensorsim.radar.processing.cfar import CfarDetector
from tensorsim.radar.processing.doppler import DopplerFrames
from tensorsim.radar.processing.point_cloud import PointCloud, Points


class RangeDopplerCube(DopplerFrames):
    """Complex range-Doppler spectra of each channel and frame, compensated for transmitters that fire in turn (TDM).

    Transmitter k of K fires ``k / (K PRF)`` late; meanwhile the phase of a target of Doppler f turns by
    ``2 pi f k / (K PRF)``, and each Doppler bin is turned back by as much. Targets beyond PRF / 2 stay wrong. Input is
    conjugated as in the Doppler-time map: positive Doppler is approaching, and the phase grows towards antennas that
    are nearer to the target.

    Args:
        radar: the array, its channels in the order of the echo, ``v = k A + a``; or one antenna pair.
        window_s: length of the window in seconds.
        overlap: overlap of neighbouring windows as a fraction of their length, in [0, 1).

    Shapes: profiles (..., V, M, R) complex -> (..., K, V, R, F) complex. Differentiable.

    Attributes:
        doppler_hz: (F,) Doppler axis in Hz, ascending, positive = approaching.
        length: L, pulses of a window.
        hop: pulses from one window to the next.
        frame_rate_hz: columns per second, PRF / hop; :meth:`frame_times_s` gives their (K,) times in seconds.

    Raises:
        TensorsimError: as :class:`DopplerFrames`; another number of channels, real profiles, fewer than L pulses.
    """

    turn_cycles: Tensor

    def __init__(self, radar: RadarConfig, window_s: float = 0.1, overlap: float = 0.9) -> None:
        super().__init__(radar, window_s, overlap)
        transmitters, receivers = len(radar.tx_positions_m), len(radar.rx_positions_m)
        self.channels = transmitters * receivers
        late = torch.arange(transmitters, dtype=torch.float64).repeat_interleave(receivers) / transmitters
        self.register_buffer(
            "turn_cycles", late[:, None] * self.doppler_hz / self.prf_hz, persistent=False
        )  # (V, F)

    def forward(self, profiles: Tensor) -> Tensor:
        """Profiles (..., V, M, R) to the cube (..., K, V, R, F)."""
        layout = f"(..., {self.channels} channels, pulses, range bins)"
        check_tensor(profiles, "profiles", layout, "complex", finite=False)
        lead, bins = list(profiles.shape[:-3]), profiles.shape[-1]
        frames = self.series(profiles).unfold(-1, self.length, self.hop)  # (B V, R, K, L)
        spectrum = torch.view_as_complex(self.spectrum(frames)).conj().resolve_conj()
        spectrum = spectrum.reshape(lead + [self.channels, bins, -1, self.bins])  # noqa: RUF005 (TorchScript)
        angle = (-2 * math.pi) * self.turn_cycles.double()
        turn = torch.polar(torch.ones_like(angle), angle).to(spectrum.dtype)
        return (spectrum * turn[:, None, None]).movedim(-2, -4)


class RangeDopplerAngle(nn.Module):
    """Power over range, Doppler and azimuth of each frame, by the conventional beamformer.

    Args:
        radar: the array.
        azimuth_rad: (D,) directions; 0 is +y, positive is to the right (+x).
        elevation_rad: elevation of all of them.
        window_s, overlap: see :class:`RangeDopplerCube`.

    Shapes: profiles (..., V, M, R) complex -> (..., K, R, F, D) power; in its own direction a plane wave
    has the power of one channel. Differentiable.

    Raises:
        TensorsimError: as :class:`RangeDopplerCube`; azimuths that are not a finite vector.
    """

    cycles: Tensor

    def __init__(
        self,
        radar: RadarConfig,
        azimuth_rad: Tensor,
        elevation_rad: float = 0.0,
        window_s: float = 0.1,
        overlap: float = 0.9,
    ) -> None:
        super().__init__()
        self.cube = RangeDopplerCube(radar, window_s, overlap)
        self.register_buffer("cycles", array_steering(radar, azimuth_rad, elevation_rad), persistent=False)

    def forward(self, profiles: Tensor) -> Tensor:
        """Profiles (..., V, M, R) to power (..., K, R, F, D)."""
        cube = self.cube(profiles).movedim(-3, -1)  # (..., K, R, F, V)
        # The cube is conjugated, and so are the steering vectors; a beam is the product with their conjugate.
        weights = beam_weights(self.cycles.double(), cube.dtype)
        return torch.view_as_real(torch.matmul(cube, weights.transpose(0, 1))).square().sum(-1)


def point_cfar(radar: RadarConfig, frames: DopplerFrames) -> CfarDetector:
    """Cell averaging over (range, Doppler) of the mean power of all channels, with a false alarm rate of 1e-5.

    Along Doppler the main lobe of a target, of the Hann window over L pulses, reaches ``2 F / L`` of F bins to each
    side; reference cells begin beyond it. They extend along Doppler alone if the radar has hardly any range bins, like
    a continuous-wave one.
    """
    lobe, most = 2 * math.ceil(frames.bins / frames.length), frames.bins // 4 - 1
    guard, training = min(max(4, lobe), most), min(max(8, lobe), most)
    has_range = radar.samples_per_chirp // 2 > 10
    return CfarDetector(
        guard=(2 if has_range else 0, guard),
        training=(8, training) if has_range else (0, max(16, training)),
        false_alarm=1e-5,
        edges=("reflect", "circular"),
        looks=len(radar.tx_positions_m) * len(radar.rx_positions_m),
    )


class PointDetector(nn.Module):
    """Detects points in profiles of an antenna array: range-Doppler cube, CFAR over range and Doppler, angles.

    Args:
        radar: an array whose virtual elements form an evenly spaced row along x, or one antenna pair, whose points
            have angle 0.
        window_s, overlap: frames, see :class:`RangeDopplerCube`.
        points: the largest number of points per frame.
        nearest_m: range of the first bin of the profiles.
        cfar: detector over (range, Doppler) of the mean power of the V channels; None is :func:`point_cfar`.
            Sidelobes above the noise are detected too: for strong echoes use ``range_window="hann"``.

    Shapes: profiles (..., V, M, R) complex, after a moving target indicator if static targets are not wanted ->
    :class:`Points` (..., K, points). Differentiable as :class:`PointCloud`.

    Raises:
        TensorsimError: as :class:`RangeDopplerCube` and :class:`CfarDetector`; an array that is not a uniform row
            along x.

    Example:
        >>> scene = ts.radar.PRESETS["ti-awr1843-array"]
        >>> simulator = ts.radar.RadarSimulator(scene)
        >>> positions = torch.tensor([1.0, 3.0, 1.0]) - torch.arange(900)[:, None, None] * torch.tensor([0, 2e-4, 0])
        >>> channels = simulator.mti(simulator.profiles(positions, torch.ones(1)))  # (8, 899, 256)
        >>> ts.radar.PointDetector(scene.radar)(channels).speed_m_s.shape  # frames, points
        torch.Size([1, 64])
    """

    def __init__(
        self,
        radar: RadarConfig,
        window_s: float = 0.1,
        overlap: float = 0.5,
        points: int = 64,
        nearest_m: float = 0.0,
        cfar: CfarDetector | None = None,
    ) -> None:
        super().__init__()
        if not is_finite(nearest_m):
            raise TensorsimError(f"nearest_m: got {nearest_m!r}, expected a finite range")
        self.cube = RangeDopplerCube(radar, window_s, overlap)
        spacing = row_spacing_m(radar) / radar.doppler_wavelength_m
        self.cfar = point_cfar(radar, self.cube) if cfar is None else cfar
        speed_step = self.cube.prf_hz / self.cube.bins * radar.doppler_wavelength_m / 2
        self.cloud = PointCloud(radar.range_resolution_m, speed_step, points, spacing)
        self.nearest_m = float(nearest_m)

    def forward(self, profiles: Tensor) -> Points:
        """Profiles (..., V, M, R) to points (..., K, points)."""
        cube = self.cube(profiles)
        power = torch.view_as_real(cube).square().sum(-1).mean(-3)
        found = self.cloud(cube, self.cfar(power))
        range_m = torch.where(found.valid, found.range_m + self.nearest_m, 0.0)
        return Points(range_m, found.speed_m_s, found.sine, found.power, found.valid)
