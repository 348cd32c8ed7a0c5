"""Postural sway: nobody stands perfectly still."""

import torch
from torch import Tensor, nn

from tensorsim.body.proportions import SHANK, THIGH
from tensorsim.body.skeleton import lowest_ankle
from tensorsim.config import JOINTS
from tensorsim.errors import check_count, check_points, check_positive
from tensorsim.motion.random_process import RandomProcess, times_and_processes
from tensorsim.motion.scatterers import RIGHTWARD, weights
from tensorsim.ops import unit

#: Height of the centre of mass above the ankles, for a body of 1.75 m; sway amplitudes refer to it.
MASS_HEIGHT_M = (SHANK + THIGH + 0.03) * 1.75
#: Frequencies of quiet standing in Hz.
BAND_HZ = (0.03, 4.0)
#: Above this frequency the power falls with its square.
CORNER_HZ = 0.3


def sway_spectrum(frequency_hz: Tensor) -> Tensor:
    """Shape of the power density of sway: flat up to about 0.3 Hz, then falling with the square of the frequency."""
    return 1 / (1 + (frequency_hz / CORNER_HZ).square())


class PosturalSway(nn.Module):
    """Makes bodies sway over their ankles, each person as an independent inverted pendulum.

    A joint moves horizontally in proportion to its height above the lower ankle: standing bodies sway, lying ones do
    not. Forward and sideways sway are independent. Rms values at the centre of mass of young adults with open
    eyes are 3 to 6 mm forward and 2 to 4 mm sideways (Prieto et al., *Measures of postural steadiness*, IEEE Trans.
    Biomed. Eng. 43, 1996); above about 0.3 Hz the power falls with the square of the frequency, as for a random
    walk (Collins and De Luca, *Open-loop and closed-loop control of posture*, Exp. Brain Res. 95, 1993).

    Sway is a function of time alone: processing a clip in pieces gives the same result as the whole clip.

    Args:
        rate_hz: rate of the joints, that of the video or of the pulses.
        forward_rms_m, sideways_rms_m: at the height of the centre of mass, 0.91 m above the ankles.
        people: number of independent sways; person p uses number ``p % people``.
        seed: for the sway.

    Shapes: joints (..., P, T, 14, 3) metres -> the same. Differentiable.

    Raises:
        TensorsimError: a rate that is not positive, an rms below 0, ``people`` below 1, joints of another shape.
    """

    right: Tensor

    def __init__(
        self,
        rate_hz: float,
        forward_rms_m: float = 0.005,
        sideways_rms_m: float = 0.003,
        people: int = 8,
        seed: int = 0,
    ) -> None:
        super().__init__()
        check_positive(rate_hz, "rate_hz")
        check_count(people, "people")
        self.rate_hz, self.people, self.mass_height_m = float(rate_hz), people, MASS_HEIGHT_M
        self.forwards = RandomProcess(sway_spectrum, BAND_HZ, forward_rms_m, people, 2 * seed)
        self.sideways = RandomProcess(sway_spectrum, BAND_HZ, sideways_rms_m, people, 2 * seed + 1)
        self.register_buffer("right", weights(JOINTS, RIGHTWARD), persistent=False)

    def forward(self, joints: Tensor, start: int = 0) -> Tensor:
        """Joints of frames ``start`` onwards, swaying; frame k is at ``k / rate_hz``."""
        layout = "(..., P, T, 14, 3)"
        check_points(joints, 4, 14, 3, "joints", layout)
        time_s, who = times_and_processes(joints, self.rate_hz, start, self.people)
        own = min(who.shape[0], self.people)
        along = self.forwards(time_s, own)[:, who].T.to(joints.dtype)[..., None, None]  # (P, T, 1, 1)
        aside = self.sideways(time_s, own)[:, who].T.to(joints.dtype)[..., None, None]

        across = unit((self.right.to(joints.dtype) @ joints)[..., :2])
        ahead = torch.stack((-across[..., 1], across[..., 0]), -1)  # a quarter turn to the left of right
        lever = (joints[..., 2:] - lowest_ankle(joints)[..., None, None]).clamp_min(0.0) / self.mass_height_m
        shift = lever * (along * ahead + aside * across)
        return joints + torch.cat((shift, torch.zeros_like(lever)), -1)
