"""A film through the pipeline, streamed: two passes over the file, so that memory does not grow with its length."""

import json
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from tensorsim import plot
from tensorsim.data.video import VideoReader, write_video
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.pipeline import PoseToDoppler, VideoToPose
from tensorsim.types import Detections, Pose, RadarMaps


def _bar(name: str, total: int | None, quiet: bool) -> tqdm:
    return tqdm(desc=f"{name:<12}", total=total, disable=quiet, unit="frame", leave=True)


def pose_of_film(stage: VideoToPose, reader: VideoReader, device: torch.device, quiet: bool = False) -> Pose:
    """Detect and track in a first pass over the film, estimate and lift poses in a second one.

    Returns:
        The Pose of one clip (B = 1) on the CPU; equal to ``stage(video, fps)`` of the whole film.

    Raises:
        TensorsimError: the film has fewer than 2 frames.
    """
    interval, size = stage.detection_interval, stage.frames_per_batch
    found: list[Detections] = []
    count = 0
    last = torch.empty(0)
    with _bar("detect", reader.frame_count, quiet) as bar:
        for frames in reader.chunks(size * interval):
            index = torch.arange(count, count + frames.shape[0])
            if bool((index % interval == 0).any()):
                found.append(stage.detect(frames[index % interval == 0].to(device)))
            count += frames.shape[0]
            last = frames[-1:].clone()
            bar.update(frames.shape[0])
        bar.total = count
    if count < 2:
        raise TensorsimError(
            f"{reader.path}: got {count} frame, expected at least 2: motion needs two moments"
        )
    if (count - 1) % interval:
        found.append(stage.detect(last.to(device)))
    whole = Detections(*(torch.cat(parts) for parts in zip(*found, strict=True)))
    observed = stage.observed_frames(stage.frames_present(1, count, None, whole.boxes.device))
    tracks = stage.follow(whole, observed)

    boxes, valid = tracks.boxes[0].transpose(0, 1), tracks.valid[0].transpose(0, 1)
    keypoints: list[Tensor] = []
    scores: list[Tensor] = []
    done = 0
    with _bar("pose", count, quiet) as bar:
        for frames in reader.chunks(size):
            stop = done + frames.shape[0]
            k, s = stage.estimate(frames.to(device), boxes[done:stop], valid[done:stop])
            keypoints.append(k)
            scores.append(s)
            done = stop
            bar.update(frames.shape[0])
    all_keypoints = torch.cat(keypoints).transpose(0, 1).unsqueeze(0)
    all_scores = torch.cat(scores).transpose(0, 1).unsqueeze(0)
    pose = stage.lift(tracks, all_keypoints, all_scores, reader.height, reader.width, reader.fps)
    return Pose(*(field.cpu() for field in pose))


def maps_of_pose(
    stage: PoseToDoppler, pose: Pose, fps: float, device: torch.device, quiet: bool = False
) -> RadarMaps:
    """Maps (on the CPU, without a batch dimension) of the first clip of ``pose``, streamed over pulses."""
    joints, valid = pose.joints[:1].to(device), pose.valid[:1].to(device)
    pulses = stage.resampler.pulses(joints.shape[2], fps)
    coefficients = stage.resampler.coefficients(joints, fps)

    with _bar("radar", pulses, quiet) as bar:
        bar.unit = "pulse"

        def source(start: int, stop: int) -> tuple[Tensor, Tensor]:
            points, rcs = stage.scene(coefficients, valid, fps, start, stop)
            bar.update(max(0, stop - bar.n))
            return points[0], rcs[0]

        maps = stage.simulator.stream(source, pulses)
    return RadarMaps(*(field.cpu() for field in stage.denoise(maps)))


@contextmanager
def complete_or_nothing(out: Path) -> Iterator[Path]:
    """A scratch folder whose files move to ``out`` when the block ends well; otherwise nothing remains of it."""
    out.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}-"))
    try:
        yield scratch
        out.mkdir(exist_ok=True)
        for file in scratch.iterdir():
            os.replace(file, out / file.name)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


@dataclass(frozen=True)
class Axes:
    """Axes of a set of maps.

    Attributes:
        range_m: (R,).
        doppler_hz: (F,), positive = approaching.
        time_s: (K,) centres of the Doppler-time columns.
        range_time_rate_hz: columns of the range-time maps per second.
        speed_per_hz: m/s per Hz of Doppler.
    """

    range_m: np.ndarray
    doppler_hz: np.ndarray
    time_s: np.ndarray
    range_time_rate_hz: float
    speed_per_hz: float


def axes_of(stage: PoseToDoppler, maps: RadarMaps) -> Axes:
    """Axes of the maps that this stage made."""
    simulator = stage.simulator
    doppler = simulator.doppler
    pulses = doppler.length + (maps.doppler_time.shape[-1] - 1) * doppler.hop
    # What the two-pulse canceller gives lies between the two pulses that it subtracts.
    delay_s = simulator.mti.delay_pulses / simulator.radar.prf_hz
    return Axes(
        range_m=simulator.range_profile.range_m.cpu().numpy(),
        doppler_hz=doppler.doppler_hz.cpu().numpy(),
        time_s=doppler.frame_times_s(pulses).cpu().numpy() + delay_s,
        range_time_rate_hz=simulator.radar.prf_hz / simulator.range_time_block,
        speed_per_hz=simulator.radar.doppler_wavelength_m / 2,
    )


def write_maps(folder: Path, maps: RadarMaps, axes: Axes) -> None:
    """Write ``maps.npz`` and a PNG per map."""
    range_time, mti = maps.range_time.numpy(), maps.range_time_mti.numpy()
    doppler_time = maps.doppler_time.numpy()
    ridges_hz = axes.doppler_hz[maps.ridges.numpy()]
    # In the picture a ridge ends where it is no more than noise at the floor of the colours.
    strong = maps.ridge_magnitudes.numpy() > doppler_time.max(initial=0.0) * 10 ** (
        -plot.DYNAMIC_RANGE_DB / 20
    )
    np.savez(
        folder / "maps.npz",
        range_time=range_time,
        range_time_mti=mti,
        doppler_time=doppler_time,
        ridges_hz=ridges_hz,
        range_m=axes.range_m,
        doppler_hz=axes.doppler_hz,
        time_s=axes.time_s,
        range_time_rate_hz=axes.range_time_rate_hz,
    )
    for name, title, magnitude in (
        ("range_time", "range-time map", range_time),
        ("range_time_mti", "range-time map after moving target indication", mti),
    ):
        # The same half pulse as above; none is left at a display rate.
        offset = (range_time.shape[1] - magnitude.shape[1]) / 2
        time_s = (np.arange(magnitude.shape[1]) + offset) / axes.range_time_rate_hz
        plot.save_figure(
            plot.map_figure(magnitude, time_s, axes.range_m, title, "range in m"), folder / f"{name}.png"
        )
    # Show the part of the Doppler axis that has something to show.
    shown = np.abs(axes.doppler_hz)[
        (plot.decibels(doppler_time, plot.DYNAMIC_RANGE_DB) > -plot.DYNAMIC_RANGE_DB).any(1)
    ]
    plot.save_figure(
        plot.map_figure(
            doppler_time,
            axes.time_s,
            axes.doppler_hz,
            "Doppler-time map",
            "Doppler in Hz, positive = approaching",
            ridges=np.where(strong, ridges_hz, np.nan),
            speed_per_axis=axes.speed_per_hz,
            half_span=1.25 * float(shown.max(initial=axes.doppler_hz[-1] / 8)),
        ),
        folder / "doppler_time.png",
    )


def write_pose(folder: Path, pose: Pose, fps: float) -> None:
    """Write ``pose.npz`` and a picture of the skeletons in the world."""
    joints, valid = pose.joints[0].numpy(), pose.valid[0].numpy()
    np.savez(
        folder / "pose.npz",
        joints_m=joints,
        keypoints_px=pose.keypoints[0].numpy(),
        keypoint_scores=pose.keypoint_scores[0].numpy(),
        boxes_px=pose.boxes[0].numpy(),
        valid=valid,
        fps=fps,
    )
    plot.save_figure(plot.skeleton_figure(joints, valid, fps), folder / "skeleton.png")


def write_overlay(
    folder: Path, reader: VideoReader, pose: Pose, threshold: float, quiet: bool = False
) -> None:
    """Write ``overlay.mp4``: the film with boxes, ids and skeletons."""
    boxes, keypoints = pose.boxes[0].numpy(), pose.keypoints[0].numpy()
    scores, valid = pose.keypoint_scores[0].numpy(), pose.valid[0].numpy()

    def drawn() -> Iterator[np.ndarray]:
        index = 0
        with _bar("overlay", valid.shape[1], quiet) as bar:
            for frames in reader.chunks(8):
                for frame in frames.permute(0, 2, 3, 1).numpy():
                    yield plot.draw_people(
                        frame,
                        boxes[:, index],
                        keypoints[:, index],
                        scores[:, index],
                        valid[:, index],
                        threshold,
                    )
                    index += 1
                    bar.update(1)

    write_video(folder / "overlay.mp4", drawn(), reader.fps)


def people_of(pose: Pose, fps: float) -> list[dict[str, Any]]:
    """One row per person: when it is in the scene, how far, and how fast its torso approaches."""
    rows = []
    for person in range(pose.joints.shape[1]):
        frames = torch.nonzero(pose.valid[0, person]).flatten()
        torso = pose.joints[0, person, frames][:, [1, 8, 11]].double().mean(dim=1)
        duration_s = max(float(frames[-1] - frames[0]) / fps, 1 / fps)
        rows.append(
            {
                "id": person + 1,
                "first_frame": int(frames[0]),
                "last_frame": int(frames[-1]),
                "mean_range_m": round(float(torso.norm(dim=-1).mean()), 3),
                "mean_approach_m_s": round(float(torso[0, 1] - torso[-1, 1]) / duration_s, 3),
            }
        )
    return rows


def write_summary(folder: Path, summary: dict[str, Any]) -> None:
    """Write ``summary.json``."""
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


@contextmanager
def collected_warnings() -> Iterator[list[str]]:
    """The messages of tensorsim's own warnings in the block, each once; other warnings pass through."""
    messages: list[str] = []
    show = warnings.showwarning

    def collect(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if not issubclass(category, TensorsimWarning):
            show(message, category, *rest, **more)
        elif str(message) not in messages:
            messages.append(str(message))

    with warnings.catch_warnings():
        warnings.simplefilter("always", TensorsimWarning)
        warnings.showwarning = collect
        yield messages
