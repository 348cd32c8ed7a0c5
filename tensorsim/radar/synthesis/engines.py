"""Two engines that compute noise-free range profiles of scatterers, with one interface.

    engine(positions (B, m, S, 3) m, rcs (B, m, S) m^2) -> profiles (B, m, R), energy (B,)

``energy`` is that of the reference signal of the receiver noise, over m pulses and the N samples of their IF.
Arguments are not checked; the simulator has checked them.
"""

from torch import Tensor, nn

from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.synthesis.closed_form import RangeBinSynthesizer
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tensorsim.radar.synthesis.noise import energy


class TimeEngine(nn.Module):
    """Computes the IF and its Fourier transform over fast time.

    Args:
        echo: scatterers -> IF.
        profile: IF -> range profiles.
        total: the energy includes the static paths.
    """

    def __init__(self, echo: EchoSynthesizer, profile: RangeProfile, total: bool) -> None:
        super().__init__()
        self.echo, self.profile, self.total = echo, profile, total

    def forward(self, positions: Tensor, rcs: Tensor) -> tuple[Tensor, Tensor]:
        """See the module."""
        echo = self.echo.target_echo(positions, rcs)
        samples = echo
        if len(self.echo.paths.static_names) > 0:
            samples = echo + self.echo.static_echo()
        return self.profile(samples), energy(samples if self.total else echo)


class RangeBinEngine(nn.Module):
    """Computes range bins in closed form; ``total``: the energy includes the static paths."""

    def __init__(self, bins: RangeBinSynthesizer, total: bool) -> None:
        super().__init__()
        self.bins, self.total = bins, total

    def forward(self, positions: Tensor, rcs: Tensor) -> tuple[Tensor, Tensor]:
        """See the module."""
        beat, strength = self.bins.tones(positions, rcs)
        profiles = self.bins.bins(beat, strength)
        if len(self.bins.echo.paths.static_names) > 0:
            profiles = profiles + self.bins.static_bins()
        return profiles, self.bins.energy(beat, strength, self.total).sum(-1)
