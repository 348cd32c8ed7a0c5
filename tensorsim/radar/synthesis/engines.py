"""Two engines that compute noise-free range profiles of scatterers, with one interface.

    engine(positions (B, m, S, 3) m, rcs (B, m, S) m^2, start, ahead) -> profiles (B, m, V R), energy (B,)

``start`` is the number of the first of m pulses, which sets the time of the room clutter's vibration; ``ahead``
(B, m, S, 3) is the displacement of the scatterers up to the next pulse, for transmitters that fire in turn, else None.
The channels of V antennas are concatenated along the range bins. ``energy`` is that of the reference signal of the
receiver noise, summed over m pulses and the N samples of their IF, mean over the channels. Arguments are not checked
here; the simulator has checked them.
"""

import torch
from torch import Tensor, nn

from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.synthesis.closed_form import RangeBinSynthesizer
from tensorsim.radar.synthesis.clutter import RoomClutter
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tensorsim.radar.synthesis.noise import energy


def channels_as_bins(profiles: Tensor) -> Tensor:
    """Profiles (B, V, m, R) of V antennas as (B, m, V R); those of one antenna (B, m, R) as they are."""
    return profiles if profiles.dim() == 3 else profiles.transpose(1, 2).flatten(2)


class TimeEngine(nn.Module):
    """Computes the IF and its Fourier transform over fast time.

    Args:
        echo: scatterers -> IF.
        profile: IF -> range profiles.
        total: whether the energy includes the static paths and the clutter.
        clutter: of the room.
    """

    def __init__(
        self, echo: EchoSynthesizer, profile: RangeProfile, total: bool, clutter: RoomClutter | None = None
    ) -> None:
        super().__init__()
        self.echo, self.profile, self.total = echo, profile, total
        self.clutter: nn.Module | None = clutter

    @torch.jit.export
    def samples(
        self, positions: Tensor, rcs: Tensor, start: int, ahead: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """IF (B, m, N), or (B, V, m, N) of several antennas, and the energy (B,)."""
        echo = self.echo.target_echo(positions, rcs, ahead)
        samples = echo
        if len(self.echo.paths.static_names) > 0:
            samples = samples + self.echo.static_echo()
        if self.clutter is not None:
            room, cross_sections = self.clutter(self.echo.pulse_times(start, positions.shape[1] + 1))
            moved = self.echo.displacements(room)
            moved = None if moved is None else moved[:-1]
            samples = samples + self.echo.target_echo(room[:-1], cross_sections[:-1], moved)
        reference = energy(samples if self.total else echo)
        return samples, reference if reference.dim() == 1 else reference.mean(-1)

    def forward(
        self, positions: Tensor, rcs: Tensor, start: int, ahead: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """See the module."""
        samples, reference = self.samples(positions, rcs, start, ahead)
        return channels_as_bins(self.profile(samples)), reference


class RangeBinEngine(nn.Module):
    """Computes range bins in closed form, for one antenna pair; other arguments as for :class:`TimeEngine`."""

    def __init__(self, bins: RangeBinSynthesizer, total: bool, clutter: RoomClutter | None = None) -> None:
        super().__init__()
        self.bins, self.total = bins, total
        self.clutter: nn.Module | None = clutter

    def forward(
        self, positions: Tensor, rcs: Tensor, start: int, ahead: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """See the module."""
        beat, strength = self.bins.tones(positions, rcs)
        profiles = self.bins.bins(beat, strength)
        if len(self.bins.echo.paths.static_names) > 0:
            profiles = profiles + self.bins.static_bins()
        if self.clutter is not None:
            room, cross_sections = self.clutter(self.bins.echo.pulse_times(start, positions.shape[1]))
            tones = self.bins.tones(room, cross_sections)
            profiles = profiles + self.bins.bins(tones[0], tones[1])
            if self.total:
                beat = torch.cat((beat, tones[0].expand(list(beat.shape[:-1]) + [-1])), -1)  # noqa: RUF005 (TorchScript)
                strength = torch.cat((strength, tones[1].expand(list(strength.shape[:-1]) + [-1])), -1)  # noqa: RUF005
        return profiles, self.bins.energy(beat, strength, self.total).sum(-1)
