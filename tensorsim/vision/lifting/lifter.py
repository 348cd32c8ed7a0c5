"""Nearest-match lifting: 3D poses for 2D joints, from a pool of 3D poses projected along depth.

Every pose of the pool is projected along depth and compared with the joints in the image after both are
centred and scaled to unit size, as the paper does; here with a weight per joint, so that hidden joints do
not count.
"""

import copy
import math

import torch
from torch import Tensor, nn

from tensorsim.config import JOINTS
from tensorsim.errors import (
    TensorsimError,
    check_count,
    check_finite,
    check_not_negative,
    check_points,
    check_positive,
    check_shape,
    is_exporting,
)
from tensorsim.types import Lifted
from tensorsim.vision.lifting.pose_library import load_pose_library, standardise_poses
from tensorsim.vision.lifting.pose_search import PoseSearch, normalise_weights
from tensorsim.vision.smoothing.along_time import nearest_valid


def fit_poses(keypoints: Tensor, weights: Tensor, poses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Scale and translation that place poses in the image, and how well they then fit.

    Args:
        keypoints: (..., 14, 2) pixels.
        weights: (..., 14), not negative.
        poses: (..., 14, 3) body heights; leading dimensions broadcast.

    Returns:
        scale (...) pixels per body height, the placed joints (..., 14, 2) pixels, and the distance (...): the
        weighted squared error over that of the best single point, 0 for a perfect fit, 1 for none.
    """
    w = normalise_weights(weights)[..., None]
    projected = torch.stack([poses[..., 0], -poses[..., 2]], dim=-1)
    centre, middle = (w * keypoints).sum(dim=-2, keepdim=True), (w * projected).sum(dim=-2, keepdim=True)
    k, p = keypoints - centre, projected - middle
    kk, pp = (w * k.square()).sum(dim=(-2, -1)), (w * p.square()).sum(dim=(-2, -1)).clamp(min=1e-6)
    scale = (w * k * p).sum(dim=(-2, -1)).clamp(min=0.0) / pp
    placed = centre + scale[..., None, None] * p
    distance = (w * (keypoints - placed).square()).sum(dim=(-2, -1)) / kk.clamp(min=1e-12)
    return scale, placed, distance


def check_to_lift(keypoints: Tensor, weights: Tensor) -> None:
    """Refuse joints (..., T, 14, 2) and weights (..., T, 14) that no lifter accepts.

    Raises:
        TensorsimError: other shapes, NaN, negative weights, or no frames.
    """
    check_points(keypoints, 3, 14, 2, "keypoints", "(..., T, 14, 2) joints in pixels")
    check_shape(weights, list(keypoints.shape[:-1]), "weights")
    if keypoints.shape[-3] < 1:
        raise TensorsimError(f"keypoints: got shape {list(keypoints.shape)}, expected at least 1 frame")
    check_finite(keypoints, "keypoints")
    check_finite(weights, "weights")
    if not is_exporting() and bool((weights < 0).any()):
        raise TensorsimError("weights: got negative values, expected weights >= 0")


def rolled(keypoints: Tensor, angle: float) -> Tensor:
    """Pixels (..., 2) turned clockwise (u right, v down) by ``angle`` in radians about the origin of the picture."""
    if angle == 0.0:
        return keypoints
    cos, sin = math.cos(angle), math.sin(angle)
    u, v = keypoints[..., 0], keypoints[..., 1]
    return torch.stack([cos * u - sin * v, sin * u + cos * v], dim=-1)


def smooth_assignment(emission: Tensor, transition: Tensor) -> Tensor:
    """Posterior of a hidden Markov chain over candidates (forward-backward in logarithms).

    Args:
        emission: (S, T, K) log-likelihood of candidate k in frame t.
        transition: (S, T - 1, K, K) log-likelihood of going from candidate i in frame t to j in t + 1.

    Returns:
        (S, T, K) probabilities, summing to one over K (Rabiner, "A tutorial on hidden Markov models", 1989).
        Differentiable.
    """
    forward = [emission[:, 0]]
    backward = [torch.zeros_like(emission[:, 0])]
    frames = emission.shape[1]
    for t in range(frames - 1):
        forward.append(
            torch.logsumexp(forward[-1][:, :, None] + transition[:, t], dim=1) + emission[:, t + 1]
        )
        later = frames - 2 - t
        onward = (backward[-1] + emission[:, later + 1])[:, None, :]
        backward.append(torch.logsumexp(transition[:, later] + onward, dim=2))
    backward.reverse()
    return torch.softmax(torch.stack(forward, dim=1) + torch.stack(backward, dim=1), dim=-1)


class NearestPoseLifter(nn.Module):
    """3D poses for the joints of tracked people, from the nearest poses of a pool.

    Each frame takes the ``neighbours`` best matches of
    :class:`~tensorsim.vision.lifting.pose_search.PoseSearch`, weighted by how well they fit and, with
    ``temporal`` > 0, by how well they agree with those of the frames before and after (:func:`smooth_assignment`),
    so that depths do not flip between similar frames. Their spread says how uncertain depths are.
    ``neighbours=1`` is the paper's nearest match.

    Args:
        library: (L, 14, 3) poses in any unit of length (x right, y away, z up); None is the shipped pool.
        yaws: headings at which each pose of the pool is tried; 1 for a pool that has all headings already.
        neighbours: candidates per frame.
        search_joints: a frame with fewer joints takes its candidates from the nearest frame with at least as many.
        tolerance: relative error (square root of ``distance``) at which a candidate loses its weight; more where even
            the nearest pose fits badly.
        temporal: weight of the change of pose and size from frame to frame, in units of a change by 0.03
            body heights and by 1 % of the size; 0 treats frames independently.
        chunk: frame-pose pairs compared at once, which bounds the memory: up to 24 bytes a pair.
        pitch_rad: upward tilt of the camera; depths are along its optical axis.
        roll_rad: turn of the camera about that axis, see :class:`tensorsim.CameraConfig`.

    Shapes:
        joints (..., T, 14, 2) pixels and weights (..., T, 14) >= 0 (0 = not seen) ->
        :class:`tensorsim.types.Lifted`. A frame with fewer than two weighted joints takes the nearest other
        frame. Differentiable with respect to joints and weights through the fit and the shares of the candidates;
        the search that finds the candidates is not.

    Raises:
        TensorsimError: settings out of range, other shapes, NaN, negative weights, or no frames.
    """

    def __init__(
        self,
        library: Tensor | None = None,
        yaws: int = 24,
        neighbours: int = 128,
        search_joints: int = 8,
        tolerance: float = 0.05,
        temporal: float = 1.0,
        chunk: int = 2**22,
        pitch_rad: float = 0.0,
        roll_rad: float = 0.0,
    ) -> None:
        super().__init__()
        poses = load_pose_library() if library is None else standardise_poses(library)
        for name, value in (("yaws", yaws), ("neighbours", neighbours), ("chunk", chunk)):
            check_count(value, f"NearestPoseLifter.{name}")
        if neighbours > poses.shape[0] * yaws:
            raise TensorsimError(
                f"NearestPoseLifter.neighbours: got {neighbours}, expected at most "
                f"{poses.shape[0] * yaws}, the library's {poses.shape[0]} poses at {yaws} headings"
            )
        check_count(search_joints, "NearestPoseLifter.search_joints", 1, len(JOINTS))
        check_positive(tolerance, "NearestPoseLifter.tolerance")
        for name, angle in (("pitch_rad", pitch_rad), ("roll_rad", roll_rad)):
            if not math.isfinite(angle):
                raise TensorsimError(f"NearestPoseLifter.{name}: got {angle}, expected a finite angle")
        check_not_negative(temporal, "NearestPoseLifter.temporal")
        self.neighbours, self.tolerance = neighbours, tolerance
        self.temporal, self.search_joints = temporal, search_joints
        # Per frame, at 30 frames a second: a limb that moves at 1.6 m/s, in body heights; somebody 4 m away who
        # walks at 1.2 m/s, in relative size. Sizes that change faster than bodies can move are wrong matches.
        self.change, self.size_change = 0.03, 0.01
        self.reserve = 0.3  # of the squared error of the nearest pose, added to that of the tolerance
        self.search = PoseSearch(poses, yaws, neighbours, chunk, pitch_rad)
        self.roll_rad = float(roll_rad)

    def tilted(self, pitch_rad: float, roll_rad: float = 0.0) -> "NearestPoseLifter":
        """A copy for a camera with another tilt and roll."""
        other = copy.copy(self)
        other._modules = {"search": self.search.tilted(pitch_rad)}
        other.roll_rad = float(roll_rad)
        return other

    def forward(self, keypoints: Tensor, weights: Tensor) -> Lifted:
        """Joints (..., T, 14, 2) pixels and weights (..., T, 14) -> Lifted."""
        check_to_lift(keypoints, weights)
        shape, frames = keypoints.shape, keypoints.shape[-3]
        tracks = keypoints[..., 0, 0, 0].numel()
        keypoints, weights = keypoints.reshape(tracks, frames, 14, 2), weights.reshape(tracks, frames, 14)
        keypoints = rolled(keypoints, self.roll_rad)  # as a level camera would see them
        seen = (weights > 0).sum(dim=-1)
        placeable = seen >= 2
        source = nearest_valid(placeable)
        keypoints = keypoints.gather(1, source[..., None, None].expand_as(keypoints))
        weights = weights.gather(1, source[..., None].expand_as(weights)).to(keypoints.dtype)

        with torch.no_grad():
            index = self.search(keypoints.flatten(0, 1), weights.flatten(0, 1))
            index = index.reshape(tracks, frames, self.neighbours)
            # Few joints fit many poses: such a frame takes its candidates from the nearest better one.
            known = nearest_valid(seen.gather(1, source) >= self.search_joints)
            index = index.gather(1, known[..., None].expand_as(index))
        poses = self.search.poses(index).to(keypoints.dtype)
        scale, placed, distance = fit_poses(keypoints[:, :, None], weights[:, :, None], poses)

        share = self._share(poses, scale, distance, placeable)
        depth = (share[..., None] * poses[..., 1]).sum(dim=2)
        variance = (share[..., None] * (poses[..., 1] - depth[:, :, None]).square()).sum(dim=2)
        return Lifted(
            depth=depth.reshape(shape[:-1]),
            scale=(share * scale).sum(dim=2).reshape(shape[:-2]),
            keypoints=rolled((share[..., None, None] * placed).sum(dim=2), -self.roll_rad).reshape(shape),
            nearest=index[..., 0].reshape(shape[:-2]),
            distance=distance[..., 0].reshape(shape[:-2]),
            deviation=(variance + 1e-12).sqrt().reshape(shape[:-1]),
        )

    def _share(self, poses: Tensor, scale: Tensor, distance: Tensor, placeable: Tensor) -> Tensor:
        """Weight of each candidate, (S, T, K) summing to one; only frames (S, T) that are ``placeable`` count."""
        # Where even the nearest pose fits badly, as with wrong keypoints, the others are hardly worse.
        misfit = distance.amin(dim=-1, keepdim=True)
        emission = -0.5 * distance / (self.tolerance**2 + self.reserve * misfit)
        if self.temporal == 0.0 or self.neighbours == 1:
            return torch.softmax(emission, dim=-1)
        # What changes from frame to frame: the pose (rms over joints) and the logarithm of the size, in one unit.
        size = (self.change / self.size_change) * scale.clamp(min=1e-6).log()[..., None]
        state = torch.cat([poses.flatten(-2) / math.sqrt(14.0), size], dim=-1)
        # |a - b|^2 by a matrix product keeps its digits only if a and b are small.
        middle = state[:, :-1].mean(dim=2, keepdim=True)
        a, b = state[:, :-1] - middle, state[:, 1:] - middle
        product = torch.matmul(a, b.transpose(-1, -2))
        change = a.square().sum(dim=-1)[..., None] + b.square().sum(dim=-1)[:, :, None, :] - 2.0 * product
        transition = -0.5 * self.temporal / self.change**2 * change.clamp(min=0.0)
        # A frame without a pose has the candidates of its neighbour and keeps their probabilities, so that empty
        # frames do not count as evidence.
        same = torch.eye(self.neighbours, dtype=torch.bool, device=poses.device)
        passed = torch.where(same, 0.0, -1e9).to(transition.dtype)
        alone = placeable[:, :-1] & placeable[:, 1:]
        borrowed = ~alone & (poses[:, :-1] == poses[:, 1:]).flatten(2).all(dim=-1)
        transition = torch.where(borrowed[..., None, None], passed, transition)
        return smooth_assignment(emission * placeable[..., None], transition)
