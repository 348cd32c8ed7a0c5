"""Joints to maps, frame by frame: a spline that looks two frames ahead, then the radar pulse by pulse."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.errors import TensorsimError
from tensorsim.ops import magnitude, of_person
from tensorsim.pipeline import PoseToDoppler
from tensorsim.radar.processing.columns import block_rms
from tensorsim.radar.simulator import Pending

#: Seconds over which a person fades in or out.
FADE_S = 0.1


class NewColumns(NamedTuple):
    """What a frame adds to the maps.

    Attributes:
        doppler_time: (F, k).
        range_time: (R, c) at the display rate.
        range_time_mti: (R, c').
        end_s: time up to which there are pulses.
    """

    doppler_time: Tensor
    range_time: Tensor
    range_time_mti: Tensor
    end_s: float


@dataclass
class _Person:
    """The last four frames of a person: joints (4, 14, 3) and presence (4,), the order of appearance, and whether
    the person is away, that is, was absent and has not come back yet."""

    joints: Tensor
    presence: Tensor
    order: int
    away: bool = False


def cubic_b_spline(knots: Tensor, u: Tensor) -> Tensor:
    """The uniform cubic B-spline, twice continuously differentiable, between the second and third of four knots.

    It smooths: at a knot it is (a + 4 b + c) / 6 (de Boor, "A Practical Guide to Splines", ch. X).

    Args:
        knots: (4, ...) values.
        u: (M,) in [0, 1), time since the second knot in intervals.

    Returns:
        (M, ...).
    """
    weights = (
        torch.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3], -1) / 6
    )
    return torch.tensordot(weights, knots, dims=1)


def _joined(scenes: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Scatterers (1, m, S, 3) and cross sections (1, m, S) joined in time; people who appear later add to S."""
    last = scenes[-1][0]
    places, sections = [], []
    for points, rcs in scenes:
        coming = last[:, :1, points.shape[2] :].expand(-1, points.shape[1], -1, -1)
        places.append(torch.cat([points, coming], dim=2))
        sections.append(torch.nn.functional.pad(rcs, (0, coming.shape[2])))
    return torch.cat(places, dim=1), torch.cat(sections, dim=1)


class LiveRadar:
    """The radar chain of a :class:`~tensorsim.PoseToDoppler`, given joints frame by frame.

    Frame k completes the motion up to frame k - 1, as the spline looks two frames ahead of the start of its piece.
    The noise level is set by a target of 1 m^2 at 3 m with the configured signal-to-noise ratio: the power of the
    people is not known in advance.

    Args:
        stage: scatterers and simulator.
        fps: frames per second.

    Raises:
        TensorsimError: a moving target indicator, smoothing along the pulses, sway or vital signs, a denoiser or
            effects of the receiver that need the whole clip; several antennas.
    """

    def __init__(self, stage: PoseToDoppler, fps: float) -> None:
        simulator = stage.simulator
        if simulator.mti.whole_clip:
            raise TensorsimError(f"live: got mti {simulator.mti.method!r}, expected 'two-pulse' or 'n-pulse'")
        for name, present in (
            ("smoothing along the pulses (--smoothing-ratio)", stage.halo > 0),
            ("sway or vital signs", len(stage.small_motions) > 0),
            ("a denoiser", stage.denoises),
            ("effects of the receiver", simulator.recorder.front_end is not None),
        ):
            if present:
                raise TensorsimError(f"live: got {name}, expected none: it needs the whole clip")
        if simulator.channels > 1:
            raise TensorsimError("live: got several antennas, expected one transmitter and one receiver")
        self.stage, self.simulator, self.fps = stage, simulator, fps
        self.prf_hz = float(simulator.radar.prf_hz)
        self.people: dict[int, _Person] = {}
        self.frame, self.pulse = -1, 0
        self.pending: Pending | None = None
        # Scatterers of pulses that wait for further pulses.
        self.begun: list[tuple[Tensor, Tensor]] = []
        self.rest = [torch.empty(0), torch.empty(0)]

    def push(self, joints: dict[int, tuple[Tensor, bool]]) -> NewColumns:
        """Add a frame.

        Args:
            joints: for each person by number, joints (14, 3) m float64 and whether the person is in the scene.
        """
        self.frame += 1
        self._remember(joints)
        stop = max(0, math.ceil((self.frame - 1) / self.fps * self.prf_hz - 1e-6))
        if stop > self.pulse:
            pulses = torch.arange(self.pulse, stop, dtype=torch.float64)
            self.begun.append(self._scene(pulses * self.fps / self.prf_hz - (self.frame - 2)))
            self.pulse = stop
        first = self.pulse - sum(points.shape[1] for points, _ in self.begun)
        # The moving target indicator needs several pulses to start.
        least = self.simulator.mti.lost_pulses if self.pending is None else 0
        if self.pulse - first <= least:
            return self._columns(None, first)
        scene, self.begun = _joined(self.begun), []
        return self._columns(scene, first)

    def _remember(self, joints: dict[int, tuple[Tensor, bool]]) -> None:
        step = 1 / max(1.0, FADE_S * self.fps)
        for number in joints:
            if number not in self.people:
                place = joints[number][0]
                self.people[number] = _Person(place.expand(4, 14, 3), torch.zeros(4).double(), number)
        for number, person in list(self.people.items()):
            place, there = joints.get(number, (person.joints[-1], False))
            # People who were absent reappear at their new place only once they have faded out at the old one.
            silent = float(person.presence.amax()) == 0
            if there and silent:
                person.joints = place.expand(4, 14, 3)
            person.away = not there or (person.away and not silent)
            if person.away:
                place = person.joints[-1]
            level = float(person.presence[-1]) + (-step if person.away else step)
            person.joints = torch.cat([person.joints[1:], place[None]])
            person.presence = torch.cat(
                [person.presence[1:], torch.tensor([min(max(level, 0.0), 1.0)]).double()]
            )
            if number not in joints and float(person.presence.amax()) == 0:
                del self.people[number]

    def _scene(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Scatterers (1, m, S, 3) and their cross sections at times u (m,) within the piece of the spline."""
        shown = [person for person in self.people.values() if float(person.presence.amax()) > 0]
        joints = (
            torch.stack([cubic_b_spline(p.joints, u) for p in shown])
            if shown
            else u.new_zeros(0, len(u), 14, 3)
        )
        fade = (
            torch.stack([cubic_b_spline(p.presence, u) for p in shown]) if shown else u.new_zeros(0, len(u))
        )
        order = torch.tensor([p.order for p in shown], dtype=torch.int64)
        scale = of_person(self.stage.rcs_scale, order).sqrt()[:, None]
        fade = fade * scale * self.stage.heard(joints)
        points, rcs = self.stage.scatterers(joints[None], fade[None])
        return points, rcs

    def _columns(self, scene: tuple[Tensor, Tensor] | None, first: int) -> NewColumns:
        if scene is None:
            end_s = first / self.prf_hz
            bins = self.simulator.range_profile.range_m.shape[0]
            empty = torch.zeros(bins, 0)
            return NewColumns(torch.zeros(self.simulator.doppler.bins, 0), empty, empty, end_s)
        end_s = self.pulse / self.prf_hz
        piece = self.simulator.advance(*scene, first, self.pending)
        self.pending = piece.pending
        still = self._display(0, magnitude(piece.profiles[0].T))
        moving = self._display(1, magnitude(piece.moving[0].T))
        return NewColumns(piece.doppler_time[0], still, moving, end_s)

    def _display(self, index: int, columns: Tensor) -> Tensor:
        """Columns (R, m) at the display rate; those that do not fill a block are kept for the next call."""
        if self.rest[index].numel():
            columns = torch.cat([self.rest[index], columns], dim=-1)
        block = self.simulator.range_time_block
        whole = columns.shape[-1] // block * block
        self.rest[index] = columns[:, whole:].clone()
        return block_rms(columns[:, :whole], block)
