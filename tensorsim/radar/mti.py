"""Moving target indication: what stands still goes, what moves stays (Skolnik, *Introduction to Radar
Systems*, ch. 3)."""

from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.radar.range_profile import check_complex_map


def two_pulse_canceller(profiles: Tensor) -> Tensor:
    """``x[m + 1] - x[m]`` along pulses: (..., M, R) -> (..., M - 1, R); response ``|2 sin(pi fd / PRF)|``."""
    return profiles[..., 1:, :] - profiles[..., :-1, :]


def remove_mean(profiles: Tensor) -> Tensor:
    """Subtract each range bin's mean over pulses: (..., M, R) -> (..., M, R)."""
    return profiles - profiles.mean(-2, keepdim=True)


class MovingTargetIndicator(nn.Module):
    """Suppresses the static part of complex range profiles.

    Args:
        method: ``"two-pulse"`` (M pulses give M - 1) or ``"mean"``, which keeps slow motion at its full
            strength.

    Shapes: (..., M, R) complex -> (..., M', R) complex.

    Attributes:
        lost_pulses: M - M'.

    Raises:
        TensorsimError: unknown method, real profiles, fewer than two pulses.
    """

    def __init__(self, method: str = "two-pulse") -> None:
        super().__init__()
        if method not in ("two-pulse", "mean"):
            raise TensorsimError(f"method: got {method!r}, expected 'two-pulse' or 'mean'")
        self.method = method
        self.lost_pulses = 1 if method == "two-pulse" else 0

    def forward(self, profiles: Tensor) -> Tensor:
        """(..., M, R) to (..., M', R)."""
        check_complex_map(profiles, "profiles", "(..., pulses, range bins)")
        if profiles.shape[-2] < 2:
            raise TensorsimError(f"profiles: got shape {list(profiles.shape)}, expected at least two pulses")
        if self.method == "mean":
            return remove_mean(profiles)
        return two_pulse_canceller(profiles)
