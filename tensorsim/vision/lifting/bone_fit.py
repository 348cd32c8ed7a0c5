"""Depths of joints from bones that keep their length.

A joint that is seen lies on its line of sight; how far along it is what one camera does not tell. But bones do not
stretch, both arms and legs are of a size, limbs do not jerk and nobody sinks into the floor. The most likely depths
under these (C. J. Taylor, "Reconstruction of articulated objects from point correspondences in a single uncalibrated
image", 2000, who takes them from a single frame) are a sparse least-squares problem over the clip. With r(t, j) the
distance of joint j from the camera, r' what the lifter says, h the same of the middle of the hips, unknown bone
lengths L and Cauchy's loss c(x) = log(1 + x^2), which lets go of a lifter that is far off:

    sum over t  sum over bones (|Xa - Xb| - L)^2 / sb^2  +  |r(t-1) - 2 r(t) + r(t+1)|^2 / (sa(t, j) dt^2)^2
                + w c(((r - h) - (r' - h')) / sl)  +  w c((h - h') / sh)       + sum over lengths log(L / L0)^2 / sL^2

The acceleration sa to be expected of a joint along its line of sight is told by its own across it and by that of the
whole body. Where height and tilt of the camera are known, no joint is below the floor and the lowest one is near the
height at which it rests; a foot that stands is there to 2 mm, one that moves may have its heel up. A joint that the
camera does not see says nothing of bones and floor: it stays near the place that the lifter gave it.

Levenberg-Marquardt from r' finds a minimum; its normal equations couple a frame to the two before it and are solved
frame pair by frame pair, so the work grows with the length of the clip and no faster. Which of the many minima that
is, one for each bone that may lean to the camera or away from it, is then mended by
:func:`tensorsim.vision.lifting.bone_branches.choose_branches` as long as that lowers the sum.

Made for keypoints that are exact but for noise that differs from frame to frame: labelled ones, markers. Networks are
off by the same few pixels for seconds, which bends depths more than it mends them.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.errors import (
    TensorsimError,
    check_finite,
    check_floating,
    check_min_rank,
    check_positive,
    check_size,
    is_exporting,
)
from tensorsim.vision.lifting.block_tridiagonal import solve_block_tridiagonal
from tensorsim.vision.lifting.bone_branches import choose_branches
from tensorsim.vision.smoothing.along_time import nearest_valid
from tensorsim.vision.smoothing.noise import jitter

#: Bones by their ends; 14 is the middle of the hips. The neck, joint 1, is the middle of the shoulders.
BONES = (
    (0, 1), (2, 5), (2, 3), (3, 4), (5, 6), (6, 7), (8, 11), (8, 9), (9, 10), (11, 12), (12, 13), (1, 14),
)  # fmt: skip
#: Which length each bone has: left and right limbs are of a size.
LENGTH_OF_BONE = (0, 1, 2, 3, 2, 3, 4, 5, 6, 5, 6, 7)
#: Neck to nose, shoulders, upper arm, forearm, hips, thigh, shank and trunk as shares of the standing height (Winter,
#: after Drillis and Contini); hips and nose are those of ``tensorsim.body.kinematics``.
LENGTH_SHARES = (0.125, 0.210, 0.186, 0.146, 0.122, 0.2455, 0.2455, 0.288)
#: Height over the floor of an ankle that stands, likewise, and of any other joint that lies, which has flesh around it.
ANKLE_SHARE, FLESH_SHARE = 0.039, 0.045


def expected_acceleration(across: Tensor, noise: Tensor, fps: float, least: float, ratio: float) -> Tensor:
    """How much joints are likely to accelerate along their lines of sight, from how much they do across.

    Args:
        across: (S, T, J, 3) places in metres of which the unknown direction counts for nothing, T >= 3.
        noise: (S) standard deviation of each coordinate.
        fps: frames per second.
        least: m/s^2 of joints that rest in the picture.
        ratio: of what is expected to the root mean square of what is seen, of the joint and of the body together.

    Returns:
        (S, T, J) m/s^2, smoothed over a fifteenth of a second.
    """
    square = (across[:, 2:] - 2 * across[:, 1:-1] + across[:, :-2]).square().sum(dim=-1)
    sigma = fps / 15.0
    radius = int(3 * sigma) + 1
    kernel = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, device=across.device) / sigma).square())
    kernel = (kernel / kernel.sum()).to(across.dtype)
    rows = square.transpose(1, 2).flatten(0, 1)[:, None]
    rows = F.conv1d(F.pad(rows, [radius + 1, radius + 1], mode="replicate"), kernel[None, None])
    smooth = rows.reshape(square.shape[0], square.shape[2], -1).transpose(1, 2)
    # Noise of variance s^2 has second differences of 6 s^2, in each of the two directions across.
    smooth = (smooth - 12 * noise.square()[:, None, None]).clamp(min=0.0) * fps**4
    return (least**2 + ratio**2 * (smooth + smooth.mean(dim=-1, keepdim=True))).sqrt()


class _Clip(NamedTuple):
    """What is known of S people in T frames: the 13 free joints, without the neck.

    Attributes:
        lines: (S, T, 13, 3) unit lines of sight.
        given: (S, T, 13) distances that the lifter gave.
        shares: (S, 8) expected lengths in metres.
        height: (S, T, 13, 2) of joints over where they rest, at distance 0 and how much more per metre.
        stiff: (S, T + 2, 13) weights of squared second differences that end in a frame; 0 where there is none.
        footing: (S, T, 13) weights of squared heights of the lowest joint; 0 of joints that are not seen.
        hidden: (S, T, 12) variance in m^2 that bones to joints have which are not seen.
    """

    lines: Tensor
    given: Tensor
    shares: Tensor
    height: Tensor
    stiff: Tensor
    footing: Tensor
    hidden: Tensor


class BoneFit(nn.Module):
    """Refines how far joints are along their lines of sight, so that bones keep their length.

    Args:
        camera_m: (3,) position of the camera.
        person_height_m: standing heights by order of person; the last one serves all further people.
        calibrated: height and tilt of the camera are known well: then the floor tells how far people are.
        bone_m: deviation of bones from their length that counts as one, besides the noise of the keypoints.
        length_share: relative deviation of bodies from ``LENGTH_SHARES``.
        acceleration_m_s2: typical acceleration of joints that rest in the picture.
        acceleration_ratio: see :func:`expected_acceleration`.
        depth_m: deviation of the given depths about the hips.
        range_m: the same of the hips.
        trust: weight of what is given; below 1, as it is off in the same way for several frames.
        floor_m: deviation of the lowest joint from its height over the floor, of ankles see ``standing_m``.
        steps: of Levenberg-Marquardt while bones still may stretch much, to find the way, and when they no longer do.
        rounds: at most so many times the branches are chosen anew.

    Shape:
        joints (..., P, T, 14, 3) in world metres, seen (..., P, T, 14) bool and frames per second -> joints, moved
        along their lines of sight; the neck comes out in the middle of the shoulders. Frames in which nothing is
        seen and clips of fewer than 4 frames stay. Computed in float64. Differentiable by joints, but for the
        choice of branches.

    Raises:
        TensorsimError: settings that are not positive, wrong shapes, NaN.
    """

    camera: Tensor
    heights: Tensor
    spread: Tensor
    bones: Tensor
    length_of_bone: Tensor
    shares: Tensor
    rest: Tensor
    ankle: Tensor

    def __init__(
        self,
        camera_m: tuple[float, float, float] = (0.0, 0.0, 1.5),
        person_height_m: tuple[float, ...] = (1.80, 1.70),
        calibrated: bool = False,
        bone_m: float = 0.0001,
        length_share: float = 0.025,
        acceleration_m_s2: float = 4.0,
        acceleration_ratio: float = 3.0,
        depth_m: float = 0.05,
        range_m: float = 0.3,
        trust: float = 0.3,
        floor_m: float = 0.005,
        steps: tuple[int, int] = (8, 12),
        rounds: int = 3,
    ) -> None:
        super().__init__()
        for name, value in (
            ("bone_m", bone_m),
            ("length_share", length_share),
            ("acceleration_m_s2", acceleration_m_s2),
            ("acceleration_ratio", acceleration_ratio),
            ("depth_m", depth_m),
            ("range_m", range_m),
            ("trust", trust),
            ("floor_m", floor_m),
            *((f"person_height_m[{i}]", height) for i, height in enumerate(person_height_m)),
        ):
            check_positive(value, f"BoneFit.{name}")
        if len(person_height_m) == 0:
            raise TensorsimError("BoneFit.person_height_m: got no values, expected one per person")
        self.bone_m, self.length_share, self.depth_m, self.range_m = bone_m, length_share, depth_m, range_m
        self.acceleration, self.acceleration_ratio = acceleration_m_s2, acceleration_ratio
        self.trust, self.floor_m, self.steps, self.rounds = trust, floor_m, steps, rounds
        self.calibrated = calibrated
        self.floor_reach_m = 0.03  # a lowest joint further off the floor than this is likely off it
        self.standing_m, self.heel_s = 0.002, 0.02  # deviation of ankles that rest, and how much more per m/s
        self.hidden_m = 0.1  # deviation of bones to joints that are not seen
        # All 14 joints and the middle of the hips from the 13 that are free.
        spread = torch.zeros(15, 13, dtype=torch.float64)
        for column, joint in enumerate((0, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13)):
            spread[joint, column] = 1.0
        spread[1], spread[14] = (spread[2] + spread[5]) / 2, (spread[8] + spread[11]) / 2
        bones = torch.stack([spread[a] - spread[b] for a, b in BONES])
        rest = torch.full((13,), FLESH_SHARE, dtype=torch.float64)
        rest[[9, 12]] = ANKLE_SHARE
        for name, constant in (
            ("camera", torch.tensor(camera_m, dtype=torch.float64)),
            ("heights", torch.tensor(person_height_m, dtype=torch.float64)),
            ("spread", spread),
            ("bones", bones),
            ("length_of_bone", torch.tensor(LENGTH_OF_BONE)),
            ("shares", torch.tensor(LENGTH_SHARES, dtype=torch.float64)),
            ("rest", rest),
            ("ankle", rest == ANKLE_SHARE),
        ):
            self.register_buffer(name, constant, persistent=False)

    def forward(self, joints: Tensor, seen: Tensor, fps: float) -> Tensor:
        """Joints, which of them are seen and frame rate -> joints."""
        layout = "(..., P, T, 14, 3) joints in metres"
        check_floating(joints, "joints")
        check_min_rank(joints, 4, "joints", layout)
        check_size(joints, -2, 14, "joints", layout)
        check_size(joints, -1, 3, "joints", layout)
        if seen.dtype != torch.bool or seen.shape != joints.shape[:-1]:
            raise TensorsimError(
                f"seen: got {seen.dtype} of {list(seen.shape)}, expected bool of {list(joints.shape[:-1])}"
            )
        check_finite(joints, "joints")
        check_positive(fps, "fps")
        people, frames = joints.shape[-4], joints.shape[-3]
        if frames < 4 or joints.numel() == 0:
            return joints
        # Frames in which nothing is seen repeat the nearest one.
        valid = seen.any(dim=-1)
        source = nearest_valid(valid)[..., None, None].expand_as(joints)
        sight = joints.gather(-3, source).reshape(-1, frames, 14, 3).double() - self.camera
        distance = sight.square().sum(dim=-1).sqrt().clamp(min=1e-3)
        person = torch.arange(people, device=joints.device).clamp(max=self.heights.shape[0] - 1)
        tall = self.heights[person].expand(joints.shape[:-3]).reshape(-1)
        free = torch.cat([torch.arange(1, device=joints.device), torch.arange(2, 14, device=joints.device)])
        lines, given = (sight / distance[..., None]).index_select(2, free), distance.index_select(2, free)

        there = seen.reshape(-1, frames, 14).index_select(2, free)
        shake = jitter(lines.transpose(1, 2), there.transpose(1, 2), order=4).mean(dim=(1, 2))
        away = given.mean(dim=(1, 2))
        noise = 2 * shake * away
        across = away[:, None, None, None] * lines
        acceleration = expected_acceleration(
            across, shake * away, fps, self.acceleration, self.acceleration_ratio
        )
        stiff = F.pad((fps**2 / acceleration[:, 1:-1]).square(), [0, 0, 2, 2])
        base = (self.camera[2] - self.rest * tall[:, None])[:, None].expand_as(given)
        if not self.calibrated:
            base = base + 1e6  # no floor anywhere near
        height = torch.stack([base, lines[..., 2]], dim=-1)
        square = (fps / 2) ** 2 * (across[:, 2:] - across[:, :-2]).square().sum(dim=-1)  # of speeds
        square = torch.cat([square[:, :1], square, square[:, -1:]], dim=1)
        ankle_m2 = self.standing_m**2 + self.heel_s**2 * square
        footing = there / torch.where(self.ankle, ankle_m2, torch.full_like(ankle_m2, self.floor_m**2))
        ends = torch.matmul((~there).to(lines.dtype), (self.bones != 0).to(lines.dtype).t())
        hidden = self.hidden_m**2 * ends.clamp(max=1.0)
        clip = _Clip(lines, given, tall[:, None] * self.shares, height, stiff, footing, hidden)

        r, stretch, loose_m = given, torch.zeros_like(clip.shares), noise
        for slack in (90.0, 30.0, 9.0):
            loose_m = (noise.square() + (slack * self.bone_m) ** 2).sqrt()
            r, stretch = self._descend(clip, r, stretch, loose_m, self.steps[0])
        bone_m = (noise.square() + (3 * self.bone_m) ** 2).sqrt()
        r, stretch = self._descend(clip, r, stretch, bone_m, self.steps[1])
        cost = self._cost(clip, r, stretch, bone_m)
        for _ in range(self.rounds):
            lengths = clip.shares * stretch.exp()
            other = choose_branches(r, lines, lengths, given, self.trust, self.depth_m, height, fps)
            other, longer = self._descend(clip, other, stretch, loose_m, self.steps[0])
            other, longer = self._descend(clip, other, longer, bone_m, self.steps[1])
            other_cost = self._cost(clip, other, longer, bone_m)
            better = other_cost < cost
            if not is_exporting() and not bool(better.any()):
                break
            r = torch.where(better[:, None, None], other, r)
            stretch = torch.where(better[:, None], longer, stretch)
            cost = torch.where(better, other_cost, cost)
        bone_m = (noise.square() + self.bone_m**2).sqrt()
        r, _ = self._descend(clip, r, stretch, bone_m, 2 * self.steps[1])
        points = self.camera + torch.matmul(self.spread[:14], r[..., None] * lines)
        fitted = points.reshape(joints.shape).to(joints.dtype)
        return torch.where(valid[..., None, None], fitted, joints)

    def _bones(
        self, clip: _Clip, r: Tensor, stretch: Tensor, bone_m: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Directions (S, T, 12, 3) of bones, wanted lengths (S, 12), errors and their deviations (S, T, 12)."""
        vectors = torch.matmul(self.bones, r[..., None] * clip.lines)
        lengths = vectors.square().sum(dim=-1).clamp(min=1e-12).sqrt()
        wanted = (clip.shares * stretch.exp())[:, self.length_of_bone]
        deviation = (bone_m.square()[:, None, None] + clip.hidden).sqrt()
        return vectors / lengths[..., None], wanted, (lengths - wanted[:, None]) / deviation, deviation

    def _given(self, clip: _Clip, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Half the gradient (S, T, 13) and Hessian (S, T, 13, 13) of deviations from what is given, and cost (S)."""
        hips = self.spread[14]
        about = torch.eye(13, dtype=hips.dtype, device=hips.device) - hips
        off = torch.matmul(r - clip.given, torch.cat([about, hips[None]]).t())
        scale = torch.cat([torch.full_like(hips, self.depth_m), hips.new_full((1,), self.range_m)])
        square = (off / scale).square()
        weight = self.trust / scale.square() / (1 + square)  # Gauss-Newton's, as reweighted least squares
        rows = torch.cat([about, hips[None]])
        blocks = torch.matmul(rows.t(), weight[..., None] * rows)
        return torch.matmul(weight * off, rows), blocks, self.trust * torch.log1p(square).sum(dim=(1, 2))

    def _floor(self, clip: _Clip, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Half the gradient and the diagonal of the Hessian (S, T, 13) of joints against the floor, and cost (S)."""
        over = clip.height[..., 0] + clip.height[..., 1] * r
        square = (over / self.floor_reach_m).square()
        # Geman and McClure's for the lowest joint, as who jumps rests on none; nothing for others unless they sink.
        lowest = F.one_hot(over.argmin(dim=-1), 13) * clip.footing
        sunk = ((over < 0) & (clip.footing > 0)).to(r.dtype) / self.floor_m**2
        weight = lowest / (1 + square).square() + sunk
        loss = lowest * self.floor_reach_m**2 * square / (1 + square) + sunk * over.square()
        slope = clip.height[..., 1]
        return weight * over * slope, weight * slope.square(), loss.sum(dim=(1, 2))

    def _cost(self, clip: _Clip, r: Tensor, stretch: Tensor, bone_m: Tensor) -> Tensor:
        bend = (r[:, 2:] - 2 * r[:, 1:-1] + r[:, :-2]).square() * clip.stiff[:, 2:-2]
        error = self._bones(clip, r, stretch, bone_m)[2]
        cost = error.square().sum(dim=(1, 2)) + bend.sum(dim=(1, 2)) + self._given(clip, r)[2]
        cost = cost + (stretch / self.length_share).square().sum(dim=1)
        return cost + self._floor(clip, r)[2] if self.calibrated else cost

    def _descend(
        self, clip: _Clip, r: Tensor, stretch: Tensor, bone_m: Tensor, steps: int
    ) -> tuple[Tensor, Tensor]:
        """Distances and logarithms of relative lengths after steps of Levenberg-Marquardt."""
        tracks, frames = r.shape[0], r.shape[1]
        pairs = (frames + 1) // 2
        eye = torch.eye(13, dtype=r.dtype, device=r.device)
        # Second differences: what a frame has to do with itself, the next and the one after.
        stiff = F.pad(clip.stiff, [0, 0, 0, 2 * pairs - frames])
        own = stiff[:, :-2] + 4 * stiff[:, 1:-1] + stiff[:, 2:]
        own, next_two = own[:, : 2 * pairs], stiff[:, 2:]
        next_one = -2 * (stiff[:, 1:-1] + next_two)
        within = torch.diag_embed(next_one[:, 0::2])
        corner = torch.diag_embed(next_two[:, 0 : 2 * pairs - 2 : 2])
        beside = torch.diag_embed(next_one[:, 1 : 2 * pairs - 2 : 2])
        below = torch.cat(
            [
                torch.cat([corner, beside], dim=-1),
                torch.cat(
                    [torch.zeros_like(corner), torch.diag_embed(next_two[:, 1 : 2 * pairs - 2 : 2])], dim=-1
                ),
            ],
            dim=-2,
        )
        # What each bone has to do with the lengths.
        owner = F.one_hot(self.length_of_bone, 8).to(r.dtype)
        damping = torch.ones(tracks, dtype=r.dtype, device=r.device)
        cost = self._cost(clip, r, stretch, bone_m)
        for _ in range(steps):
            directions, wanted, error, deviation = self._bones(clip, r, stretch, bone_m)
            along = torch.matmul(directions, clip.lines.transpose(-1, -2))
            slope = along * self.bones / deviation[..., None]  # of errors by distances, (S, T, 12, 13)
            by_length = -(wanted[:, None] / deviation)[..., None] * owner  # (S, T, 12, 8)

            bend = (r[:, 2:] - 2 * r[:, 1:-1] + r[:, :-2]) * clip.stiff[:, 2:-2]
            force = F.pad(bend, [0, 0, 2, 0]) - 2 * F.pad(bend, [0, 0, 1, 1]) + F.pad(bend, [0, 0, 0, 2])
            force = force + torch.matmul(slope.transpose(-1, -2), error[..., None])[..., 0]
            pull, blocks, _ = self._given(clip, r)
            force = force + pull
            blocks = blocks + torch.matmul(slope.transpose(-1, -2), slope)
            if self.calibrated:
                push_up, firm, _ = self._floor(clip, r)
                force, blocks = force + push_up, blocks + torch.diag_embed(firm)
            cross = torch.matmul(slope.transpose(-1, -2), by_length)
            right = torch.cat([-force[..., None], -cross], dim=-1)
            if frames % 2 == 1:  # a frame of its own fills the last pair
                blocks = torch.cat([blocks, eye.expand(tracks, 1, 13, 13)], dim=1)
                right = torch.cat([right, torch.zeros_like(right[:, :1])], dim=1)
            blocks = blocks + torch.diag_embed(own) + 250.0 * damping[:, None, None, None] * eye
            diagonal = torch.cat(
                [
                    torch.cat([blocks[:, 0::2], within], dim=-1),
                    torch.cat([within, blocks[:, 1::2]], dim=-1),
                ],
                dim=-2,
            )
            solved = solve_block_tridiagonal(diagonal, below, right.reshape(tracks, pairs, 26, 9))
            solved = solved.reshape(tracks, 2 * pairs, 13, 9)[:, :frames]
            # The lengths, then the distances given the lengths.
            push = torch.matmul(by_length.transpose(-1, -2), error[..., None])[..., 0].sum(dim=1)
            push = push + stretch / self.length_share**2
            firmness = torch.matmul(by_length.transpose(-1, -2), by_length).sum(dim=1)
            firmness = firmness + (1 / self.length_share**2 + 1e3 * damping[:, None, None]) * torch.eye(
                8, dtype=r.dtype, device=r.device
            )
            cross = cross.flatten(1, 2).transpose(-1, -2)
            flat = solved.flatten(1, 2)
            schur = firmness + torch.matmul(cross, flat[..., 1:])
            longer = torch.linalg.solve(schur, -(push + torch.matmul(cross, flat[..., :1])[..., 0]))
            step = solved[..., 0] + torch.matmul(flat[..., 1:], longer[..., None])[..., 0].reshape(r.shape)
            next_r, next_stretch = r + step, stretch + longer
            next_cost = self._cost(clip, next_r, next_stretch, bone_m)
            better = next_cost < cost
            r = torch.where(better[:, None, None], next_r, r)
            stretch = torch.where(better[:, None], next_stretch, stretch)
            cost = torch.where(better, next_cost, cost)
            damping = torch.where(better, (damping / 6).clamp(min=1e-6), damping * 5)
        return r, stretch
