"""Options of the receiver and of what else it receives: imperfections, the furniture of a room, another radar."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tensorsim.commands.arguments import Option, numbers

if TYPE_CHECKING:
    from tensorsim.config import SimulationConfig

#: The field of the configuration that an option of the receiver sets.
RECEIVER_FIELDS = {
    "phase_noise_dbc_hz": "scene__receiver__phase_noise_dbc_hz",
    "iq_imbalance_db": "scene__receiver__iq_imbalance_db",
    "dc_offset_db": "scene__receiver__dc_offset_db",
    "real_receiver": "scene__receiver__real",
    "adc_bits": "scene__receiver__adc_bits",
    "adc_headroom_db": "scene__receiver__adc_headroom_db",
}


@dataclass(frozen=True, kw_only=True)
class ReceiverOptions:
    """The receiver, the room, and other radars in it."""

    receiver: Option[Literal["ideal", "typical"]] = None
    """An ideal receiver, or a typical one with the phase noise, 12-bit ADCs, I/Q imbalance and DC offset of an
    integrated radar; the options below change individual effects. Default: ideal."""
    phase_noise_dbc_hz: Option[float] = None
    """Phase noise of the oscillator in dBc/Hz at 1 MHz from the carrier, such as -93. Default: none."""
    iq_imbalance_db: Option[float] = None
    """Gain of Q relative to I in dB. Default: 0."""
    iq_phase_deg: Option[float] = None
    """Deviation of the I/Q phase difference from 90 degrees. Default: 0."""
    dc_offset_db: Option[float] = None
    """Power of a DC offset relative to the people's echo, in dB. Default: none."""
    real_receiver: Annotated[Option[bool], tyro.conf.FlagConversionOff] = None
    """One real channel instead of I and Q; spectra of a radar that measures no range become mirror-symmetric.
    Default: I and Q."""
    adc_bits: Option[int] = None
    """Resolution of the ADCs in bits. Default: no quantisation."""
    adc_headroom_db: Option[float] = None
    """Full scale of the ADCs above the rms of their input, in dB; smaller values saturate more. Default: 12."""
    clutter: Option[Literal["none", "room"]] = None
    """Furniture and walls of a room, seen by a slightly vibrating sensor. Default: none."""
    interference: Annotated[Option[tuple[float, float, float]], numbers("X Y Z")] = None
    """Position in metres of another radar in the same band, with longer sweeps. Default: none."""

    def with_receiver(self, config: "SimulationConfig") -> "SimulationConfig":
        """The configuration with ``--receiver``, ``--iq-phase-deg``, ``--clutter`` and ``--interference``."""
        from tensorsim.config import ClutterConfig, InterferenceConfig, ReceiverConfig

        if self.receiver is not None:
            chosen = ReceiverConfig.typical() if self.receiver == "typical" else ReceiverConfig()
            config = config.replace(scene__receiver=chosen)
        if self.iq_phase_deg is not None:
            config = config.replace(scene__receiver__iq_phase_rad=math.radians(self.iq_phase_deg))
        if self.clutter is not None:
            config = config.replace(scene__clutter=ClutterConfig() if self.clutter == "room" else None)
        if self.interference is not None:
            config = config.replace(scene__interference=InterferenceConfig(self.interference))
        return config
