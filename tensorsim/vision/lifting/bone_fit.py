"""Depths of joints from bones that keep their length.

A visible joint lies on its line of sight; one camera does not give its distance. But bones do not stretch, limbs of
both sides are equally long, accelerations are limited and nobody is below the floor. The most likely distances
under these (C. J. Taylor, "Reconstruction of articulated objects from point correspondences in a single uncalibrated
image", 2000, from a single frame) are a sparse least-squares problem over the clip:
:mod:`tensorsim.vision.lifting.bone_cost`. The expected acceleration of a joint along its line of sight is derived from
its acceleration across it and from that of the whole body. A standing foot rests to within 2 mm, a moving one may have
its heel up. Hidden joints hardly count for bones, and not for the floor: they stay near where the lifter placed them.

Levenberg-Marquardt from the lifter's distances finds a local minimum. There are many, one for each bone that may point
towards the camera or away from it; :func:`tensorsim.vision.lifting.bone_branches.choose_branches` proposes others as
long as that lowers the cost.

Made for keypoints that are exact except for noise that is independent from frame to frame, such as labels or markers.
Errors of networks last for seconds, and distort depths more than this corrects.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.body.proportions import ANKLE_HEIGHT, FLESH
from tensorsim.errors import (
    check_finite,
    check_mask,
    check_per_person,
    check_points,
    check_positive,
    is_exporting,
)
from tensorsim.ops import of_person
from tensorsim.vision.lifting.bone_branches import choose_branches
from tensorsim.vision.lifting.bone_cost import (
    FREE_JOINTS,
    LENGTH_SHARES,
    BoneClip,
    BoneCost,
    expected_acceleration,
)
from tensorsim.vision.lifting.bone_descent import BoneDescent
from tensorsim.vision.smoothing.along_time import nearest_valid
from tensorsim.vision.smoothing.noise import jitter


class BoneFit(nn.Module):
    """Refines the distances of joints along their lines of sight, so that bones keep their length.

    Args:
        camera_m: (3,) position of the camera.
        person_height_m: standing heights in the order of the people; the last one applies to all further people.
        calibrated: whether height and tilt of the camera are known well, so that the floor determines distances.
        bone_m: standard deviation of the lengths of a bone over time, besides the noise of the keypoints.
        length_share: relative deviation of bodies from mean proportions.
        acceleration_m_s2: expected acceleration of joints that rest in the image.
        acceleration_ratio: see :func:`~tensorsim.vision.lifting.bone_cost.expected_acceleration`.
        depth_m: standard deviation of the given depths relative to the hips.
        range_m: standard deviation of the given distance of the hips.
        trust: weight of the given distances; below 1, as their errors are correlated between frames.
        floor_m: standard deviation of the height of the lowest joint over the floor; for ankles see ``standing_m``.
        steps: Levenberg-Marquardt steps while bones may still stretch considerably, and once they no longer may.
        rounds: largest number of times that other branches are tried.

    Shapes:
        joints (..., P, T, 14, 3) in world metres, seen (..., P, T, 14) bool and frames per second -> joints, moved
        along their lines of sight; the neck is placed in the middle of the shoulders. Frames in which nothing is
        seen and clips of fewer than 4 frames are unchanged. Computed in float64. Differentiable with respect to
        joints, except for the choice of branches.

    Raises:
        TensorsimError: settings that are not positive, wrong shapes, NaN.
    """

    camera: Tensor
    heights: Tensor
    shares: Tensor
    rest: Tensor
    ankle: Tensor
    free: Tensor

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
        ):
            check_positive(value, f"BoneFit.{name}")
        check_per_person(person_height_m, "BoneFit.person_height_m")
        self.cost = BoneCost(length_share, depth_m, range_m, trust, floor_m, calibrated)
        self.descent = BoneDescent(self.cost)
        self.bone_m, self.steps, self.rounds, self.calibrated = bone_m, steps, rounds, calibrated
        self.acceleration, self.acceleration_ratio = acceleration_m_s2, acceleration_ratio
        self.standing_m, self.heel_s = 0.002, 0.02  # deviation of ankles that rest, and its increase per m/s
        self.hidden_m = 0.1  # deviation of bones to hidden joints
        ankle = torch.tensor([joint in (10, 13) for joint in FREE_JOINTS])
        for name, constant in (
            ("camera", torch.tensor(camera_m, dtype=torch.float64)),
            ("heights", torch.tensor(person_height_m, dtype=torch.float64)),
            ("shares", torch.tensor(LENGTH_SHARES, dtype=torch.float64)),
            ("rest", torch.where(ankle, ANKLE_HEIGHT, FLESH).double()),
            ("ankle", ankle),
            ("free", torch.tensor(FREE_JOINTS)),
        ):
            self.register_buffer(name, constant, persistent=False)

    def forward(self, joints: Tensor, seen: Tensor, fps: float) -> Tensor:
        """Joints, which of them are seen and frame rate -> joints."""
        check_points(joints, 4, 14, 3, "joints", "(..., P, T, 14, 3) joints in metres")
        check_mask(seen, list(joints.shape[:-1]), "seen")
        check_finite(joints, "joints")
        check_positive(fps, "fps")
        if joints.shape[-3] < 4 or joints.numel() == 0:
            return joints
        # Frames in which nothing is seen repeat the nearest one.
        valid = seen.any(dim=-1)
        source = nearest_valid(valid)[..., None, None].expand_as(joints)
        clip, noise = self._clip(joints.gather(-3, source), seen, fps)
        r = self._distances(clip, noise, fps)
        points = self.camera + torch.matmul(self.cost.spread[:14], r[..., None] * clip.lines)
        fitted = points.reshape(joints.shape).to(joints.dtype)
        return torch.where(valid[..., None, None], fitted, joints)

    def _clip(self, joints: Tensor, seen: Tensor, fps: float) -> tuple[BoneClip, Tensor]:
        """What is known about S people, and the standard deviation (S) in m of the noise of their bones."""
        people, frames = joints.shape[-4], joints.shape[-3]
        sight = joints.reshape(-1, frames, 14, 3).double() - self.camera
        distance = sight.square().sum(dim=-1).sqrt().clamp(min=1e-3)
        tall = of_person(self.heights, torch.arange(people, device=joints.device))
        tall = tall.expand(joints.shape[:-3]).reshape(-1)
        lines = (sight / distance[..., None]).index_select(2, self.free)
        given = distance.index_select(2, self.free)
        visible = seen.reshape(-1, frames, 14).index_select(2, self.free)

        angle = jitter(lines.transpose(1, 2), visible.transpose(1, 2), order=4).mean(dim=(1, 2))
        mean_distance = given.mean(dim=(1, 2))
        noise = angle * mean_distance
        across = mean_distance[:, None, None, None] * lines
        acceleration = expected_acceleration(across, noise, fps, self.acceleration, self.acceleration_ratio)
        stiffness = F.pad((fps**2 / acceleration[:, 1:-1]).square(), [0, 0, 2, 2])
        base = (self.camera[2] - self.rest * tall[:, None])[:, None].expand_as(given)
        if not self.calibrated:
            base = base + 1e6  # no floor anywhere near
        height = torch.stack([base, lines[..., 2]], dim=-1)
        square_speed = (fps / 2) ** 2 * (across[:, 2:] - across[:, :-2]).square().sum(dim=-1)
        square_speed = torch.cat([square_speed[:, :1], square_speed, square_speed[:, -1:]], dim=1)
        ankle_m2 = self.standing_m**2 + self.heel_s**2 * square_speed
        other_m2 = torch.full_like(ankle_m2, self.cost.floor_m**2)
        footing = visible / torch.where(self.ankle, ankle_m2, other_m2)
        ends = torch.matmul((~visible).to(lines.dtype), (self.cost.bones != 0).to(lines.dtype).t())
        hidden = self.hidden_m**2 * ends.clamp(max=1.0)
        lengths = tall[:, None] * self.shares
        return BoneClip(lines, given, lengths, height, stiffness, footing, hidden), 2 * noise

    def _distances(self, clip: BoneClip, noise: Tensor, fps: float) -> Tensor:
        """The most likely distances (S, T, 13)."""
        r, stretch, loose_m = clip.given, torch.zeros_like(clip.lengths), noise
        for slack in (90.0, 30.0, 9.0):
            loose_m = (noise.square() + (slack * self.bone_m) ** 2).sqrt()
            r, stretch = self.descent(clip, r, stretch, loose_m, self.steps[0])
        bone_m = (noise.square() + (3 * self.bone_m) ** 2).sqrt()
        r, stretch = self.descent(clip, r, stretch, bone_m, self.steps[1])
        cost = self.cost(clip, r, stretch, bone_m)
        for _ in range(self.rounds):
            lengths = clip.lengths * stretch.exp()
            other = choose_branches(
                r, clip.lines, lengths, clip.given, self.cost.trust, self.cost.depth_m, clip.height, fps
            )
            other, other_stretch = self.descent(clip, other, stretch, loose_m, self.steps[0])
            other, other_stretch = self.descent(clip, other, other_stretch, bone_m, self.steps[1])
            other_cost = self.cost(clip, other, other_stretch, bone_m)
            better = other_cost < cost
            if not is_exporting() and not bool(better.any()):
                break
            r = torch.where(better[:, None, None], other, r)
            stretch = torch.where(better[:, None], other_stretch, stretch)
            cost = torch.where(better, other_cost, cost)
        bone_m = (noise.square() + self.bone_m**2).sqrt()
        r, _ = self.descent(clip, r, stretch, bone_m, 2 * self.steps[1])
        return r
