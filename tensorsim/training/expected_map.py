"""The expected Doppler-time picture of scatterers whose echoes add with random phases, without synthesis of pulses.

With range bins of centimetres, the scatterers of a body are in different bins, and the powers of their spectra add.
The spectrum of a scatterer over a short window is that of the window shifted to its Doppler frequency, provided that
its speed changes little within it. So the power of a pixel is a histogram of radial speeds, weighted with received
power and the gain of the moving target indicator, smoothed by the window in time and by its spectrum in Doppler
(V. C. Chen, *The Micro-Doppler Effect in Radar*, 2011, chapter 2, for the kinematics). A clip of four seconds takes
milliseconds, whereas a synthesis of 32768 pulses takes most of a second.
"""

import math

import torch
from torch import Tensor

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError, check_points
from tensorsim.radar.processing.doppler import DopplerFrames
from tensorsim.recognition.map_image import MapToImage, area_weights

#: Doppler bins on each side over which the spectrum of the window is spread.
_REACH = 8


def noise_rows(radar: RadarConfig, image: MapToImage) -> Tensor:
    """Expected power (size,) in the rows of a picture of receiver noise after the two-pulse MTI, 2 on average over
    all Doppler frequencies.

    The indicator's gain ``2 - 2 cos(2 pi f / PRF)`` is smoothed by the spectrum of the Hann window h of a frame, which
    multiplies the cosine by ``sum h[n] h[n + 1] / sum h[n]^2``.
    """
    frames = DopplerFrames(radar)
    window = frames.window
    lag = (window[:-1] * window[1:]).sum() / window.square().sum()
    gain = 2 - 2 * lag * torch.cos(2 * math.pi * frames.doppler_hz / radar.prf_hz)
    return image.rows(frames.bins) @ gain


class ExpectedMap:
    """Pictures of scatterers, for a radar in free space with one transmitter, one receiver and the two-pulse MTI.

    Args:
        radar: the radar.
        rate_hz: sampling rate of the scatterers.
        size: height and width of the pictures.
        speed_m_s: largest radial speed shown, in either direction.

    Raises:
        TensorsimError: a radar with several antennas.
    """

    def __init__(self, radar: RadarConfig, rate_hz: float, size: int, speed_m_s: float = 3.8) -> None:
        if radar.has_array:
            raise TensorsimError("ExpectedMap: got a radar with several antennas, expected one of each kind")
        self.radar, self.rate_hz, self.size = radar, rate_hz, size
        frames = DopplerFrames(radar)
        self.window_s, self.bins = frames.length / radar.prf_hz, frames.bins
        self.image = MapToImage.doppler(radar, speed_m_s, size)
        spectrum = torch.fft.fft(frames.window, frames.bins).abs().square()
        kernel = torch.cat([spectrum[-_REACH:], spectrum[: _REACH + 1]])
        self.kernel = kernel / kernel.sum()
        doppler = frames.doppler_hz / radar.prf_hz
        self.mti_gain = 4 * torch.sin(math.pi * doppler).square()
        # Half of the range bins are kept, with the noise of each.
        self.noise_rows = 0.5 * noise_rows(radar, self.image)

    def _columns(self, samples: int) -> Tensor:
        """Weights (size, samples) of instants in the columns: a column's frames, each with the window's square."""
        length = max(3, round(self.window_s * self.rate_hz))
        if samples <= length:
            raise TensorsimError(
                f"points: got {samples} instants, expected more than the {length} of a window of {self.window_s} s"
            )
        window = torch.hann_window(length + 2, periodic=False, dtype=torch.float64)[1:-1].square()
        centres = samples - length + 1
        start = torch.arange(centres, dtype=torch.float64)
        share = area_weights(start, 1.0, 0.0, float(centres), self.size)
        full = torch.nn.functional.conv_transpose1d(share[:, None], (window / window.sum())[None, None])
        return full[:, 0]

    def __call__(self, points: Tensor, rcs: Tensor, snr_db: float | None) -> Tensor:
        """Expected power picture (size, size), in units of the received power.

        Args:
            points: (M, S, 3) m.
            rcs: (M, S) m^2.
            snr_db: mean power of the echo relative to that of the noise in an IF sample; None is free of noise.

        Raises:
            TensorsimError: another shape, or fewer instants than a window of the Doppler-time map has.
        """
        check_points(points, 3, points.shape[1], 3, "points", "(M, S, 3)")
        points = points.double()
        tx, rx = points.new_tensor(self.radar.tx_m), points.new_tensor(self.radar.rx_m)
        away = [torch.linalg.vector_norm(points - place, dim=-1) for place in (tx, rx)]
        range_m = (away[0] + away[1]) / 2
        speed = -torch.gradient(range_m, spacing=1 / self.rate_hz, dim=0)[0]
        power = rcs.double() / (away[0] * away[1]).square().clamp(min=1e-3)
        echo = power.sum(1).mean()
        # Beyond the last range bin nothing is kept.
        power = power * (range_m < self.radar.reach_m)
        place = speed * 2 / self.radar.doppler_wavelength_m / self.radar.prf_hz * self.bins
        place = torch.remainder(torch.round(place).long() + self.bins // 2, self.bins)
        histogram = torch.zeros(len(points), self.bins, dtype=torch.float64).scatter_add_(1, place, power)
        spread = self._columns(len(points)) @ histogram  # (size, bins)
        ring = torch.nn.functional.pad(spread[:, None], (_REACH, _REACH), mode="circular")
        smooth = torch.nn.functional.conv1d(ring, self.kernel[None, None])[:, 0]
        # A target's power is in few of all the Doppler bins: per bin it is this many times the mean.
        picture = self.image.rows(self.bins) @ (smooth * self.mti_gain * self.bins).T
        if snr_db is not None:
            picture = picture + (echo * 10 ** (-snr_db / 10) * self.noise_rows)[:, None]
        return picture
