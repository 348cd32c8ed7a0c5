"""Moving target indication (MTI): filters along pulses that suppress static echoes.

See Skolnik, *Introduction to Radar Systems*, ch. 3.
"""

import math

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError, check_choice, check_complex_map, check_count, check_positive
from tensorsim.ops import flatten_batch, unflatten_batch
from tensorsim.protocols import check_instance
from tensorsim.radar.processing.iir import BlockFilter

METHODS = ("two-pulse", "n-pulse", "mean", "high-pass")


def two_pulse_canceller(profiles: Tensor) -> Tensor:
    r"""Two-pulse canceller: (..., M, R) -> (..., M - 1, R).

    $$ y[m] = x[m + 1] - x[m], \quad |H(f_d)| = |2 \sin(\pi f_d / \mathrm{PRF})| $$

    Inputs are not checked; a single pulse gives an empty result.
    """
    return profiles[..., 1:, :] - profiles[..., :-1, :]


def n_pulse_canceller(profiles: Tensor, pulses: int) -> Tensor:
    """n - 1 two-pulse cancellers in series, n = ``pulses``: (..., M, R) -> (..., M - n + 1, R).

    The weights are binomial, ``(-1)^(n-1-k) C(n - 1, k)``, the response is ``|2 sin(pi fd / PRF)|^(n - 1)``.
    """
    for _ in range(pulses - 1):
        profiles = two_pulse_canceller(profiles)
    return profiles


def remove_mean(profiles: Tensor) -> Tensor:
    """Subtract each range bin's mean over pulses: (..., M, R) -> (..., M, R)."""
    return profiles - profiles.mean(-2, keepdim=True)


def highpass_sections(cutoff_hz: float, prf_hz: float, order: int) -> Tensor:
    """Butterworth high-pass as biquads (ceil(order / 2), 6) float64; -3.01 dB at ``cutoff_hz``."""
    from scipy.signal import butter

    return torch.as_tensor(butter(order, cutoff_hz, "highpass", fs=prf_hz, output="sos"))


class MovingTargetIndicator(nn.Module):
    """Moving target indication: suppresses the static part of complex range profiles.

    Args:
        method: ``"two-pulse"`` (M pulses give M - 1); ``"n-pulse"``, a deeper and wider notch (M - n + 1);
            ``"mean"``, which does not attenuate slow motion; ``"high-pass"``, a Butterworth filter that is flat
            above its cut-off. It filters the difference to the first profile with zero initial state, so that a
            static scene gives exactly 0.
        radar: PRF and wavelength, for ``"high-pass"`` only.
        pulses: n of ``"n-pulse"``.
        cutoff_m_s: radial speed at which ``"high-pass"`` attenuates by 3 dB.
        order: order of ``"high-pass"``, 1 to 8.

    Shapes: (..., M, R) complex -> (..., M', R) complex. Differentiable.

    Attributes:
        lost_pulses: M - M'.
        delay_pulses: output m belongs to the instant ``(m + delay_pulses) / PRF`` of the input: (n - 1) / 2 for the
            cancellers, whose weights are symmetric, else 0. The delay of the recursive filter depends on Doppler:
            for order 4, 0.6 periods of the cut-off frequency at the cut-off, 0.004 periods at ten times the cut-off.
        whole_clip: whether every output depends on all pulses or all earlier ones, so that a clip cannot be
            processed in pieces that overlap by ``lost_pulses``.

    Raises:
        TensorsimError: unknown method or settings, real profiles, fewer pulses than the method needs.
    """

    sections: Tensor

    def __init__(
        self,
        method: str = "two-pulse",
        radar: RadarConfig | None = None,
        pulses: int = 3,
        cutoff_m_s: float = 0.2,
        order: int = 4,
    ) -> None:
        super().__init__()
        check_choice(method, METHODS, "method")
        if method == "n-pulse":
            check_count(pulses, "pulses", 2)
        unused = [
            name
            for name, differs, used_by in (
                ("pulses", pulses != 3, "n-pulse"),
                ("cutoff_m_s", cutoff_m_s != 0.2, "high-pass"),
                ("order", order != 4, "high-pass"),
            )
            if differs and method != used_by
        ]
        if unused:
            raise TensorsimError(
                f"{', '.join(unused)}: got a value, which the method {method!r} does not use"
            )
        self.method = method
        self.lost_pulses = {"two-pulse": 1, "n-pulse": pulses - 1}.get(method, 0)
        self.delay_pulses = self.lost_pulses / 2
        self.whole_clip = method in ("mean", "high-pass")
        sections = torch.zeros(0, 6, dtype=torch.float64)
        self.filter: nn.Module = nn.Identity()
        if method == "high-pass":
            sections = self._design(radar, cutoff_m_s, order)
            self.filter = BlockFilter(sections)
        self.register_buffer("sections", sections, persistent=False)

    @staticmethod
    @torch.jit.unused
    def _design(radar: RadarConfig | None, cutoff_m_s: float, order: int) -> Tensor:
        if radar is None:
            raise TensorsimError(
                "radar: got None, expected the radar: a high-pass needs its PRF and wavelength"
            )
        check_instance(radar, RadarConfig, "radar")
        check_count(order, "order", 1, 8)
        check_positive(cutoff_m_s, "cutoff_m_s")
        cutoff_hz = 2 * cutoff_m_s / radar.doppler_wavelength_m
        if not cutoff_hz < radar.prf_hz / 2:
            limit = radar.doppler_wavelength_m * radar.prf_hz / 4
            raise TensorsimError(
                f"cutoff_m_s: got {cutoff_m_s} m/s, expected a speed between 0 and the unambiguous {limit:.4g} m/s"
            )
        return highpass_sections(cutoff_hz, radar.prf_hz, order)

    @torch.jit.unused
    def response(self, doppler_hz: Tensor, prf_hz: float) -> Tensor:
        """Complex gain (...) of a target at these Doppler frequencies (positive = approaching).

        The gain refers to the echo of the target at the instant of the output (``delay_pulses``); for the
        cancellers it is ``(-2j sin(pi fd / PRF))^(n - 1)``. A radial speed v has ``fd = 2 v /
        radar.doppler_wavelength_m``. For ``"mean"`` it is the limit for a long clip: 0 at multiples of the PRF, else 1.
        """
        # The phase of an approaching target decreases from pulse to pulse.
        angle = -2 * math.pi * doppler_hz.double() / prf_hz
        if self.method == "mean":
            blind = torch.remainder(doppler_hz.double(), prf_hz) == 0
            return torch.where(blind, 0.0, 1.0).to(torch.complex128)
        if self.method == "high-pass":
            delays = torch.exp(-1j * angle[..., None, None] * torch.arange(3, device=angle.device))
            sections = self.sections.to(delays)
            numerator, denominator = (sections[:, :3] * delays).sum(-1), (sections[:, 3:] * delays).sum(-1)
            return (numerator / denominator).prod(-1)
        return (2j * torch.sin(angle / 2)) ** self.lost_pulses

    def forward(self, profiles: Tensor) -> Tensor:
        """(..., M, R) to (..., M', R)."""
        check_complex_map(profiles, "profiles", "(..., pulses, range bins)")
        least = max(2, self.lost_pulses + 1)
        if profiles.shape[-2] < least:
            raise TensorsimError(
                f"profiles: got shape {list(profiles.shape)}, expected at least {least} pulses"
            )
        if self.method == "mean":
            return remove_mean(profiles)
        if self.method == "high-pass":
            moving = flatten_batch(profiles - profiles[..., :1, :], 2)
            columns = torch.view_as_real(moving).flatten(2)  # real and imaginary parts side by side
            filtered = self.filter(columns).unflatten(2, (moving.shape[2], 2))
            return unflatten_batch(torch.view_as_complex(filtered.contiguous()), list(profiles.shape[:-2]))
        return n_pulse_canceller(profiles, self.lost_pulses + 1)
