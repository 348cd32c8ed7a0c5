"""Long films, frame by frame, and long motion, pulse by pulse: memory does not grow with their length."""

import warnings
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tensorsim import plot
from tensorsim.config import RadarConfig
from tensorsim.data.video import VideoReader
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.pipeline import PoseToDoppler, VideoToPose
from tensorsim.pipeline.reach import radar_ahead_m
from tensorsim.progress import picture, progress_bar
from tensorsim.threads import spread
from tensorsim.types import Detections, Pose, RadarMaps, Tracks
from tensorsim.vision.calibration.calibrator import (
    CameraCalibrator,
    CameraEstimate,
    camera_config,
    with_reserve,
)
from tensorsim.vision.calibration.camera_motion import BackgroundMotion
from tensorsim.vision.smoothing.even_time import to_even_time


class Found(NamedTuple):
    """Who was found, and what of the camera.

    Attributes:
        pose: of one clip (B = 1), on the CPU.
        camera: as estimated from the people; None where it was not.
        background_px_s: how far the background shifts within a second at most, in pixels of the film; None where
            that is not known.
        radar_ahead_m: how far in front of the camera the radar stands, see :func:`within_reach`.
    """

    pose: Pose
    camera: CameraEstimate | None = None
    background_px_s: float | None = None
    radar_ahead_m: float = 0.0


def within_reach(found: Found, radar: RadarConfig) -> Found:
    """The same people before a radar that stands as far in front of the camera as it takes to see them.

    Only where the camera was estimated: who tells where it is knows where the radar is. People whom the radar does not
    see from beside the camera (:func:`~tensorsim.pipeline.reach.radar_ahead_m`) are nearer by as much, which a
    TensorsimWarning says.
    """
    if found.camera is None:
        return found
    ahead_m = radar_ahead_m(found.pose.joints[0], found.pose.valid[0], radar)
    if ahead_m == 0:
        return found
    warnings.warn(
        f"people are beyond the {radar.reach_m:.2f} m of this radar's range axis: the radar is put {ahead_m:.1f} m in "
        "front of the camera (--camera-fov or --initial-distance leaves it there)",
        TensorsimWarning,
        stacklevel=2,
    )
    there = found.pose.valid[..., None, None]
    nearer = found.pose.joints - there * found.pose.joints.new_tensor([0.0, ahead_m, 0.0])
    return found._replace(pose=found.pose._replace(joints=nearer), radar_ahead_m=ahead_m)


def people_of_film(
    stage: VideoToPose,
    reader: VideoReader,
    device: torch.device,
    quiet: bool = False,
    calibrate: bool = False,
) -> Found:
    """Detect and track in a first pass over the film, estimate and lift poses in a second one.

    A camera that moves is said in a TensorsimWarning.

    Args:
        stage: with the networks.
        reader: of the film.
        device: to compute on.
        quiet: no progress bars.
        calibrate: estimate the camera from the people, see :func:`calibrated`, in place of that of the stage.

    Returns:
        The people and the camera; the Pose is at ``reader.fps`` frames per second and equal to ``stage(video, fps)`` of
        the whole film, or ``stage(video, fps, times_s=...)`` where its frames are at uneven times.

    Raises:
        TensorsimError: the film has fewer than 2 frames.
    """
    detections, observed = detections_of_film(stage, reader, device, quiet)
    tracks = stage.follow(detections, observed)
    background = BackgroundMotion(reader.fps)
    keypoints, scores = keypoints_of_film(stage, reader, tracks, device, quiet, background)
    background.warn()
    size = reader.height, reader.width
    if reader.uneven_times_s is not None:
        times_s = reader.uneven_times_s[None]
        tracks, keypoints, scores = to_even_time(tracks, keypoints, scores, times_s, reader.fps)
    camera = None
    if calibrate:
        stage, camera = calibrated(stage, keypoints, scores, tracks.valid, size, reader.fps)
    pose = stage.lift(tracks, keypoints, scores, *size, reader.fps)
    return Found(Pose(*(field.cpu() for field in pose)), camera, background.shift_px_s)


def calibrated(
    stage: VideoToPose, keypoints: Tensor, scores: Tensor, valid: Tensor, size: tuple[int, int], fps: float
) -> tuple[VideoToPose, CameraEstimate]:
    """The stage for the camera that the people of one film tell, and what they tell.

    Args:
        stage: of another camera.
        keypoints: (1, P, T, 17, 2) pixels.
        scores: (1, P, T, 17).
        valid: (1, P, T) bool.
        size: (height, width) of the pictures.
        fps: frames per second.
    """
    heights = stage.metric_pose.heights
    assert isinstance(heights, Tensor)
    calibrator = CameraCalibrator(tuple(heights.tolist()))
    found = with_reserve(calibrator.to(keypoints.device)(keypoints[0], scores[0], valid[0], *size, fps))
    return stage.seen_by(camera_config(found), known=False), found


def detections_of_film(
    stage: VideoToPose, reader: VideoReader, device: torch.device, quiet: bool = False
) -> tuple[Detections, Tensor]:
    """Detections (n, K) of the observed frames of a film, and which frames were observed (1, T).

    Raises:
        TensorsimError: the film has fewer than 2 frames.
    """
    interval, size = stage.detection_interval, stage.frames_per_batch
    found: list[Detections] = []
    count = 0
    last = torch.empty(0)

    def parts() -> Iterator[tuple[int, Tensor, Tensor]]:
        for frames in reader.chunks(size * interval):
            # Copies, so that the other frames need no memory; chunks begin at multiples of the interval.
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
    whole = Detections(*(torch.cat(field) for field in zip(*found, strict=True)))
    return whole, stage.observed_frames(stage.frames_present(1, count, None, whole.boxes.device))


def keypoints_of_film(
    stage: VideoToPose,
    reader: VideoReader,
    tracks: Tracks,
    device: torch.device,
    quiet: bool = False,
    background: BackgroundMotion | None = None,
) -> tuple[Tensor, Tensor]:
    """COCO keypoints (1, P, T, 17, 2) of tracked people of a film and their scores (1, P, T, 17).

    ``background`` is given the frames as well.
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
    """The last of some frames (n, 3, H, W) with its people."""
    box, points, point_scores, there = (x[-1].cpu().numpy() for x in (boxes, keypoints, scores, valid))
    frame = frames[-1].permute(1, 2, 0).numpy()
    return plot.draw_people(frame, box, points, point_scores, there, threshold)


def maps_of_pose(
    stage: PoseToDoppler, pose: Pose, fps: float, device: torch.device, quiet: bool = False
) -> RadarMaps:
    """Maps (on the CPU, without a batch dimension) of the first clip of ``pose``, streamed over pulses."""
    joints, valid = pose.joints[:1].to(device), pose.valid[:1].to(device)
    pulses = stage.resampler.pulses(joints.shape[2], fps)
    coefficients = stage.resampler.coefficients(joints, fps)

    # The simulator passes over the motion twice: for the level of the noise, and for the maps.
    with progress_bar("radar", 2 * pulses, quiet) as bar:
        bar.unit = "pulse"

        def source(start: int, stop: int) -> tuple[Tensor, Tensor]:
            points, rcs = stage.scene(coefficients, valid, fps, start, stop)
            bar.update(stop - start)
            return points[0], rcs[0]

        maps = stage.simulator.stream(source, pulses)
    return RadarMaps(*(field.cpu() for field in stage.denoise(maps)))
