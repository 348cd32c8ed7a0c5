"""Breathing and heartbeat."""

import math

import torch
from torch import Tensor, nn

from tensorsim.config import JOINTS
from tensorsim.errors import (
    check_count,
    check_floating,
    check_interval,
    check_points,
    check_positive,
)
from tensorsim.motion.random_process import RandomProcess, times_and_processes
from tensorsim.motion.scatterers import RIGHTWARD, weights
from tensorsim.ops import unit

Range = tuple[float, float]
#: Deviation of a breath's or beat's timing from an even rhythm, in cycles, and how fast it changes, in Hz.
WANDER_CYCLES = 0.15
WANDER_HZ = (0.01, 0.1)


class VitalSigns(nn.Module):
    """Moves the chest: breathing of 4 to 12 mm at 0.2 to 0.4 Hz, heartbeat of 0.2 to 0.5 mm at 1 to 1.7 Hz.

    Peak-to-peak values for adults at rest (DeGroote et al., *Chest wall motion during tidal breathing*, J. Appl.
    Physiol. 83, 1997; Ramachandran and Singh, *Three-dimensional reconstruction of cardiac displacement patterns on
    the chest wall*, Med. Biol. Eng. Comput. 27, 1989). The neck moves forward and back, perpendicular to the
    trunk, and the trunk's upper end with it; hips and all other joints stay. Both rhythms vary a little.

    The motion is a function of time alone: processing a clip in pieces gives the same result as the whole clip.

    Args:
        rate_hz: rate of the joints, that of the video or of the pulses.
        breath_m, breath_hz: ranges from which each person's depth (peak to peak) and rate are drawn, uniformly.
        heart_m, heart_hz: likewise for the heartbeat.
        people: number of independent rhythms; person p uses number ``p % people``.
        seed: for the draw.

    Shapes: joints (..., P, T, 14, 3) metres -> the same. Differentiable.

    Raises:
        TensorsimError: a rate that is not positive, a range that does not ascend from 0 or more, ``people`` below 1,
            joints of another shape.
    """

    right: Tensor
    trunk: Tensor
    neck: Tensor
    depth_m: Tensor
    cycle_hz: Tensor
    phase: Tensor

    def __init__(
        self,
        rate_hz: float,
        breath_m: Range = (0.004, 0.012),
        breath_hz: Range = (0.2, 0.4),
        heart_m: Range = (0.0002, 0.0005),
        heart_hz: Range = (1.0, 1.7),
        people: int = 8,
        seed: int = 0,
    ) -> None:
        super().__init__()
        check_positive(rate_hz, "rate_hz")
        ranges = {"breath_m": breath_m, "breath_hz": breath_hz, "heart_m": heart_m, "heart_hz": heart_hz}
        for name, bounds in ranges.items():
            check_interval(bounds, 0, math.inf, name)
        check_count(people, "people")
        generator = torch.Generator().manual_seed(seed)
        draw = torch.rand(3, 2, people, generator=generator, dtype=torch.float64)
        both = torch.tensor(((breath_m, heart_m), (breath_hz, heart_hz)), dtype=torch.float64)
        drawn = torch.lerp(both[..., :1], both[..., 1:], draw[:2])
        self.rate_hz, self.people = float(rate_hz), people
        self.wander = RandomProcess(torch.ones_like, WANDER_HZ, WANDER_CYCLES, 2 * people, seed, 12)
        trunk = {"neck": 1.0, "right_hip": -0.5, "left_hip": -0.5}
        self.register_buffer("right", weights(JOINTS, RIGHTWARD), persistent=False)
        self.register_buffer("trunk", weights(JOINTS, trunk), persistent=False)
        self.register_buffer("neck", weights(JOINTS, {"neck": 1.0}).T.contiguous(), persistent=False)
        self.register_buffer("depth_m", drawn[0], persistent=False)
        self.register_buffer("cycle_hz", drawn[1], persistent=False)
        self.register_buffer("phase", draw[2], persistent=False)

    @torch.jit.export
    def displacement_m(self, time_s: Tensor, people: int | None = None) -> Tensor:
        """Chest displacement (..., people) in metres, forward positive, at times (...) in seconds.

        For the first ``people``; default all.
        """
        check_floating(time_s, "time_s")
        own = self.people if people is None else min(people, self.people)
        wander = self.wander(time_s.double(), 2 * own).unflatten(-1, [own, 2]).transpose(-1, -2)
        cycles = time_s.double()[..., None, None] * self.cycle_hz.double()[:, :own]
        cycles = cycles + self.phase.double()[:, :own] + wander
        waves = torch.cos(2 * math.pi * (cycles - cycles.detach().floor()))
        return (self.depth_m.double()[:, :own] / 2 * waves).sum(-2).to(time_s.dtype)

    def forward(self, joints: Tensor, start: int = 0) -> Tensor:
        """Joints of frames ``start`` onwards, breathing; frame k is at ``k / rate_hz``."""
        layout = "(..., P, T, 14, 3)"
        check_points(joints, 4, 14, 3, "joints", layout)
        time_s, who = times_and_processes(joints, self.rate_hz, start, self.people)
        chest = self.displacement_m(time_s, who.shape[0])[:, who].T.to(joints.dtype)[
            ..., None, None
        ]  # (P, T, 1, 1)

        up, right = self.trunk.to(joints.dtype) @ joints, self.right.to(joints.dtype) @ joints
        ahead = unit(torch.cross(up, right, dim=-1))
        return joints + self.neck.to(joints.dtype) * chest * ahead
