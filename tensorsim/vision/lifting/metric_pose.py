"""From joints in the image and their library depths to joints in the world, in metres."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.body.skeleton import lowest_ankle, mid_hips
from tensorsim.config import CameraConfig
from tensorsim.config.people import PANEL_DISTANCES_M
from tensorsim.errors import (
    TensorsimError,
    check_choice,
    check_finite,
    check_image_size,
    check_mask,
    check_per_person,
    check_points,
    check_positive,
    check_score,
    check_shape,
)
from tensorsim.geometry.camera import Pinhole, back_project
from tensorsim.ops import of_person
from tensorsim.types import Lifted
from tensorsim.vision.lifting.floor import (
    floor_under,
    fused_range,
    looks_bent,
    lowered,
    on_the_same_floor,
    range_on_floor,
    upright_share,
)
from tensorsim.vision.lifting.standing_feet import range_over_feet
from tensorsim.vision.smoothing.along_time import (
    fill_gaps,
    masked_median,
    nearest_valid,
    robust_smooth,
    where_any,
)


def metres_per_pixel(height_m: Tensor, height_px: Tensor) -> Tensor:
    r"""Scale of a body in the image, $\alpha = H / h$: standing height (m) over height in pixels."""
    return height_m / height_px


def camera_range(focal_px: Tensor, height_m: Tensor, height_px: Tensor) -> Tensor:
    """Distance along the optical axis of a pinhole camera, ``y = f H / h``, in metres.

    Args:
        focal_px: f, focal length in pixels.
        height_m: H, height of the body in metres.
        height_px: h, height in pixels of the body if it stood upright.
    """
    return focal_px * height_m / height_px


def standing_px(focal_px: Tensor, height_m: Tensor, hips_range: Tensor, offset: Tensor) -> Tensor:
    """Height in pixels that a body would have upright, the inverse of :func:`camera_range`.

    Args:
        focal_px: f, focal length in pixels.
        height_m: H, standing height in metres.
        hips_range: y of the hips in metres.
        offset: d, mean depth of the joints about the hips in standing heights: ``f H / (y + H d)``.
    """
    return focal_px / (hips_range / height_m + offset).clamp(min=1e-3)


def accumulated_displacement(u: Tensor, alpha: Tensor, valid: Tensor) -> Tensor:
    r"""The paper's position: displacement of every frame times the scale of that frame, accumulated.

    $$ x(0) = 0, \quad x(t) = x(t - 1) + \alpha(t) (u(t) - u(t - 1)) $$

    Args:
        u: (..., T) pixels.
        alpha: (..., T) metres per pixel.
        valid: (..., T) bool; other frames are filled with the nearest valid one.

    Returns:
        (..., T) metres, 0 up to the first valid frame.
    """
    u, alpha = fill_gaps(u, valid), fill_gaps(alpha, valid)
    steps = alpha[..., 1:] * (u[..., 1:] - u[..., :-1])
    return F.pad(steps.cumsum(dim=-1), [1, 0])


def paper_pose(image: Tensor, lifted: Lifted, valid: Tensor, height: Tensor, distance: Tensor) -> Tensor:
    """Joints (..., P, T, 14, 2) of the image to the world as in the paper; see :class:`MetricPose`."""
    v = image[..., 1]
    alpha = metres_per_pixel(height, (v.amax(dim=-1) - v.amin(dim=-1)).clamp(min=1.0))
    root = mid_hips(image)
    x = accumulated_displacement(root[..., 0], alpha, valid)
    across = alpha[..., None, None] * (image - root[..., None, :])
    depth = alpha[..., None] * 0.2 * lifted.scale[..., None] * lifted.depth
    y = distance[..., None] + depth
    joints = torch.stack([x[..., None] + across[..., 0], y, -across[..., 1]], dim=-1)
    return lowered(joints, lowest_ankle(joints))


class MetricPose(nn.Module):
    """Places lifted people in the world.

    ``mode="camera"``: a pinhole camera. A standing person of height H at range y has a height of ``s = f H / y``
    pixels, and the lifter gives s for any pose, so the hips are at range ``y = f H / s - d``, d the mean depth of the
    joints relative to the hips; y is smoothed along time by its precision, robustly, because 2 % at 4 m are 8 cm.
    While a foot stands on the floor, changes of y follow the pose (:mod:`tensorsim.vision.lifting.standing_feet`).
    The less upright a body is, the more its range depends on where the person last stood or stands next, and on the
    range at which its lowest joint rests on the floor (:mod:`tensorsim.vision.lifting.floor`). Each joint lies on its
    line of sight at its own depth. Frames with fewer than eight visible joints, or with a pose that the lifter does not
    know (people lying down), do not give a reliable size: they take that of the other frames. A frame with few joints
    is discarded if its body would be smaller than 0.65 of that (a leg at the edge of the picture, taken for a whole
    person). The floor is a low running quantile of the height of the lower ankle in frames where the person stands, so
    that neither a jump nor an outlier moves it. Where ranges come from sizes, anything that would stand far below the
    floor of the nearest person is taken for a small object, not a person, and none of its joints counts as seen.

    ``mode="paper"``: metres per pixel ``alpha = H / pixel height`` of the current frame (the extent of the
    joints), depths times ``alpha * 0.2`` (library depth in pixels of the frame), the hips moved sideways by the
    sum of their displacements in the image, each times the alpha of its frame, range constant, the lower ankle at
    z = 0 in every frame. Kept to reproduce the published results: motion along the optical axis is not possible in
    it, and the body grows when the person sits down.

    Args:
        camera: pinhole camera; None is the default one, at the radar.
        person_height_m: standing heights in the order of the people; the last one applies to all further people.
        initial_distance_m: range of each person in their first half second, in the same order. In the camera
            mode it determines the focal length, person by person. None takes the camera's focal length (in the
            paper's mode the panel's 4.00 and 0.50 m).
        keypoint_threshold: score from which a joint counts as seen.
        mode: ``"camera"`` or ``"paper"``.
        range_smoothing_s: standard deviation of the smoothing kernel of the range.
        floor_window_s: window of the quantile that gives the floor; longer than a jump.
        calibrated: whether height and tilt of the camera are known well: then no floor is estimated, and joints keep
            the heights that the camera gives.

    Shapes:
        joints (..., P, T, 14, 2) pixels, scores (..., P, T, 14), their :class:`tensorsim.types.Lifted`, valid
        (..., P, T) bool, image height and width in pixels, frames per second, for a moving camera its
        world-from-camera poses (..., T, 3, 4) (camera axes right, down, forward), and optionally which people are
        cut off by the left or right edge of the picture (..., P, T) bool, whose size does not count -> world joints
        (..., P, T, 14, 3) in metres and whether each was seen (..., P, T, 14). What was not seen is filled: a
        hidden joint from the pose that the lifter found, an invalid or discarded frame from the nearest other one;
        people without any valid frame are all zeros. Differentiable.

    Raises:
        TensorsimError: heights or distances that are not positive, an unknown mode, wrong shapes, NaN, or a
            moving camera in the paper's mode.
    """

    heights: Tensor
    distances: Tensor

    def __init__(
        self,
        camera: CameraConfig | None = None,
        person_height_m: tuple[float, ...] = (1.80, 1.70),
        initial_distance_m: tuple[float, ...] | None = None,
        keypoint_threshold: float = 0.3,
        mode: str = "camera",
        range_smoothing_s: float = 0.3,
        floor_window_s: float = 1.5,
        calibrated: bool = False,
    ) -> None:
        super().__init__()
        check_choice(mode, ("camera", "paper"), "MetricPose.mode")
        self.mode = mode
        self.keypoint_threshold = keypoint_threshold
        self.range_smoothing_s = range_smoothing_s
        self.floor_window_s = floor_window_s
        self.calibrated = calibrated
        self.whole_body_joints = 8  # visible joints from which the size of a body is reliable
        self.poor_fit = (
            0.25  # squared error of the lifted pose over the spread of the joints; good ones have 0.01
        )
        self.least_outlier_m = 0.03  # errors of range and height that even a good frame has
        self.least_size = 0.65  # of the size in reliable frames: below, a part was taken for a whole body
        check_score(keypoint_threshold, "MetricPose.keypoint_threshold")
        check_positive(range_smoothing_s, "MetricPose.range_smoothing_s")
        check_positive(floor_window_s, "MetricPose.floor_window_s")
        camera = CameraConfig() if camera is None else camera
        self.camera, self.pinhole = camera, Pinhole(camera)
        self.distance_gives_focal = initial_distance_m is not None
        distances = PANEL_DISTANCES_M if initial_distance_m is None else initial_distance_m
        for name, values in (("person_height_m", person_height_m), ("initial_distance_m", distances)):
            check_per_person(values, f"MetricPose.{name}")
        self.register_buffer("heights", torch.tensor(person_height_m, dtype=torch.float64), persistent=False)
        self.register_buffer("distances", torch.tensor(distances, dtype=torch.float64), persistent=False)

    def seen_by(self, camera: CameraConfig) -> "MetricPose":
        """A copy for another camera."""
        distances = tuple(self.distances.tolist()) if self.distance_gives_focal else None
        return MetricPose(
            camera, tuple(self.heights.tolist()), distances, self.keypoint_threshold, self.mode,
            self.range_smoothing_s, self.floor_window_s, self.calibrated,
        ).to(self.heights.device)  # fmt: skip

    def forward(
        self,
        keypoints: Tensor,
        scores: Tensor,
        lifted: Lifted,
        valid: Tensor,
        image_height: int,
        image_width: int,
        fps: float,
        camera_pose: Tensor | None = None,
        cut_off: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Joints, scores, Lifted, valid, image size, fps, camera poses, cut off -> world joints and what was seen."""
        _check(keypoints, scores, lifted, valid, image_height, image_width, fps)
        if cut_off is not None:
            check_mask(cut_off, list(valid.shape), "cut_off")
        seen = (scores >= self.keypoint_threshold) & valid[..., None]
        height = self._of_each(self.heights, keypoints)
        distance = self._of_each(self.distances, keypoints)
        if self.mode == "paper":
            if camera_pose is not None:
                raise TensorsimError("camera_pose: got camera poses, expected none: the paper has no camera")
            image = torch.where(seen[..., None], keypoints, lifted.keypoints)
            joints = paper_pose(image, lifted, valid, height, distance)
        else:
            pose = self._pose(keypoints, camera_pose)
            joints, seen, valid = self._by_camera(
                keypoints,
                scores,
                lifted,
                seen,
                valid,
                height,
                distance,
                image_height,
                image_width,
                fps,
                pose,
                cut_off,
            )
        joints = joints.gather(-3, nearest_valid(valid)[..., None, None].expand_as(joints))
        return joints * valid.any(dim=-1)[..., None, None, None], seen

    def _by_camera(
        self,
        keypoints: Tensor,
        scores: Tensor,
        lifted: Lifted,
        seen: Tensor,
        valid: Tensor,
        height: Tensor,
        distance: Tensor,
        image_height: int,
        image_width: int,
        fps: float,
        pose: Tensor,
        cut_off: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """World joints (..., P, T, 14, 3), which of them are seen, and which frames still show a person."""
        weights = scores.clamp(min=0.0)
        weights = weights / weights.sum(dim=-1, keepdim=True).clamp(min=1e-6)
        # The fitted scale is that at the mean depth of the joints, not of the hips.
        offset = fill_gaps((weights * lifted.depth).sum(dim=-1), valid)
        scale = fill_gaps(lifted.scale, valid).clamp(min=1e-3)
        focal = torch.full_like(scale, self.pinhole.focal_length(image_width))
        if self.distance_gives_focal:
            focal = self._focal_from(distance, height, scale, offset, valid, fps)
        center = torch.tensor(self.pinhole.principal_point(image_height, image_width)).to(keypoints)
        # The size of a body that is half out of the picture, or in a pose that the lifter does not know, is not
        # reliable: those frames follow the others.
        many = seen.sum(dim=-1) >= self.whole_body_joints
        # Where the left or right edge of the picture cuts a body off, the network puts joints beyond it at the edge.
        across = keypoints[..., 0] / max(image_width - 1, 1)
        beside = (across < 0.01) | (across > 0.99)
        beyond = (seen & beside).any(dim=-1)
        if cut_off is not None:
            beyond = beyond | cut_off
        whole = valid & many & (lifted.distance < self.poor_fit)
        whole = where_any(where_any(where_any(whole & ~beyond, whole), valid & many), valid)

        hips_range = camera_range(focal, height, scale) - height * offset
        image = torch.where(seen[..., None], keypoints, lifted.keypoints)
        depth = height[..., None] * lifted.depth
        # A joint found at the lower edge of the picture is cut off by it, not a foot on the floor.
        inside = seen & (keypoints[..., 1] < 0.97 * image_height)
        hips_range, whole, stands, precision = self._on_floor(
            hips_range, image, depth, focal, center, pose, height, inside, whole, fps
        )
        whole = where_any(whole & ~beyond, whole)
        hips_range = robust_smooth(
            hips_range, whole, self.range_smoothing_s * fps, self.least_outlier_m, precision=precision
        )
        body_px = standing_px(focal, height, hips_range, offset)
        tells = whole.to(precision.dtype) * precision + 1e-4
        hips_range = range_over_feet(hips_range, image, depth, inside & ~beside, body_px, tells, fps)

        # A network that sees a leg alone may take it for a small body: such a frame is discarded.
        body_px = standing_px(focal, height, hips_range, offset)
        valid = valid & (many | (scale > self.least_size * body_px))
        seen = seen & valid[..., None]
        # Hidden joints are where the lifted pose has them, at the size of the reliable frames.
        middle = (weights[..., None] * lifted.keypoints).sum(dim=-2, keepdim=True)
        placed = middle + (body_px / scale)[..., None, None] * (lifted.keypoints - middle)
        image = torch.where(seen[..., None], keypoints, placed)
        joints = back_project(image, hips_range[..., None] + depth, focal, center, pose)
        if self.calibrated:
            return joints, seen, valid
        stands = torch.where(stands.any(dim=-1, keepdim=True), stands & valid, valid)
        floor = floor_under(joints, stands, fps, self.floor_window_s)
        if not self.distance_gives_focal:
            person = on_the_same_floor(floor - pose[..., 2, 3], hips_range, valid)
            valid = valid & person[..., None]
        return lowered(joints, floor), seen & valid[..., None], valid

    def _pose(self, keypoints: Tensor, camera_pose: Tensor | None) -> Tensor:
        """World-from-camera pose, broadcast to (..., P, T, 3, 4)."""
        if camera_pose is None:
            return self.pinhole.pose.to(keypoints.dtype)
        expected = list(keypoints.shape[:-4])
        expected.extend([keypoints.shape[-3], 3, 4])
        check_shape(camera_pose, expected, "camera_pose")
        check_finite(camera_pose, "camera_pose")
        return camera_pose.to(keypoints.dtype).unsqueeze(-4)

    def _of_each(self, values: Tensor, like: Tensor) -> Tensor:
        """A value per person, (P, 1): the last one applies to all further people."""
        return of_person(values.to(like.dtype), torch.arange(like.shape[-4], device=like.device))[:, None]

    def _focal_from(
        self, distance: Tensor, height: Tensor, scale: Tensor, offset: Tensor, valid: Tensor, fps: float
    ) -> Tensor:
        """Focal length (..., P, T) that puts each person at its distance in its first half second."""
        since = valid.to(torch.int64).cumsum(dim=-1)
        early = valid & (since <= max(int(0.5 * fps), 1))
        return masked_median(scale * (distance / height + offset), early).clamp(min=1.0).expand_as(scale)

    def _on_floor(
        self,
        by_size: Tensor,
        image: Tensor,
        depth: Tensor,
        focal: Tensor,
        center: Tensor,
        pose: Tensor,
        height: Tensor,
        seen: Tensor,
        whole: Tensor,
        fps: float,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Range of the hips (..., P, T) from the size of the body or, where it is not upright, from the floor.

        Also which frames give a reliable range, in which ones the person stands, and how precise the range is.
        """
        bent = looks_bent(image, seen)
        straight = where_any(whole & ~bent, whole)
        smooth = robust_smooth(by_size, straight, self.range_smoothing_s * fps, self.least_outlier_m)
        smooth = torch.where(straight, smooth, by_size)
        joints = back_project(image, smooth[..., None] + depth, focal, center, pose)
        upright = upright_share(joints, height.expand_as(by_size)) * (~bent).to(joints.dtype)
        # If no foot is seen, the lowest visible joint may be any joint.
        feet = seen[..., 10] | seen[..., 13]
        # The floor is where this person stood last, or will stand next.
        stands = whole & (upright >= 0.9)
        rests = stands & feet
        ankle = robust_smooth(lowest_ankle(joints), rests, self.floor_window_s * fps, self.least_outlier_m)
        floor = fill_gaps(ankle, rests)
        ahead = torch.cat(
            [(image - center) / focal[..., None, None], torch.ones_like(image[..., :1])], dim=-1
        )
        rise = (ahead * pose[..., None, 2, :3]).sum(dim=-1)
        by_floor, gain = range_on_floor(rise, depth, floor - pose[..., 2, 3], seen & feet[..., None])
        stood = torch.where(stands.any(dim=-1, keepdim=True), fill_gaps(smooth, stands), float("inf"))
        by_floor = torch.where(rests.any(dim=-1, keepdim=True), by_floor, float("inf"))
        fused, share, precision = fused_range(
            by_size, upright, by_floor, gain, stood, height.expand_as(stood)
        )
        return fused, whole | (seen.any(dim=-1) & (share < 0.5)), stands, precision


def cut_off_beside(boxes: Tensor, width: int) -> Tensor:
    """Whether boxes (..., 4), ``xyxy`` pixels, reach the left or right edge of a picture of this width, (...) bool.

    The box of somebody who enters reaches the edge before the network places a joint there.
    """
    return (boxes[..., 0] <= 1.0) | (boxes[..., 2] >= width - 2.0)


def _check(
    keypoints: Tensor,
    scores: Tensor,
    lifted: Lifted,
    valid: Tensor,
    image_height: int,
    image_width: int,
    fps: float,
) -> None:
    """Refuse inputs that do not fit together."""
    layout = "(..., P, T, 14, 2) joints in pixels"
    check_points(keypoints, 4, 14, 2, "keypoints", layout)
    shape = keypoints.shape
    check_shape(scores, list(shape[:-1]), "scores")
    check_shape(lifted.depth, list(shape[:-1]), "lifted.depth")
    check_shape(lifted.scale, list(shape[:-2]), "lifted.scale")
    check_shape(lifted.keypoints, list(shape), "lifted.keypoints")
    check_shape(lifted.distance, list(shape[:-2]), "lifted.distance")
    check_mask(valid, list(shape[:-2]), "valid")
    if shape[-3] < 1:
        raise TensorsimError(f"keypoints: got shape {list(shape)}, expected at least 1 frame")
    check_finite(keypoints, "keypoints")
    check_finite(scores, "scores")
    check_finite(lifted.depth, "lifted.depth")
    check_finite(lifted.scale, "lifted.scale")
    check_finite(lifted.keypoints, "lifted.keypoints")
    check_image_size(image_height, image_width)
    check_positive(fps, "fps")
