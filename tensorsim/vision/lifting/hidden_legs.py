"""Legs beyond the edge of the picture: a person who moves along walks, though the camera does not see the steps."""

import math
from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.body.gait import boulic_gait, cycle_s
from tensorsim.body.skeleton import mid_hips
from tensorsim.errors import TensorsimError, check_finite, check_mask, check_points, check_positive
from tensorsim.vision.smoothing.along_time import local_linear

#: Harmonics of the angles of a gait cycle.
_HARMONICS = 8
#: Relative speeds of the table of gaits: 0.1, 0.2, ... leg lengths per second.
_SPEEDS, _PER_SPEED = 25, 10.0


class HiddenLegs(nn.Module):
    """Gives unseen legs the steps of a gait at the speed of the hips.

    A lifter does not know the phase of legs beyond the picture, and gives them the mean of all phases: they hang
    without swinging, and the radar would see somebody glide. Where neither knees nor ankles are seen and the hips of an
    upright body move along, thighs and shanks swing in the direction of travel as in the gait of Boulic,
    Magnenat-Thalmann and Thalmann (1990, :func:`tensorsim.body.gait.boulic_gait`), whose cadence follows from the
    speed; the phase is arbitrary. Which way a body with hidden legs faces is poorly known, so it matters only where the
    person clearly walks backwards. Bones keep their lengths except for half a second at both ends, where old and new
    legs are blended.

    Args:
        slow_m_s, walking_m_s: speeds of the hips below which nothing changes, and from which legs follow the gait only.
        blend_s: half of the seconds over which legs begin to step once they are hidden, and stop before they are seen.

    Shapes:
        joints (..., T, 14, 3) in metres, z up, seen (..., T, 14) bool, valid (..., T) bool, frames per second ->
        joints (..., T, 14, 3). Differentiable.

    Raises:
        TensorsimError: speeds that are not positive or not ascending, wrong shapes, NaN.
    """

    cosines: Tensor
    sines: Tensor
    per_speed: Final[float]

    def __init__(self, slow_m_s: float = 0.3, walking_m_s: float = 0.6, blend_s: float = 0.25) -> None:
        super().__init__()
        check_positive(slow_m_s, "HiddenLegs.slow_m_s")
        check_positive(walking_m_s, "HiddenLegs.walking_m_s")
        check_positive(blend_s, "HiddenLegs.blend_s")
        if walking_m_s <= slow_m_s:
            raise TensorsimError(f"HiddenLegs.walking_m_s: got {walking_m_s}, expected more than {slow_m_s}")
        self.slow_m_s, self.walking_m_s, self.blend_s = slow_m_s, walking_m_s, blend_s
        self.per_speed = _PER_SPEED
        relative_speed = torch.arange(1, _SPEEDS + 1, dtype=torch.float64) / _PER_SPEED
        phase = torch.arange(64, dtype=torch.float64).expand(_SPEEDS, -1) / 64
        gait = boulic_gait(relative_speed, phase)
        # Flexion of the right hip and knee (speeds, angles, harmonics).
        series = torch.fft.rfft(torch.stack([gait.hip[..., 0], gait.knee[..., 0]], dim=1)) / 64
        series = series[..., : _HARMONICS + 1] * torch.tensor([1.0] + [2.0] * _HARMONICS)
        self.register_buffer("cosines", series.real.contiguous(), persistent=False)
        self.register_buffer("sines", -series.imag.contiguous(), persistent=False)

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
        trunk = joints[..., 1, :] - hips
        upright = trunk[..., 2] / trunk.square().sum(dim=-1).clamp(min=1e-6).sqrt()
        hidden = valid & ~(seen[..., 9:11].any(dim=-1) | seen[..., 12:14].any(dim=-1))
        share = hidden.to(joints.dtype)
        share = share * ((speed - self.slow_m_s) / (self.walking_m_s - self.slow_m_s)).clamp(0.0, 1.0)
        # A person who bends down or lies does not walk. Where forwards turns into backwards, stepping legs would jump.
        share = (
            share * ((upright - 0.7) / 0.15).clamp(0.0, 1.0) * ((forwards + 0.7).abs() / 0.15).clamp(0.0, 1.0)
        )
        share = self._blended(share, fps)[..., None]

        way = torch.where(forwards < -0.7, -1.0, 1.0).to(joints.dtype)
        ahead = F.pad(velocity / speed[..., None] * way[..., None], [0, 1])
        down = torch.tensor([0.0, 0.0, -1.0], dtype=joints.dtype, device=joints.device)
        upper = joints[..., 8:13:3, :] - joints[..., 9:14:3, :]  # hips to knees, right and left
        lower = joints[..., 9:14:3, :] - joints[..., 10:14:3, :]
        thighs, shanks = torch.linalg.vector_norm(upper, dim=-1), torch.linalg.vector_norm(lower, dim=-1)
        # Both legs have one cadence, however long each of them seems.
        relative_speed = speed / (thighs + shanks).mean(dim=-1).clamp(min=0.1)
        cycles = torch.cumsum(way / (cycle_s(relative_speed.clamp(min=0.1)) * fps), dim=-1)
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

    def _angles(self, relative_speed: Tensor, phase: Tensor) -> Tensor:
        """Flexion of a hip and a knee (..., 2) in radians at relative speeds and phases (...)."""
        last = self.cosines.shape[0] - 1
        place = (relative_speed * self.per_speed - 1.0).clamp(0.0, float(last))
        row = place.detach().long().clamp(max=last - 1)
        rest = (place - row)[..., None, None]
        number = torch.arange(self.cosines.shape[-1], device=phase.device, dtype=phase.dtype)
        turn = 2 * math.pi * phase[..., None, None] * number
        a, b = self.cosines.to(phase.dtype), self.sines.to(phase.dtype)
        even = a[row] + rest * (a[row + 1] - a[row])
        odd = b[row] + rest * (b[row + 1] - b[row])
        return (even * torch.cos(turn) + odd * torch.sin(turn)).sum(dim=-1)
