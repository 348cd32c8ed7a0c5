"""The furniture and walls of a room, seen by a sensor that is never quite still."""

import math

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError, check_count, check_floating, check_min_rank
from tensorsim.motion.random_process import RandomProcess

Range = tuple[float, float]
#: Vibration of buildings, fans and tripods, in Hz.
VIBRATION_HZ = (2.0, 60.0)


def vibration_spectrum(frequency_hz: Tensor) -> Tensor:
    """Shape of the displacement's spectral density: inverse square of frequency, so that velocity is white."""
    return 1 / frequency_hz.square()


class RoomClutter(nn.Module):
    """Static point reflectors in a room, as scatterers of the scene.

    Their echoes are the same in every pulse, and a moving target indicator removes them, except for the vibration of
    the sensor: a shift of the sensor by u is a shift of the whole room by -u. After a two-pulse canceller a reflector
    keeps the fraction ``(4 pi / lambda)^2 E[(u(t + 1/PRF) - u(t))^2]`` of its power, with u along the line of sight.

    Reflectors are static targets, not people: add their echo after the noise has been set by that of the targets.
    The vibration is a function of time alone, so a clip processed in pieces gives the same result.

    Args:
        count: number of reflectors.
        x_m, y_m, z_m: ranges of the room from which their positions are drawn, uniformly.
        rcs_m2: range from which their cross sections are drawn, uniformly in dB: from chairs to corners of a room.
        jitter_m: root mean square of the sensor's vibration along each axis.
        seed: of the draw.

    Shapes: times (..., M) of pulses in seconds -> positions (..., M, count, 3) m and cross sections
        (..., M, count) m^2. Differentiable.

    Raises:
        TensorsimError: a count below 1, a range that does not ascend, a cross section that is not positive, a jitter
            below 0, times that are not floating point.
    """

    place_m: Tensor
    rcs_m2: Tensor

    def __init__(
        self,
        count: int = 12,
        x_m: Range = (-2.5, 2.5),
        y_m: Range = (1.0, 7.0),
        z_m: Range = (0.0, 2.5),
        rcs_m2: Range = (0.1, 10.0),
        jitter_m: float = 10e-6,
        seed: int = 0,
    ) -> None:
        super().__init__()
        check_count(count, "count")
        ranges = {"x_m": x_m, "y_m": y_m, "z_m": z_m, "rcs_m2": rcs_m2}
        for name, (low, high) in ranges.items():
            if not -math.inf < low <= high < math.inf:
                raise TensorsimError(f"{name}: got {(low, high)}, expected an ascending range")
        if rcs_m2[0] <= 0:
            raise TensorsimError(f"rcs_m2: got {rcs_m2}, expected positive cross sections")
        generator = torch.Generator().manual_seed(seed)
        draw = torch.rand(count, 4, generator=generator, dtype=torch.float64)
        bounds = torch.tensor((x_m, y_m, z_m), dtype=torch.float64)
        place = torch.lerp(bounds[:, 0], bounds[:, 1], draw[:, :3])
        rcs = rcs_m2[0] * (rcs_m2[1] / rcs_m2[0]) ** draw[:, 3]
        self.vibration = RandomProcess(vibration_spectrum, VIBRATION_HZ, jitter_m, 3, seed)
        self.register_buffer("place_m", place, persistent=False)
        self.register_buffer("rcs_m2", rcs, persistent=False)

    def forward(self, time_s: Tensor) -> tuple[Tensor, Tensor]:
        """Times of pulses to the scatterers of the room."""
        check_floating(time_s, "time_s")
        check_min_rank(time_s, 1, "time_s", "(..., pulses)")
        shift = self.vibration(time_s.double()).unsqueeze(-2)
        positions = (self.place_m.double() - shift).to(time_s.dtype)
        return positions, self.rcs_m2.to(time_s.dtype).expand(positions.shape[:-1])
