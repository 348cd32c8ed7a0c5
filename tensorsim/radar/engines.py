"""The two ways from scatterers to noisy range profiles, with one interface.

    engine(positions (B, m, S, 3) m, rcs (B, m, S) m^2, power (B,)) -> profiles (B, m, R), energy (B,)

``power`` is the variance of the receiver noise per IF sample of each clip, ``energy`` that of the noise that was
drawn, for as many samples as the IF has. Arguments are not checked: the simulator has done that.
"""

import torch
from torch import Tensor, nn

from tensorsim.radar.closed_form import RangeBinSynthesizer
from tensorsim.radar.echo import EchoSynthesizer
from tensorsim.radar.noise import ReceiverNoise, energy
from tensorsim.radar.range_profile import RangeProfile


class TimeEngine(nn.Module):
    """By way of the IF: echo, noise, Fourier transform over fast time."""

    def __init__(self, echo: EchoSynthesizer, noise: ReceiverNoise, profile: RangeProfile) -> None:
        super().__init__()
        self.echo, self.noise, self.profile = echo, noise, profile

    def forward(self, positions: Tensor, rcs: Tensor, power: Tensor) -> tuple[Tensor, Tensor]:
        """See the module."""
        samples = self.echo.target_echo(positions, rcs) + self.echo.static_echo()
        drawn = torch.zeros_like(power)
        if not self.noise.noiseless:
            noise = self.noise.draw(samples, power)
            drawn = energy(noise).to(power.dtype)
            samples += noise
        return self.profile(samples), drawn


class RangeBinEngine(nn.Module):
    """In closed form, with noise that is drawn in the bins and has the covariance of windowed white noise there."""

    def __init__(self, bins: RangeBinSynthesizer, noise: ReceiverNoise) -> None:
        super().__init__()
        self.bins, self.noise = bins, noise

    def forward(self, positions: Tensor, rcs: Tensor, power: Tensor) -> tuple[Tensor, Tensor]:
        """See the module."""
        profiles = self.bins.target_bins(positions, rcs) + self.bins.static_bins()
        drawn = torch.zeros_like(power)
        if not self.noise.noiseless:
            white = self.noise.draw(profiles, power)
            drawn = energy(white).to(power.dtype) * (self.bins.profile.samples / white.shape[-1])
            profiles = profiles + self.bins.color(white)
        return profiles, drawn
