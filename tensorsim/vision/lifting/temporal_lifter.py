"""Lifting by a network that sees a window of time: keypoints to joints, position and their uncertainty.

The keypoints are seen as by a level camera (:mod:`tensorsim.vision.lifting.sight`), and a network of dilated
convolutions along time (:mod:`tensorsim.vision.lifting.temporal_net`) finds depths, distance and corrections of the
keypoints.
"""

import math
import os
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import BONES, MIRRORED, MIRRORED_JOINTS, bone_lengths, coco_to_body, mid_hips
from tensorsim.config import CameraConfig
from tensorsim.errors import (
    TensorsimError,
    check_count,
    check_finite,
    check_floating,
    check_image_size,
    check_mask,
    check_per_person,
    check_points,
    check_positive,
    check_score,
    check_shape,
)
from tensorsim.geometry.camera import Pinhole, project
from tensorsim.ops import of_person, times_as_fast
from tensorsim.types import Lifted
from tensorsim.vision.lifting.sight import (
    RADIUS,
    Sight,
    level_sight,
    mirror_image,
    turned_back,
    windowed_mean,
)
from tensorsim.vision.lifting.temporal_net import DILATIONS, Located, TemporalNet
from tensorsim.vision.smoothing.along_time import raised_slowly

#: Total length of all bones, in standing heights; it differs by 2 % between people.
_ALL_BONES = 2.39


class TemporalPose(NamedTuple):
    """People in three dimensions.

    Attributes:
        joints: (..., P, T, 14, 3) metres about the middle of the hips, in world axes.
        root: (..., P, T, 3) middle of the hips in the world, metres.
        deviation: (..., P, T, 14, 3) standard deviations of ``joints`` in metres, along world axes.
        root_deviation: (..., P, T, 3) of ``root``.
    """

    joints: Tensor
    root: Tensor
    deviation: Tensor
    root_deviation: Tensor


def along_axes(across: Tensor, along: Tensor, azimuth: Tensor) -> Tensor:
    """Standard deviations (..., 3) along world axes of errors across and along a horizontal direction.

    Args:
        across, along: (...).
        azimuth: (..., 2) cosine and sine of the angle of the direction from +y towards +x.
    """
    cos, sin = azimuth[..., 0].square(), azimuth[..., 1].square()
    near, far = across.square(), along.square()
    return torch.stack([near * cos + far * sin, near * sin + far * cos, near], dim=-1).sqrt()


class TemporalLifter(nn.Module):
    """Keypoints of tracked people over time -> joints about the hips, position of the hips, standard deviations.

    The network sees the people and their mirror images, and both results are averaged: a mirrored film gives the
    mirrored motion.

    Args:
        network: with its weights; None is an untrained one. :meth:`from_pretrained` loads the shipped one.
        camera: where the camera stands, its tilt and focal length; None is the default one, at the radar.
        person_height_m: standing heights in the order of the people; the last one applies to all further people.
        keypoint_threshold: score from which a keypoint counts as seen.
        frames_per_block: frames that go through the network at once, for tracks with somebody in or near them, which
            bounds time and memory; results where somebody is tracked do not depend on it.
        camera_known: False for an estimated camera. The network sees where the floor is and derives the distance of
            people who lie or sit from it; a tilt that is a few degrees off shifts that by a metre. With False, people
            are placed where their bones have the expected lengths.

    Shapes:
        COCO keypoints (..., P, T, 17, 2) in pixels, scores (..., P, T, 17), boxes (..., P, T, 4) ``xyxy`` pixels,
        valid (..., P, T) bool, height and width of the picture, frames per second -> :class:`TemporalPose`. Frames
        in which nobody is tracked are filled from those around them, or far from any of those with the camera's
        position. Differentiable.

    Raises:
        TensorsimError: heights that are not positive, wrong shapes, NaN, no frames.
    """

    heights: Tensor
    bones: Tensor
    other_keypoint: Tensor
    other_joint: Tensor

    def __init__(
        self,
        network: TemporalNet | None = None,
        camera: CameraConfig | None = None,
        person_height_m: tuple[float, ...] = (1.80, 1.70),
        keypoint_threshold: float = 0.3,
        frames_per_block: int = 256,
        camera_known: bool = True,
    ) -> None:
        super().__init__()
        check_score(keypoint_threshold, "TemporalLifter.keypoint_threshold")
        check_count(frames_per_block, "TemporalLifter.frames_per_block")
        check_per_person(person_height_m, "TemporalLifter.person_height_m")
        self.network = TemporalNet() if network is None else network
        self.keypoint_threshold, self.frames_per_block = keypoint_threshold, frames_per_block
        self.camera_known, self.log_bones = camera_known, math.log(_ALL_BONES)
        #: Body heights within which a keypoint counts as right; from twice as much on it is wrong.
        self.near = 0.06
        #: Seconds in which a joint moves from its keypoint to where the network places it.
        self.gives_way_s = 0.2
        #: Frames before and after a frame that affect its result.
        # Three averages in a row: the direction, the size about it, and later the length of the bones.
        self.reach = self.network.reach + 3 * RADIUS
        self.pinhole = Pinhole(CameraConfig() if camera is None else camera)
        self.register_buffer("heights", torch.tensor(person_height_m, dtype=torch.float64), persistent=False)
        self.register_buffer("bones", torch.tensor(BONES).T, persistent=False)
        self.register_buffer("other_keypoint", torch.tensor(MIRRORED), persistent=False)
        self.register_buffer("other_joint", torch.tensor(MIRRORED_JOINTS), persistent=False)

    def seen_by(
        self, camera: CameraConfig, person_height_m: tuple[float, ...] | None = None, known: bool = True
    ) -> "TemporalLifter":
        """A copy with the same network for another camera, known or estimated, and, unless None, other people."""
        heights = tuple(self.heights.tolist()) if person_height_m is None else person_height_m
        other = TemporalLifter(
            self.network, camera, heights, self.keypoint_threshold, self.frames_per_block, known
        )
        other.near, other.gives_way_s = self.near, self.gives_way_s
        return other.to(self.heights.device).train(self.training)

    def forward(
        self,
        keypoints: Tensor,
        scores: Tensor,
        boxes: Tensor,
        valid: Tensor,
        image_height: int,
        image_width: int,
        fps: float,
    ) -> TemporalPose:
        """Keypoints, scores, boxes, valid, image size and fps -> TemporalPose."""
        _check(keypoints, scores, boxes, valid)
        check_image_size(image_height, image_width)
        check_positive(fps, "fps")
        lead, frames = keypoints.shape[:-3], keypoints.shape[-3]
        people = keypoints[..., 0, 0, 0].numel()
        dtype = self.network.leave.weight.dtype
        # The network's window is a number of frames and suits films of up to 45 frames per second: a faster film is
        # split into several of about 30 each.
        films = times_as_fast(fps)
        tracks, fps = films * people, fps / films
        k = _interleaved(keypoints.reshape(people, frames, 17, 2).to(dtype), films)
        s = _interleaved(scores.reshape(people, frames, 17).to(dtype), films)
        b = _interleaved(boxes.reshape(people, frames, 4).to(dtype), films)
        v = _interleaved(valid.reshape(people, frames), films)
        height_of_each = self._height_of_each(keypoints).to(dtype).repeat_interleave(films)
        joints: list[Tensor] = []
        spreads: list[Tensor] = []
        ranges: list[Tensor] = []
        turns: list[Tensor] = []
        for start in range(0, v.shape[1], self.frames_per_block):
            first, stop = max(start - self.reach, 0), min(start + self.frames_per_block, v.shape[1])
            last = min(stop + self.reach, v.shape[1])
            rows = v[:, first:last].any(dim=1).nonzero()[:, 0]
            found, azimuth = self._block(
                k[rows, first:last], s[rows, first:last], b[rows, first:last], v[rows, first:last],
                height_of_each[rows], image_height, image_width, fps,
            )  # fmt: skip
            begin, end = start - first, stop - first
            joints.append(_in_rows(found.joints[:, begin:end], rows, tracks))
            spreads.append(_in_rows(found.log_spread[:, begin:end], rows, tracks))
            ranges.append(_in_rows(found.log_range_spread[:, begin:end], rows, tracks))
            turns.append(_in_rows(azimuth[:, begin:end], rows, tracks))
        height = height_of_each[:, None]
        azimuth = torch.cat(turns, dim=1)
        points = height[..., None, None] * turned_back(torch.cat(joints, dim=1), azimuth)
        root = mid_hips(points)
        # Errors have a Laplace distribution, whose standard deviation is sqrt(2) times the mean absolute error.
        spread = math.sqrt(2.0) * height[..., None, None] * torch.cat(spreads, dim=1).exp()
        off = math.sqrt(2.0) * torch.cat(ranges, dim=1).exp() * root[..., :2].square().sum(dim=-1).sqrt()
        deviation = along_axes(spread[..., 0], spread[..., 1], azimuth[..., None, :])
        place = self.pinhole.pose[:, 3].to(dtype)
        parts = [points - root[..., None, :], root + place, deviation, along_axes(0.3 * off, off, azimuth)]
        parts = [_in_order(part, films)[:, :frames].to(keypoints.dtype).unflatten(0, lead) for part in parts]
        return TemporalPose(parts[0], parts[1], parts[2], parts[3])

    def in_picture(
        self,
        found: TemporalPose,
        keypoints: Tensor,
        weights: Tensor,
        image_height: int,
        image_width: int,
        fps: float,
    ) -> Lifted:
        """The pose as :class:`~tensorsim.vision.lifting.metric_pose.MetricPose` takes it.

        A joint that is seen stays at its keypoint as long as the network places it nearby, so that fast motion is not
        smoothed; one that is not seen, or seems to be wrong, is where the network places it. A joint moves between the
        two over :attr:`gives_way_s`, and its keypoints in frames next to a wrong one are replaced as well: a foot that
        is mistaken for the other one in some frames would jump there and back.

        Args:
            found: of :meth:`forward`.
            keypoints: (..., P, T, 14, 2) joints in pixels, see :func:`tensorsim.body.skeleton.coco_to_body`.
            weights: (..., P, T, 14) their scores, those that MetricPose is given.
            image_height, image_width: of the picture, pixels.
            fps: frames per second.
        """
        focal = self.pinhole.focal_length(image_width)
        center = self.pinhole.principal_point(image_height, image_width)
        pose = self.pinhole.pose.to(found.root.dtype)
        pixels, reach = project(found.joints + found.root[..., None, :], focal, center, pose)
        reach = reach.clamp(min=0.1)
        hips = 0.5 * (reach[..., 8:9] + reach[..., 11:12])
        height = self._height_of_each(found.root[..., None, :]).reshape(hips.shape[:-2])[..., None, None]
        depth = (reach - hips) / height.to(reach.dtype)
        share = weights.clamp(min=0.0)
        share = share / share.sum(dim=-1, keepdim=True).clamp(min=1e-6)
        middle = hips[..., 0] / height[..., 0].to(reach.dtype) + (share * depth).sum(dim=-1)
        scale = focal / middle.clamp(min=0.05)
        apart = (pixels - keypoints).square().sum(dim=-1).clamp(min=1e-12).sqrt() / scale[..., None]
        wrong = ((apart - self.near) / self.near).clamp(0.0, 1.0)
        wrong = torch.where(weights >= self.keypoint_threshold, wrong, torch.ones_like(wrong))
        reach_frames = int(self.gives_way_s * fps / 2 + 0.5)
        wrong = raised_slowly(wrong.transpose(-1, -2), reach_frames).transpose(-1, -2)
        image = keypoints + wrong[..., None] * (pixels - keypoints)
        none = torch.zeros_like(middle)
        # The network's deviations are those of joints in the world, see :class:`TemporalPose`, not of depths.
        return Lifted(depth, scale, image, none.to(torch.int64), none, torch.zeros_like(depth))

    def _block(
        self,
        keypoints: Tensor,
        scores: Tensor,
        boxes: Tensor,
        valid: Tensor,
        height: Tensor,
        rows: int,
        columns: int,
        fps: float,
    ) -> tuple[Located, Tensor]:
        """Located joints and azimuths of S tracks in some frames."""
        tracks = keypoints.shape[0]
        joints, joint_scores = coco_to_body(keypoints, scores, self.keypoint_threshold)
        one = torch.ones(tracks, dtype=keypoints.dtype, device=keypoints.device)
        center, pose = self.pinhole.principal_point(rows, columns), self.pinhole.pose.to(keypoints.dtype)
        sight = level_sight(
            keypoints,
            scores,
            joints,
            joint_scores,
            boxes,
            valid,
            self.pinhole.focal_length(columns) * one,
            torch.stack([center[0] * one, center[1] * one], dim=-1),
            pose[:, :3].expand(tracks, 3, 3),
            torch.stack([columns * one, rows * one], dim=-1),
            fps * one,
            pose[2, 3] / height,
            self.keypoint_threshold,
        )
        found = self._both_ways(sight)
        if self.camera_known:
            return found, sight.azimuth
        # As seen from the camera, a body twice as far away and twice as large looks the same.
        excess = bone_lengths(found.joints, self.bones).sum(dim=-1).log() - self.log_bones
        excess = windowed_mean(excess[..., None], valid.to(excess.dtype) + 1e-3)[..., 0]
        joints = found.joints * torch.exp(-excess)[..., None, None]
        return Located(joints, found.log_spread, found.log_range_spread), sight.azimuth

    def _both_ways(self, sight: Sight) -> Located:
        """The mean of what the network finds in people and in their mirror images."""
        found: Located = self.network(sight)
        turned: Located = self.network(mirror_image(sight, self.other_keypoint, self.other_joint))
        joints = turned.joints.index_select(-2, self.other_joint)
        joints = torch.cat([-joints[..., :1], joints[..., 1:]], dim=-1)
        spread = turned.log_spread.index_select(-2, self.other_joint)
        return Located(
            (found.joints + joints) / 2,
            (found.log_spread + spread) / 2,
            (found.log_range_spread + turned.log_range_spread) / 2,
        )

    def _height_of_each(self, like: Tensor) -> Tensor:
        """Standing height of each track, (S,), of (..., P, T, N, D)."""
        clips = 1
        for size in like.shape[:-4]:
            clips *= size
        return of_person(self.heights, torch.arange(like.shape[-4], device=like.device)).repeat(clips)

    @classmethod
    def from_pretrained(
        cls,
        source: str | os.PathLike[str] | None = None,
        camera: CameraConfig | None = None,
        person_height_m: tuple[float, ...] = (1.80, 1.70),
        keypoint_threshold: float = 0.3,
    ) -> "TemporalLifter":
        """The lifter with trained weights, in evaluation mode.

        It computes in float32, whose rounding moves joints by micrometres from frame to frame. A radar at 77 GHz sees
        that, so the pipeline uses ``from_pretrained().double()``.

        Args:
            source: a path, a name from ``tensorsim models list``, or None for the shipped weights.
            camera, person_height_m, keypoint_threshold: see the class.

        Raises:
            TensorsimError: no such file or name, or weights of another network.
        """
        from tensorsim.registry import locate
        from tensorsim.weights import load_state_dict, load_strict

        path = locate(source, cls.__name__)
        weights = load_state_dict(path)
        enter = weights.get("enter.weight")
        blocks = {key.split(".")[1] for key in weights if key.startswith("blocks.")}
        if enter is None or enter.dim() != 2 or len(blocks) != len(DILATIONS):
            raise TensorsimError(
                f"{path}: got the weights {', '.join(sorted(weights)[:3])}, ..., expected those of a TemporalLifter"
            )
        network = TemporalNet(enter.shape[0])
        load_strict(network, weights, path)
        return cls(network, camera, person_height_m, keypoint_threshold).eval()


def _interleaved(x: Tensor, films: int) -> Tensor:
    """Every n-th frame of (S, T, ...), from each of the first n on, as separate tracks: (S n, ceil(T / n), ...)."""
    lacking = x.new_zeros([x.shape[0], -x.shape[1] % films] + list(x.shape[2:]))  # noqa: RUF005
    padded = torch.cat([x, lacking], dim=1)
    return padded.unflatten(1, [-1, films]).transpose(1, 2).flatten(0, 1)


def _in_order(x: Tensor, films: int) -> Tensor:
    """Tracks (S n, T, ...) of :func:`_interleaved` back in time order, (S, T n, ...)."""
    return x.unflatten(0, [-1, films]).transpose(1, 2).flatten(1, 2)


def _in_rows(found: Tensor, rows: Tensor, tracks: int) -> Tensor:
    """Results of some tracks, (n, T, ...), placed in their ``rows`` (n,) among all tracks, zeros elsewhere."""
    return found.new_zeros([tracks] + list(found.shape[1:])).index_copy(0, rows, found)  # noqa: RUF005


def _check(keypoints: Tensor, scores: Tensor, boxes: Tensor, valid: Tensor) -> None:
    """Refuse inputs that do not fit together."""
    check_points(keypoints, 4, 17, 2, "keypoints", "(..., P, T, 17, 2) COCO keypoints in pixels")
    frames = list(keypoints.shape[:-2])
    check_shape(scores, list(keypoints.shape[:-1]), "scores")
    check_shape(boxes, frames + [4], "boxes")  # noqa: RUF005 (TorchScript)
    check_mask(valid, frames, "valid")
    if keypoints.shape[-3] < 1:
        raise TensorsimError(f"keypoints: got shape {list(keypoints.shape)}, expected at least 1 frame")
    for name, values in (("keypoints", keypoints), ("scores", scores), ("boxes", boxes)):
        check_floating(values, name)
        check_finite(values, name)
