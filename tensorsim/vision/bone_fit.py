"""Depths of joints from bones that keep their length.

A joint that is seen lies on its line of sight; how far along it is what one camera does not tell. But bones do not
stretch, both arms and legs are of a size, and limbs do not jerk. The most likely depths under these (C. J. Taylor,
"Reconstruction of articulated objects from point correspondences in a single uncalibrated image", 2000, who takes
them from a single frame) are a sparse least-squares problem over the clip. With r(t, j) the distance of joint j from
the camera, r' what the lifter says, h the same of the middle of the hips, and unknown bone lengths L:

    sum over t  sum over bones (|Xa - Xb| - L)^2 / sb^2  +  |r(t-1) - 2 r(t) + r(t+1)|^2 / (sa dt^2)^2
                + |(r - h) - (r' - h')|^2 / sl^2  +  (h - h')^2 / sh^2      + sum over lengths log(L / L0)^2 / sL^2

and, where height and tilt of the camera are known, the lower ankle near the height at which it stands.

Levenberg-Marquardt from r'; its normal equations couple a frame to the two before it and are solved frame pair by
frame pair, so the work grows with the length of the clip and no faster.

Made for keypoints that are exact but for noise that differs from frame to frame: labelled ones, markers. Networks are
off by the same few pixels for seconds, which bends depths more than it mends them.
"""

import torch
from torch import Tensor, nn

from tensorsim.errors import (
    TensorsimError,
    check_finite,
    check_floating,
    check_min_rank,
    check_positive,
    check_size,
)
from tensorsim.vision.along_time import masked_median, nearest_valid

#: Bones by their ends; 14 is the middle of the hips. The neck, joint 1, is the middle of the shoulders.
BONES = (
    (0, 1), (2, 5), (2, 3), (3, 4), (5, 6), (6, 7), (8, 11), (8, 9), (9, 10), (11, 12), (12, 13), (1, 14),
)  # fmt: skip
#: Which length each bone has: left and right limbs are of a size.
LENGTH_OF_BONE = (0, 1, 2, 3, 2, 3, 4, 5, 6, 5, 6, 7)
#: Height of the ankle over the floor as a share of the standing height (Winter, after Drillis and Contini).
ANKLE_SHARE = 0.039
#: Neck to nose, shoulders, upper arm, forearm, hips, thigh, shank and trunk likewise; hips and nose are those of
#: ``tensorsim.motion.body``.
LENGTH_SHARES = (0.125, 0.210, 0.186, 0.146, 0.122, 0.2455, 0.2455, 0.288)


def solve_block_tridiagonal(diagonal: Tensor, below: Tensor, right: Tensor) -> Tensor:
    """Solve ``A x = right`` for symmetric positive definite, block tridiagonal A by its Cholesky factors.

    Args:
        diagonal: (..., K, n, n) blocks on the diagonal.
        below: (..., K - 1, n, n) blocks under it: rows of k + 1, columns of k.
        right: (..., K, n, c).

    Returns:
        (..., K, n, c). Differentiable.
    """
    blocks = diagonal.shape[-3]
    factors: list[Tensor] = []
    ties: list[Tensor] = []
    halfway: list[Tensor] = []
    for k in range(blocks):
        block, y = diagonal[..., k, :, :], right[..., k, :, :]
        if k > 0:
            block = block - torch.matmul(ties[k - 1], ties[k - 1].transpose(-1, -2))
            y = y - torch.matmul(ties[k - 1], halfway[k - 1])
        factor = torch.linalg.cholesky(block)
        factors.append(factor)
        halfway.append(torch.linalg.solve_triangular(factor, y, upper=False))
        if k < blocks - 1:
            tie = torch.linalg.solve_triangular(factor, below[..., k, :, :].transpose(-1, -2), upper=False)
            ties.append(tie.transpose(-1, -2))
    x: list[Tensor] = []
    for i in range(blocks):
        k = blocks - 1 - i
        y = halfway[k]
        if i > 0:
            y = y - torch.matmul(ties[k].transpose(-1, -2), x[i - 1])
        x.append(torch.linalg.solve_triangular(factors[k].transpose(-1, -2), y, upper=True))
    x.reverse()
    return torch.stack(x, dim=-3)


def jitter(x: Tensor, valid: Tensor) -> Tensor:
    """Standard deviation of the noise of tracks, from their fourth differences.

    White noise of variance s^2 has fourth differences of variance 70 s^2; movement has next to none. Their median
    is taken, so that moments of fast movement do not count.

    Args:
        x: (..., T, D).
        valid: (..., T) bool.

    Returns:
        (..., D); 0 where there are not 5 valid frames in a row.
    """
    if x.shape[-2] < 5:
        return x.new_zeros(x.shape[:-2] + x.shape[-1:])
    d = x[..., 4:, :] - 4 * x[..., 3:-1, :] + 6 * x[..., 2:-2, :] - 4 * x[..., 1:-3, :] + x[..., :-4, :]
    whole = valid[..., 4:] & valid[..., 3:-1] & valid[..., 2:-2] & valid[..., 1:-3] & valid[..., :-4]
    d, whole = d.abs().transpose(-1, -2), whole.unsqueeze(-2)
    return 1.4826 / 70**0.5 * masked_median(d, whole.expand_as(d))[..., 0]


class BoneFit(nn.Module):
    """Refines how far joints are along their lines of sight, so that bones keep their length.

    Args:
        camera_m: (3,) position of the camera.
        person_height_m: standing heights by order of person; the last one serves all further people.
        calibrated: height and tilt of the camera are known well: then feet on the floor tell how far they are.
        bone_m: deviation of bones from their length that counts as one, besides the noise of the keypoints.
        length_share: relative deviation of bodies from ``LENGTH_SHARES``.
        acceleration_m_s2: typical acceleration of joints.
        depth_m: deviation of the given depths about the hips, for each frame as if it were alone.
        range_m: the same of the hips.
        floor_m: deviation of the lower ankle from its height over the floor.
        steps: of Levenberg-Marquardt; the first ones let bones stretch more, to find the way.

    Shape:
        joints (..., P, T, 14, 3) in world metres, valid (..., P, T) bool and frames per second -> joints, moved
        along their lines of sight; the neck comes out in the middle of the shoulders. Invalid frames and clips of
        fewer than 4 frames stay. Computed in float64. Differentiable by joints.

    Raises:
        TensorsimError: settings that are not positive, wrong shapes, NaN.
    """

    camera: Tensor
    heights: Tensor
    spread: Tensor
    bones: Tensor
    length_of_bone: Tensor
    shares: Tensor

    def __init__(
        self,
        camera_m: tuple[float, float, float] = (0.0, 0.0, 1.5),
        person_height_m: tuple[float, ...] = (1.80, 1.70),
        calibrated: bool = False,
        bone_m: float = 0.001,
        length_share: float = 0.04,
        acceleration_m_s2: float = 40.0,
        depth_m: float = 0.1,
        range_m: float = 0.3,
        floor_m: float = 0.005,
        steps: tuple[int, int, int] = (6, 6, 10),
    ) -> None:
        super().__init__()
        for name, value in (
            ("bone_m", bone_m),
            ("length_share", length_share),
            ("acceleration_m_s2", acceleration_m_s2),
            ("depth_m", depth_m),
            ("range_m", range_m),
            ("floor_m", floor_m),
            *((f"person_height_m[{i}]", height) for i, height in enumerate(person_height_m)),
        ):
            check_positive(value, f"BoneFit.{name}")
        if len(person_height_m) == 0:
            raise TensorsimError("BoneFit.person_height_m: got no values, expected one per person")
        self.bone_m, self.length_share, self.acceleration = bone_m, length_share, acceleration_m_s2
        self.depth_m, self.range_m, self.floor_m, self.steps = depth_m, range_m, floor_m, steps
        self.calibrated = calibrated
        self.ankle_share = ANKLE_SHARE
        self.floor_reach_m = 0.03  # an ankle further off the floor than this is likely off it
        # All 14 joints and the middle of the hips from the 13 that are free.
        spread = torch.zeros(15, 13, dtype=torch.float64)
        for column, joint in enumerate((0, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13)):
            spread[joint, column] = 1.0
        spread[1], spread[14] = (spread[2] + spread[5]) / 2, (spread[8] + spread[11]) / 2
        bones = torch.stack([spread[a] - spread[b] for a, b in BONES])
        for name, constant in (
            ("camera", torch.tensor(camera_m, dtype=torch.float64)),
            ("heights", torch.tensor(person_height_m, dtype=torch.float64)),
            ("spread", spread),
            ("bones", bones),
            ("length_of_bone", torch.tensor(LENGTH_OF_BONE)),
            ("shares", torch.tensor(LENGTH_SHARES, dtype=torch.float64)),
        ):
            self.register_buffer(name, constant, persistent=False)

    def forward(self, joints: Tensor, valid: Tensor, fps: float) -> Tensor:
        """Joints, valid frames and frame rate -> joints."""
        layout = "(..., P, T, 14, 3) joints in metres"
        check_floating(joints, "joints")
        check_min_rank(joints, 4, "joints", layout)
        check_size(joints, -2, 14, "joints", layout)
        check_size(joints, -1, 3, "joints", layout)
        if valid.dtype != torch.bool or valid.shape != joints.shape[:-2]:
            raise TensorsimError(
                f"valid: got {valid.dtype} of {list(valid.shape)}, expected bool of {list(joints.shape[:-2])}"
            )
        check_finite(joints, "joints")
        check_positive(fps, "fps")
        people, frames = joints.shape[-4], joints.shape[-3]
        if frames < 4 or joints.numel() == 0:
            return joints
        # Invalid frames repeat the nearest valid one.
        source = nearest_valid(valid)[..., None, None].expand_as(joints)
        sight = joints.gather(-3, source).reshape(-1, frames, 14, 3).double() - self.camera
        distance = sight.square().sum(dim=-1).sqrt().clamp(min=1e-3)
        lines = sight / distance[..., None]
        person = torch.arange(people, device=joints.device).clamp(max=self.heights.shape[0] - 1)
        tall = self.heights[person].expand(joints.shape[:-3]).reshape(-1)
        free = torch.cat([torch.arange(1, device=joints.device), torch.arange(2, 14, device=joints.device)])
        lines, given = lines.index_select(2, free), distance.index_select(2, free)

        there = valid.reshape(-1, 1, frames)
        shake = jitter(lines.transpose(1, 2), there.expand(-1, 13, -1)).mean(dim=(1, 2))
        noise = 2 * shake * given.mean(dim=(1, 2))
        r = given
        stretch = torch.zeros(given.shape[0], 8, dtype=given.dtype, device=given.device)
        for stage in range(3):
            slack = (10.0, 3.0, 1.0)[stage]
            bone_m = (noise.square() + (slack * self.bone_m) ** 2).sqrt()
            r, stretch = self._descend(lines, given, tall, fps, r, stretch, bone_m, self.steps[stage])
        points = self.camera + torch.matmul(self.spread[:14], r[..., None] * lines)
        fitted = points.reshape(joints.shape).to(joints.dtype)
        return torch.where(valid[..., None, None], fitted, joints)

    def _errors(
        self, lines: Tensor, tall: Tensor, r: Tensor, stretch: Tensor, bone_m: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Bone vectors (S, T, 12, 3), their lengths (S, T, 12) and errors of these in units of ``bone_m`` (S)."""
        vectors = torch.matmul(self.bones, r[..., None] * lines)
        lengths = vectors.square().sum(dim=-1).clamp(min=1e-12).sqrt()
        wanted = (tall[:, None] * self.shares * stretch.exp())[:, self.length_of_bone]
        return vectors, lengths, (lengths - wanted[:, None]) / bone_m[:, None, None]

    def _over_floor(self, lines: Tensor, tall: Tensor, r: Tensor) -> tuple[Tensor, Tensor]:
        """Which of the 13 joints is the lower ankle (S, T), and how far it is above where it stands (S, T)."""
        ankles = torch.stack([r[..., 9] * lines[..., 9, 2], r[..., 12] * lines[..., 12, 2]], dim=-1)
        over = ankles + (self.camera[2] - self.ankle_share * tall[:, None, None])
        lower, side = over.min(dim=-1)
        return 9 + 3 * side, lower

    def _prior(self) -> Tensor:
        """Weight (13, 13) of deviations from the given distances."""
        hips = self.spread[14]
        about = torch.eye(13, dtype=hips.dtype, device=hips.device) - hips
        return torch.matmul(about.t(), about) / self.depth_m**2 + torch.outer(hips, hips) / self.range_m**2

    def _cost(
        self,
        lines: Tensor,
        given: Tensor,
        tall: Tensor,
        fps: float,
        r: Tensor,
        stretch: Tensor,
        bone_m: Tensor,
    ) -> Tensor:
        error = self._errors(lines, tall, r, stretch, bone_m)[2]
        off = r - given
        bend = (r[:, 2:] - 2 * r[:, 1:-1] + r[:, :-2]) * (fps**2 / self.acceleration)
        prior = (torch.matmul(off, self._prior()) * off).sum(dim=(1, 2))
        lengths = (stretch / self.length_share).square().sum(dim=1)
        if self.calibrated:  # Geman and McClure's: who jumps or lies does not stand on an ankle
            square = self._over_floor(lines, tall, r)[1].square() / self.floor_reach_m**2
            prior = prior + (self.floor_reach_m / self.floor_m) ** 2 * (square / (1 + square)).sum(dim=1)
        return error.square().sum(dim=(1, 2)) + bend.square().sum(dim=(1, 2)) + prior + lengths

    def _descend(
        self,
        lines: Tensor,
        given: Tensor,
        tall: Tensor,
        fps: float,
        r: Tensor,
        stretch: Tensor,
        bone_m: Tensor,
        steps: int,
    ) -> tuple[Tensor, Tensor]:
        tracks, frames = r.shape[0], r.shape[1]
        pairs = (frames + 1) // 2
        eye = torch.eye(13, dtype=r.dtype, device=r.device)
        # Second differences: what a frame has to do with itself, the next and the one after.
        weight = (fps**2 / self.acceleration) ** 2
        kernel = torch.zeros(2 * pairs + 4, dtype=r.dtype, device=r.device)
        kernel[2:frames] = weight  # of the difference that ends in frame t, at t
        own = kernel[0 : 2 * pairs] + 4 * kernel[1 : 2 * pairs + 1] + kernel[2 : 2 * pairs + 2]
        next_one = -2 * (kernel[1 : 2 * pairs + 1] + kernel[2 : 2 * pairs + 2])
        next_two = kernel[2 : 2 * pairs + 2]
        below = torch.zeros(pairs - 1, 26, 26, dtype=r.dtype, device=r.device)
        below[:, :13, :13] = next_two[0 : 2 * pairs - 2 : 2, None, None] * eye
        below[:, :13, 13:] = next_one[1 : 2 * pairs - 2 : 2, None, None] * eye
        below[:, 13:, 13:] = next_two[1 : 2 * pairs - 2 : 2, None, None] * eye
        within = next_one[0 : 2 * pairs : 2, None, None] * eye
        prior = self._prior()
        # What each bone has to do with the lengths.
        owner = torch.nn.functional.one_hot(self.length_of_bone, 8).to(r.dtype)
        damping = torch.ones(tracks, dtype=r.dtype, device=r.device)
        cost = self._cost(lines, given, tall, fps, r, stretch, bone_m)
        for _ in range(steps):
            vectors, lengths, error = self._errors(lines, tall, r, stretch, bone_m)
            along = torch.matmul(vectors / lengths[..., None], lines.transpose(-1, -2))
            slope = along * self.bones / bone_m[:, None, None, None]  # of errors by distances, (S, T, 12, 13)
            wanted = (tall[:, None] * self.shares * stretch.exp())[:, self.length_of_bone]
            by_length = -(wanted / bone_m[:, None])[..., None] * owner  # (S, 12, 8)

            bend = (r[:, 2:] - 2 * r[:, 1:-1] + r[:, :-2]) * weight
            zero = torch.zeros_like(r[:, :1])
            force = torch.cat([zero, zero, bend], 1) + torch.cat([bend, zero, zero], 1)
            force = force - 2 * torch.cat([zero, bend, zero], 1)
            force = force + torch.matmul(slope.transpose(-1, -2), error[..., None])[..., 0]
            force = force + torch.matmul(r - given, prior)
            blocks = torch.matmul(slope.transpose(-1, -2), slope) + prior
            cross = torch.matmul(slope.transpose(-1, -2), by_length[:, None])
            if self.calibrated:
                ankle, over = self._over_floor(lines, tall, r)
                stands = torch.nn.functional.one_hot(ankle, 13).to(r.dtype) * lines[..., 2]
                trust = (1 + over.square() / self.floor_reach_m**2) ** -2 / self.floor_m**2
                force = force + stands * (trust * over)[..., None]
                blocks = blocks + torch.diag_embed(stands.square() * trust[..., None])
            right = torch.cat([-force[..., None], -cross], dim=-1)
            if frames % 2 == 1:  # a frame of its own fills the last pair
                blocks = torch.cat([blocks, eye.expand(tracks, 1, 13, 13)], dim=1)
                right = torch.cat([right, torch.zeros_like(right[:, :1])], dim=1)
            blocks = blocks + (own[:, None, None] + 250.0 * damping[:, None, None, None]) * eye
            diagonal = torch.cat(
                [
                    torch.cat([blocks[:, 0::2], within.expand(tracks, -1, -1, -1)], dim=-1),
                    torch.cat([within.expand(tracks, -1, -1, -1), blocks[:, 1::2]], dim=-1),
                ],
                dim=-2,
            )
            solved = solve_block_tridiagonal(
                diagonal, below.expand(tracks, -1, -1, -1), right.reshape(tracks, pairs, 26, 9)
            ).reshape(tracks, 2 * pairs, 13, 9)[:, :frames]
            # The lengths, then the distances given the lengths.
            push = torch.matmul(by_length.transpose(-1, -2), error.sum(dim=1)[..., None])[..., 0]
            push = push + stretch / self.length_share**2
            stiff = frames * torch.matmul(by_length.transpose(-1, -2), by_length)
            stiff = stiff + (1 / self.length_share**2 + 1e3 * damping[:, None, None]) * torch.eye(
                8, dtype=r.dtype, device=r.device
            )
            cross = cross.flatten(1, 2).transpose(-1, -2)
            flat = solved.flatten(1, 2)
            schur = stiff + torch.matmul(cross, flat[..., 1:])
            longer = torch.linalg.solve(schur, -(push + torch.matmul(cross, flat[..., :1])[..., 0]))
            step = solved[..., 0] + torch.matmul(flat[..., 1:], longer[..., None])[..., 0].reshape(r.shape)
            next_r, next_stretch = r + step, stretch + longer
            next_cost = self._cost(lines, given, tall, fps, next_r, next_stretch, bone_m)
            better = next_cost < cost
            r = torch.where(better[:, None, None], next_r, r)
            stretch = torch.where(better[:, None], next_stretch, stretch)
            cost = torch.where(better, next_cost, cost)
            damping = torch.where(better, (damping / 6).clamp(min=1e-6), damping * 5)
        return r, stretch
