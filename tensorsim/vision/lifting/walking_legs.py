"""Legs of people who walk: they step as in a model of the gait, in phase with what the camera shows of them."""

import math
from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.body.gait import boulic_gait, cycle_s
from tensorsim.body.skeleton import mid_hips, trunk_uprightness
from tensorsim.errors import TensorsimError, check_finite, check_mask, check_points, check_positive
from tensorsim.vision.smoothing.along_time import gaussian_mean, local_linear

#: Harmonics of the angles of a gait cycle.
_HARMONICS = 8
#: Relative speeds of the table of gaits: 0.1, 0.2, ... leg lengths per second.
_SPEEDS, _PER_SPEED = 25, 10.0


class WalkingLegs(nn.Module):
    """Gives the legs of people who walk the steps of a gait at the speed of the hips.

    Films show too little of the legs of walkers, and a radar would see somebody glide. Where legs pass each other,
    pose networks confuse them, and may call the leading one left at every step. A lifter gives what is uncertain its
    mean: such legs swing too little, and those beyond the picture hang without swinging.

    Where the hips of an upright body move along, thighs and shanks swing in the direction of travel as in the gait of
    Boulic, Magnenat-Thalmann and Thalmann (1990, :func:`tensorsim.body.gait.boulic_gait`), whose cadence follows from
    the speed. Seen legs give the phase, in four coordinates of the right knee and ankle relative to the left ones,
    which change as Re(g exp(2 pi i p)) in the first harmonic of the gait, p in cycles. They are projected onto conj(g):
    z(t). With n(t) the cycles at the cadence of the speed, the mean of z^2 exp(-4 pi i n) over about a second has the
    phase 4 pi (p - n). It does not depend on which leg is called right; that is then chosen once for all frames. Legs
    that are seen follow the gait where they swing at least a little, but less than 0.6 to 0.8 times as far as in the
    gait: legs that swing as far are left as they are, also at another cadence (a kick, a film in slow motion), and so
    are those of people who run, or go sideways or backwards. Hidden legs follow it wherever the body moves: which way a
    body faces is poorly known where no ankle is seen, so it matters there only if the person clearly walks backwards.
    Bones keep their lengths except for half a second at both ends, where old and new legs are blended.

    Args:
        slow_m_s, walking_m_s: speeds of the hips below which nothing changes, and from which legs follow the gait only.
        running_m_s: speed from which legs that are seen are left as they are.
        blend_s: half of the seconds over which legs begin and cease to follow the gait.
        mean_s: standard deviation of the Gaussian over which the swing of seen legs is averaged.

    Shapes:
        joints (..., T, 14, 3) in metres, z up, seen (..., T, 14) bool, valid (..., T) bool, frames per second ->
        joints (..., T, 14, 3). Differentiable.

    Raises:
        TensorsimError: speeds or times that are not positive, speeds that are not ascending, wrong shapes, NaN.
    """

    cosines: Tensor
    sines: Tensor
    swing: Tensor
    per_speed: Final[float]

    def __init__(
        self,
        slow_m_s: float = 0.3,
        walking_m_s: float = 0.6,
        running_m_s: float = 2.4,
        blend_s: float = 0.25,
        mean_s: float = 0.45,
    ) -> None:
        super().__init__()
        check_positive(slow_m_s, "WalkingLegs.slow_m_s")
        check_positive(walking_m_s, "WalkingLegs.walking_m_s")
        check_positive(running_m_s, "WalkingLegs.running_m_s")
        check_positive(blend_s, "WalkingLegs.blend_s")
        check_positive(mean_s, "WalkingLegs.mean_s")
        if walking_m_s <= slow_m_s:
            raise TensorsimError(f"WalkingLegs.walking_m_s: got {walking_m_s}, expected more than {slow_m_s}")
        if running_m_s <= walking_m_s:
            raise TensorsimError(
                f"WalkingLegs.running_m_s: got {running_m_s}, expected more than {walking_m_s}"
            )
        self.slow_m_s, self.walking_m_s, self.running_m_s = slow_m_s, walking_m_s, running_m_s
        self.blend_s, self.mean_s = blend_s, mean_s
        self.per_speed = _PER_SPEED
        relative_speed = torch.arange(1, _SPEEDS + 1, dtype=torch.float64) / _PER_SPEED
        phase = torch.arange(64, dtype=torch.float64).expand(_SPEEDS, -1) / 64
        gait = boulic_gait(relative_speed, phase)
        # Flexion of the right hip and knee (speeds, angles, harmonics).
        series = torch.fft.rfft(torch.stack([gait.hip[..., 0], gait.knee[..., 0]], dim=1)) / 64
        series = series[..., : _HARMONICS + 1] * torch.tensor([1.0] + [2.0] * _HARMONICS)
        self.register_buffer("cosines", series.real.contiguous(), persistent=False)
        self.register_buffer("sines", -series.imag.contiguous(), persistent=False)
        # First harmonic of the right knee and ankle relative to the left ones, ahead and up, in leg lengths, with a
        # thigh as long as the shank: (speeds, coordinates, cosine and sine).
        thigh, shank = gait.hip, gait.hip - gait.knee
        knee = torch.stack([torch.sin(thigh), -torch.cos(thigh)], dim=1) / 2
        ankle = knee + torch.stack([torch.sin(shank), -torch.cos(shank)], dim=1) / 2
        legs = torch.cat([knee, ankle], dim=1)
        first = torch.fft.rfft(legs[..., 0] - legs[..., 1])[..., 1] / 32
        swing = torch.stack([first.real, -first.imag], dim=-1)
        self.register_buffer("swing", swing.contiguous(), persistent=False)

    def forward(self, joints: Tensor, seen: Tensor, valid: Tensor, fps: float) -> Tensor:
        """Joints, which of them are seen, frames with a person, frame rate -> joints."""
        check_points(joints, 3, 14, 3, "joints", "(..., T, 14, 3) metres")
        check_finite(joints, "joints")
        check_mask(seen, list(joints.shape[:-1]), "seen")
        check_mask(valid, list(joints.shape[:-2]), "valid")
        check_positive(fps, "fps")
        if joints.numel() == 0:
            return joints
        hips = mid_hips(joints)
        velocity = self._velocity(hips[..., :2], valid, fps)
        speed = velocity.square().sum(dim=-1).clamp(min=1e-12).sqrt()
        # Which way the body faces: a quarter turn from its right side, of hips and shoulders.
        right = joints[..., 8, :2] - joints[..., 11, :2] + joints[..., 2, :2] - joints[..., 5, :2]
        facing = F.normalize(torch.stack([-right[..., 1], right[..., 0]], dim=-1), dim=-1, eps=1e-6)
        forwards = (velocity * facing).sum(dim=-1) / speed
        upright = trunk_uprightness(joints)
        walks = ((speed - self.slow_m_s) / (self.walking_m_s - self.slow_m_s)).clamp(0.0, 1.0)
        # A person who bends down or lies does not walk. Where forwards turns into backwards, stepping legs would jump.
        walks = (
            walks * ((upright - 0.7) / 0.15).clamp(0.0, 1.0) * ((forwards + 0.7).abs() / 0.15).clamp(0.0, 1.0)
        )
        walks = walks * valid.to(joints.dtype)

        way = torch.where(forwards < -0.7, -1.0, 1.0).to(joints.dtype)
        ahead = F.pad(velocity / speed[..., None] * way[..., None], [0, 1])
        down = torch.tensor([0.0, 0.0, -1.0], dtype=joints.dtype, device=joints.device)
        to_knees = joints[..., 9:14:3, :] - joints[..., 8:13:3, :]  # from the hips, right and left
        to_ankles = joints[..., 10:14:3, :] - joints[..., 9:14:3, :]  # from the knees
        thighs = torch.linalg.vector_norm(to_knees, dim=-1)
        shanks = torch.linalg.vector_norm(to_ankles, dim=-1)
        # Both legs have one cadence, however long each of them seems.
        length = (thighs + shanks).mean(dim=-1).clamp(min=0.1)
        relative_speed = speed / length
        cycles = torch.cumsum(way / (cycle_s(relative_speed.clamp(min=0.1)) * fps), dim=-1)

        places = torch.stack([to_knees, to_knees + to_ankles], dim=-2) / length[..., None, None, None]
        along = torch.stack([(places * ahead[..., None, None, :]).sum(dim=-1), places[..., 2]], dim=-1)
        apart = (along[..., 0, :, :] - along[..., 1, :, :]).flatten(-2)  # right from left (..., T, 4)
        pairs = (seen[..., 9:11] & seen[..., 12:14]).to(joints.dtype) * walks[..., None]
        weights = torch.repeat_interleave(pairs, 2, dim=-1)
        cycles, some, enough = self._in_phase(apart, weights, relative_speed, cycles, fps)

        hidden = valid & ~(seen[..., 9:11].any(dim=-1) | seen[..., 12:14].any(dim=-1))
        shown = walks * some * (1.0 - enough) * ((self.running_m_s - speed) / 0.3).clamp(0.0, 1.0)
        # Near the camera, where no ankle is in the picture, which way the body faces is poorly known.
        sideways = ((0.5 - forwards) / 0.3).clamp(0.0, 1.0)
        shown = shown * (1.0 - (seen[..., 10] | seen[..., 13]).to(joints.dtype) * sideways)
        share = torch.maximum(
            self._blended(hidden.to(joints.dtype) * walks, fps), self._blended(shown, fps)
        ).unsqueeze(-1)
        parts: list[Tensor] = []
        for side in range(2):
            hip, thigh, shank = 8 + 3 * side, thighs[..., side, None], shanks[..., side, None]
            flexion = self._angles(relative_speed, cycles + 0.5 * side)
            bend, turned = flexion[..., :1], flexion[..., :1] - flexion[..., 1:]
            at_knee = joints[..., hip, :] + thigh * (torch.sin(bend) * ahead + torch.cos(bend) * down)
            at_ankle = at_knee + shank * (torch.sin(turned) * ahead + torch.cos(turned) * down)
            parts.append(joints[..., hip + 1, :] + share * (at_knee - joints[..., hip + 1, :]))
            parts.append(joints[..., hip + 2, :] + share * (at_ankle - joints[..., hip + 2, :]))
        legs = torch.stack(parts, dim=-2)
        return torch.cat(
            [joints[..., :9, :], legs[..., :2, :], joints[..., 11:12, :], legs[..., 2:, :]], dim=-2
        )

    def _in_phase(
        self, apart: Tensor, weights: Tensor, relative_speed: Tensor, cycles: Tensor, fps: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Cycles of the gait in phase with legs that are seen, and how far these swing.

        Args:
            apart: (..., T, 4) right knee and ankle relative to the left ones, ahead and up, in leg lengths.
            weights: (..., T, 4) from 0 to 1.
            relative_speed: (..., T) leg lengths per second.
            cycles: (..., T) of the gait at that speed, from any phase.
            fps: frames per second.

        Returns:
            Cycles (..., T); from 0 to 1, whether legs swing at all (0.1 to 0.2 times as far as in the gait), whichever
            is called right, and whether they swing as far as in the gait (0.6 to 0.8 times), in phase with it or at
            another cadence: less than 0.2 to 0.3 of the power of their swing is at that of the gait.
        """
        sigma = self.mean_s * fps
        gait = self._between(self.swing, relative_speed)
        swing = weights.unsqueeze(-1) * gait
        far = (swing * gait).sum(dim=[-2, -1]) / 2  # |z| in the gait
        # z(t) and the mean of z^2 exp(-4 pi i n), as real and imaginary parts.
        z = (swing * apart.unsqueeze(-1)).sum(dim=-2)
        real, imaginary = z[..., 0].square() - z[..., 1].square(), 2 * z[..., 0] * z[..., 1]
        cosine, sine = torch.cos(4 * math.pi * cycles), torch.sin(4 * math.pi * cycles)
        a = gaussian_mean(real * cosine + imaginary * sine, sigma)
        b = gaussian_mean(imaginary * cosine - real * sine, sigma)
        squared = (a.square() + b.square()).clamp(min=1e-18).sqrt()
        angle = torch.atan2(b, torch.where(squared > 2e-9, a, torch.ones_like(a)))
        turn = torch.remainder(angle[..., 1:] - angle[..., :-1] + math.pi, 2 * math.pi) - math.pi
        angle = angle[..., :1] + F.pad(turn, [1, 0]).cumsum(dim=-1)
        cycles = cycles + local_linear(angle, squared, sigma) / (4 * math.pi)
        turns = 2 * math.pi * cycles
        same = z[..., 0] * torch.cos(turns) + z[..., 1] * torch.sin(turns)
        other = (same.sum(dim=-1, keepdim=True) < 0).to(same.dtype)  # half a cycle: the other leg
        far_squared = gaussian_mean(far.square(), sigma) + 1e-6
        some = (squared / far_squared).sqrt()
        enough = gaussian_mean(same, sigma) * (1.0 - 2.0 * other) / gaussian_mean(far, sigma).clamp(min=1e-6)
        # Where right and left are confused, the cadence stays; legs that kick or walk in slow motion have another one.
        power = gaussian_mean(z.square().sum(dim=-1), sigma)
        swings = ((power + 1e-18) / far_squared).sqrt()
        at_cadence = squared / (power + 1e-6)
        otherwise = ((swings - 0.6) / 0.2).clamp(0.0, 1.0) * ((0.3 - at_cadence) / 0.1).clamp(0.0, 1.0)
        return (
            cycles + other / 2,
            ((some - 0.1) / 0.1).clamp(0.0, 1.0),
            torch.maximum(((enough - 0.6) / 0.2).clamp(0.0, 1.0), otherwise),
        )

    def _velocity(self, position: Tensor, valid: Tensor, fps: float) -> Tensor:
        """Velocity (..., T, 2) of positions (..., T, 2), over half a second."""
        frames = position.shape[-2]
        rows = position.transpose(-1, -2)
        weights = (valid.to(position.dtype) + 1e-6).unsqueeze(-2).expand_as(rows)
        smooth = local_linear(rows, weights, 0.2 * fps).transpose(-1, -2)
        time = torch.arange(frames, device=position.device)
        half = max(int(0.25 * fps), 1)
        before, after = (time - half).clamp(min=0), (time + half).clamp(max=frames - 1)
        seconds = ((after - before).to(position.dtype) / fps).clamp(min=1e-3)
        return (smooth.index_select(-2, after) - smooth.index_select(-2, before)) / seconds[:, None]

    def _blended(self, share: Tensor, fps: float) -> Tensor:
        """Mean of the smallest share (..., T) nearby: zero wherever it was, and changing steadily."""
        half = max(int(self.blend_s * fps), 1)
        rows = share.reshape(-1, 1, share.shape[-1])
        least = -F.max_pool1d(-rows, 2 * half + 1, 1, half)
        return F.avg_pool1d(least, 2 * half + 1, 1, half, count_include_pad=False).reshape(share.shape)

    def _between(self, table: Tensor, relative_speed: Tensor) -> Tensor:
        """Rows (..., *) of a table by relative speed, linearly interpolated at speeds (...)."""
        last = table.shape[0] - 1
        place = (relative_speed * self.per_speed - 1.0).clamp(0.0, float(last))
        row = place.detach().long().clamp(max=last - 1)
        rest = (place - row)[..., None, None]
        rows = table.to(relative_speed.dtype)
        return rows[row] + rest * (rows[row + 1] - rows[row])

    def _angles(self, relative_speed: Tensor, phase: Tensor) -> Tensor:
        """Flexion of a hip and a knee (..., 2) in radians at relative speeds and phases (...)."""
        number = torch.arange(self.cosines.shape[-1], device=phase.device, dtype=phase.dtype)
        turn = 2 * math.pi * phase[..., None, None] * number
        even = self._between(self.cosines, relative_speed)
        odd = self._between(self.sines, relative_speed)
        return (even * torch.cos(turn) + odd * torch.sin(turn)).sum(dim=-1)
