"""Long videos, frame by frame, and long motion, pulse by pulse.

Memory does not grow with their length, except for poses: lifting and smoothing take about 12 KB per person and frame,
including frames before and after a person appears.
"""

import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tensorsim import plot
from tensorsim.config import CameraConfig, RadarConfig
from tensorsim.data.video import VideoReader
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.geometry.camera import focal_length
from tensorsim.pipeline import PoseToDoppler, VideoToPose
from tensorsim.pipeline.pose import joined
from tensorsim.pipeline.reach import radar_ahead_m
from tensorsim.progress import picture, progress_bar
from tensorsim.threads import spread
from tensorsim.types import Detections, Pose, RadarMaps, Tracks
from tensorsim.vision.calibration.calibrator import (
    USUAL_FOV_RAD,
    CameraCalibrator,
    CameraEstimate,
    camera_config,
    horizontal_fov,
    with_reserve,
)
from tensorsim.vision.calibration.camera_motion import BackgroundMotion
from tensorsim.vision.calibration.stabilisation import StillPicture, at_even_times, mapped, still_picture
from tensorsim.vision.smoothing.even_time import to_even_time


class Found(NamedTuple):
    """The people found, and what is known about the camera.

    Attributes:
        pose: of one clip (B = 1), on the CPU.
        camera: as estimated from the people; None if it was not.
        background_px_s: largest shift of the background within a second, in pixels of the video; None if unknown.
        radar_ahead_m: how far in front of the camera the radar stands, see :func:`within_reach`.
        from_film: (T, 3, 3) homographies from pixels of each frame to those of ``camera``, which is static, see
            :mod:`tensorsim.vision.calibration.stabilisation`; None if no camera motion was taken out.
    """

    pose: Pose
    camera: CameraEstimate | None = None
    background_px_s: float | None = None
    radar_ahead_m: float = 0.0
    from_film: Tensor | None = None


def within_reach(found: Found, radar: RadarConfig) -> Found:
    """The same people, with the radar moved as far in front of the camera as needed to see them.

    Only if the camera was estimated: a user who specifies the camera also knows where the radar is. If people are out
    of reach of a radar beside the camera (:func:`~tensorsim.pipeline.reach.radar_ahead_m`), all people come nearer by
    that distance, and a TensorsimWarning is issued.
    """
    if found.camera is None:
        return found
    ahead_m = radar_ahead_m(found.pose.joints[0], found.pose.valid[0], radar)
    if ahead_m == 0:
        return found
    warnings.warn(
        f"people are beyond the {radar.reach_m:.2f} m of this radar's range axis: the radar is placed {ahead_m:.2f} m "
        "in front of the camera (with --camera-fov or --initial-distance it stays at the camera)",
        TensorsimWarning,
        stacklevel=2,
    )
    nearer = found.pose.joints - found.pose.joints.new_tensor([0.0, ahead_m, 0.0])
    return found._replace(pose=found.pose._replace(joints=nearer), radar_ahead_m=ahead_m)


def people_of_film(
    stage: VideoToPose,
    reader: VideoReader,
    device: torch.device,
    quiet: bool = False,
    calibrate: bool = False,
) -> Found:
    """Detect and track in a first pass over the video, estimate and lift poses in a second one.

    A moving camera causes a TensorsimWarning; if the camera is estimated, its rotation and zoom are compensated.

    Args:
        stage: with the networks.
        reader: of the video.
        device: to compute on.
        quiet: no progress bars.
        calibrate: estimate the camera from the people, see :func:`calibrated`, instead of using that of the stage.

    Returns:
        The people and the camera; the Pose is at ``reader.fps`` frames per second and, without ``calibrate``, equal to
        ``stage(video, fps)`` of the whole video, or ``stage(video, fps, times_s=...)`` if its frames are unevenly
        spaced.

    Raises:
        TensorsimError: the video has fewer than 2 frames.
    """
    detections, observed = detections_of_film(stage, reader, device, quiet)
    tracks = stage.follow(detections, observed)
    background = BackgroundMotion(reader.fps)
    keypoints, scores = keypoints_of_film(stage, reader, tracks, device, quiet, background)
    steps = steps_of_camera(reader, tracks, quiet) if calibrate and background.moves() else None
    if reader.uneven_times_s is not None:
        times_s = reader.uneven_times_s
        tracks, keypoints, scores = to_even_time(tracks, keypoints, scores, times_s[None], reader.fps)
        steps = None if steps is None else at_even_times(steps, times_s, reader.fps)
    size = reader.height, reader.width
    found = lifted_film(stage, tracks, keypoints, scores, size, reader.fps, calibrate, steps)
    background.warn(found.from_film is not None)
    return found._replace(background_px_s=background.shift_px_s)


def steps_of_camera(reader: VideoReader, tracks: Tracks, quiet: bool = False) -> Tensor | None:
    """How the background of a video moves from frame to frame, (T, 4); None if that is unclear.

    See :func:`~tensorsim.vision.calibration.stabilisation.camera_path`.
    """
    background = BackgroundMotion(reader.fps, 0.0)
    boxes, valid = tracks.boxes[0].transpose(0, 1), tracks.valid[0].transpose(0, 1)
    done = 0
    with progress_bar("camera", boxes.shape[0], quiet) as bar:
        for frames in reader.chunks(16):
            stop = done + frames.shape[0]
            background.add(frames, boxes[done:stop], valid[done:stop])
            bar.update(frames.shape[0])
            done = stop
    return background.steps()


def lifted_film(
    stage: VideoToPose,
    tracks: Tracks,
    keypoints: Tensor,
    scores: Tensor,
    size: tuple[int, int],
    fps: float,
    calibrate: bool,
    steps: Tensor | None = None,
) -> Found:
    """People of one video in metres.

    Args:
        stage: lifts them.
        tracks: of one clip (B = 1).
        keypoints: (1, P, T, 17, 2) pixels.
        scores: (1, P, T, 17).
        size: (height, width) of the frames.
        fps: frames per second.
        calibrate: estimate the camera from the people, see :func:`calibrated`, instead of using that of the stage.
        steps: (T, 4) background motion of a camera that turns and zooms, compensated unless it turns too far; used
            only with ``calibrate``.
    """
    if not calibrate:
        return Found(_on_cpu(stage.lift(tracks, keypoints, scores, *size, fps)))
    if steps is not None:
        still = _lifted_in_still_picture(stage, tracks, keypoints, scores, size, fps, steps)
        if still is not None:
            return still
    stage, camera = calibrated(stage, keypoints, scores, tracks.valid, size, fps)
    return Found(_on_cpu(stage.lift(tracks, keypoints, scores, *size, fps)), camera)


def _lifted_in_still_picture(
    stage: VideoToPose,
    tracks: Tracks,
    keypoints: Tensor,
    scores: Tensor,
    size: tuple[int, int],
    fps: float,
    steps: Tensor,
) -> Found | None:
    """:func:`lifted_film` for a moving camera; None if it turns too far."""

    def told(camera: CameraConfig) -> tuple[StillPicture, CameraEstimate] | None:
        """The stabilised picture, given this camera's field of view, and the camera estimated from it."""
        still = still_picture(tracks, keypoints, scores, size, steps, focal_length(camera, size[1]))
        if still is None:
            return None
        of_size = still.keypoints - still.margin.to(still.keypoints)
        return still, calibrated(stage, of_size, still.scores, tracks.valid, size, fps)[1]

    # Turn angles need the field of view, which can be estimated only once the turns are compensated: two rounds.
    usual = horizontal_fov(torch.tensor(USUAL_FOV_RAD, dtype=torch.float64), *size)
    first = told(CameraConfig(horizontal_fov_rad=float(usual)))
    second = None if first is None else told(camera_config(first[1]))
    if second is None:
        return None
    still, camera = second
    of_film = camera_config(camera)
    seen_by = stage.seen_by(replace(of_film, focal_px=focal_length(of_film, size[1])), known=False)
    pose = seen_by.lift(still.tracks, still.keypoints, still.scores, *still.size, fps)
    back = mapped(pose.keypoints - still.margin.to(pose.keypoints), still.from_film.inverse())
    pose = pose._replace(boxes=tracks.boxes, keypoints=back.to(keypoints.dtype))
    return Found(_on_cpu(pose), camera, from_film=still.from_film)


def _on_cpu(pose: Pose) -> Pose:
    return Pose(*(field.cpu() for field in pose))


def calibrated(
    stage: VideoToPose, keypoints: Tensor, scores: Tensor, valid: Tensor, size: tuple[int, int], fps: float
) -> tuple[VideoToPose, CameraEstimate]:
    """Estimate the camera from the people of one video; returns the stage for that camera, and the estimate.

    Args:
        stage: for another camera.
        keypoints: (1, P, T, 17, 2) pixels.
        scores: (1, P, T, 17).
        valid: (1, P, T) bool.
        size: (height, width) of the frames.
        fps: frames per second.
    """
    heights = stage.metric_pose.heights
    assert isinstance(heights, Tensor)
    calibrator = CameraCalibrator(tuple(heights.tolist()))
    found = with_reserve(
        calibrator.to(keypoints.device)(keypoints[0], scores[0], valid[0], *size, fps), *size
    )
    return stage.seen_by(camera_config(found), known=False), found


def detections_of_film(
    stage: VideoToPose, reader: VideoReader, device: torch.device, quiet: bool = False
) -> tuple[Detections, Tensor]:
    """Detections (n, K) in the observed frames of a video, and which frames were observed (1, T).

    Raises:
        TensorsimError: the video has fewer than 2 frames.
    """
    interval, size = stage.interval_at(reader.fps), stage.frames_per_batch
    found: list[Detections] = []
    count = 0
    last = torch.empty(0)

    def parts() -> Iterator[tuple[int, Tensor, Tensor]]:
        for frames in reader.chunks(size * interval):
            # Copies, so that the other frames can be freed; chunks begin at multiples of the interval.
            yield frames.shape[0], frames[::interval].clone(), frames[-1:].clone()

    def detected(part: tuple[int, Tensor, Tensor]) -> tuple[int, Tensor, Detections]:
        length, frames, final = part
        return length, final, stage.detect(frames.to(device))

    with progress_bar("detect", reader.frame_count, quiet) as bar:
        for length, final, detections in spread(detected, parts(), device):
            found.append(detections)
            last = final
            count += length
            bar.update(length)
        bar.total = count
    if count < 2:
        raise TensorsimError(
            f"{reader.path}: got {count} frame, expected at least 2: motion needs two moments"
        )
    if (count - 1) % interval:
        found.append(stage.detect(last.to(device)))
    whole = joined(found)
    present = stage.frames_present(1, count, None, whole.boxes.device)
    return whole, stage.observed_frames(present, reader.fps)


def keypoints_of_film(
    stage: VideoToPose,
    reader: VideoReader,
    tracks: Tracks,
    device: torch.device,
    quiet: bool = False,
    background: BackgroundMotion | None = None,
) -> tuple[Tensor, Tensor]:
    """COCO keypoints (1, P, T, 17, 2) of the tracked people of a video, and their scores (1, P, T, 17).

    ``background`` receives the frames as well.
    """
    boxes, valid = tracks.boxes[0].transpose(0, 1), tracks.valid[0].transpose(0, 1)
    keypoints: list[Tensor] = []
    scores: list[Tensor] = []

    def parts() -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        done = 0
        for frames in reader.chunks(stage.frames_per_batch):
            stop = done + frames.shape[0]
            yield frames, boxes[done:stop], valid[done:stop]
            done = stop

    def estimated(part: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, ...]:
        frames, box, there = part
        return *part, *stage.estimate(frames.to(device), box, there)

    with progress_bar("pose", boxes.shape[0], quiet) as bar:
        for frames, box, there, k, s in spread(estimated, parts(), device):
            keypoints.append(k)
            scores.append(s)
            if background is not None:
                background.add(frames, box, there)
            picture("film", partial(_drawn, frames, box, k, s, there, stage.keypoint_threshold))
            bar.update(frames.shape[0])
    return torch.cat(keypoints).transpose(0, 1).unsqueeze(0), torch.cat(scores).transpose(0, 1).unsqueeze(0)


def _drawn(
    frames: Tensor, boxes: Tensor, keypoints: Tensor, scores: Tensor, valid: Tensor, threshold: float
) -> np.ndarray:
    """Draw the people on the last of some frames (n, 3, H, W)."""
    box, points, point_scores, there = (x[-1].cpu().numpy() for x in (boxes, keypoints, scores, valid))
    frame = frames[-1].permute(1, 2, 0).numpy()
    return plot.draw_people(frame, box, points, point_scores, there, threshold)


def maps_of_pose(
    stage: PoseToDoppler, pose: Pose, fps: float, device: torch.device, quiet: bool = False
) -> RadarMaps:
    """Maps (on the CPU, without a batch dimension) of the first clip of ``pose``, streamed over pulses."""
    joints, valid = pose.joints[:1].to(device), pose.valid[:1].to(device)
    pulses = stage.resampler.pulses(joints.shape[2], fps)
    coefficients = stage.curve(joints, valid, fps)
    if bool((valid & (stage.heard(joints) == 0)).any()):
        warnings.warn(
            f"people are farther away than {stage.unheard_m:.1f} m, 1.9 times the range axis of this radar: the "
            "receiver filters out their echo, so they do not appear in any map",
            TensorsimWarning,
            stacklevel=2,
        )

    # The simulator passes over the motion twice: once for the noise level, once for the maps.
    with progress_bar("radar", 2 * pulses, quiet) as bar:
        bar.unit = "pulse"

        def source(start: int, stop: int) -> tuple[Tensor, Tensor]:
            points, rcs = stage.scene(coefficients, valid, fps, start, stop)
            bar.update(stop - start)
            return points[0], rcs[0]

        maps = stage.simulator.stream(source, pulses)
    return RadarMaps(*(field.cpu() for field in stage.denoise(maps)))
