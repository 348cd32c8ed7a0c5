"""A contact sheet of a film: pictures with the people found, Doppler-time maps, and positions of people."""

import math
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from tensorsim import plot
from tensorsim.body.skeleton import mid_hips
from tensorsim.data.video import VideoReader
from tensorsim.evaluation.labelled_films import LabelledFilm, Verdict
from tensorsim.results import Axes
from tensorsim.streaming import Found
from tensorsim.types import Pose, RadarMaps
from tensorsim.vision.calibration.calibrator import CameraEstimate, camera_config

if TYPE_CHECKING:
    import matplotlib.axes
    from matplotlib.figure import Figure

_COLUMNS, _ROWS = 4, 2
#: Maximum number of people in the legend.
_NAMED = 5


def contact_sheet(
    film: LabelledFilm,
    reader: VideoReader,
    found: Found,
    threshold: float,
    scenes: list[tuple[Verdict, RadarMaps | None, Axes | None]],
) -> "Figure":
    """Draw the sheet; all times are those of the film.

    Args:
        film: the labelled film.
        reader: reads the frames that ``found.pose`` belongs to.
        found: the people of one clip, and the camera whose floor is drawn; a camera of None draws no floor.
        threshold: score from which a keypoint is drawn.
        scenes: for each scene, the verdict, and its maps with their axes if there are any.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 11), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(_ROWS + 1, 12, height_ratios=[1.0] * _ROWS + [1.3])
    pose, camera = found.pose, found.camera
    count = pose.valid.shape[2]
    chosen = np.unique(np.linspace(0, count - 1, _ROWS * _COLUMNS).round().astype(int))
    for place, (index, picture) in enumerate(_pictures(reader, found, threshold, set(chosen.tolist()))):
        row, column = divmod(place, _COLUMNS)
        axes = figure.add_subplot(grid[row, 3 * column : 3 * column + 3])
        axes.imshow(picture)
        axes.set_title(f"{film.start_s + index / reader.fps:.2f} s", fontsize=9)
        axes.set_axis_off()
    width = 12 // (len(scenes) + 1)
    for place, (verdict, maps, map_axes) in enumerate(scenes):
        axes = figure.add_subplot(grid[_ROWS, place * width : (place + 1) * width])
        _draw_map(axes, verdict, maps, map_axes, film.start_s)
    _draw_places(figure.add_subplot(grid[_ROWS, len(scenes) * width :]), pose, reader.fps, film.start_s)
    figure.suptitle(f"{film.file}: {' or '.join(film.accept)}{_said_of(camera)}", parse_math=False)
    return figure


def _said_of(camera: CameraEstimate | None) -> str:
    """The camera in words."""
    if camera is None:
        return ""
    said = "\ncamera"
    for name, value, sd in (
        ("tilt", -camera.pitch_rad, camera.pitch_sd_rad),
        ("roll", camera.roll_rad, camera.roll_sd_rad),
        ("field of view", camera.horizontal_fov_rad, camera.horizontal_fov_sd_rad),
    ):
        said += f" {name} {math.degrees(float(value)):.0f} +- {math.degrees(float(sd)):.0f} deg,"
    return f"{said} height {float(camera.height_m):.1f} +- {float(camera.height_sd_m):.1f} m"


def _pictures(
    reader: VideoReader, found: Found, threshold: float, chosen: set[int]
) -> list[tuple[int, np.ndarray]]:
    """The chosen frames with their numbers, people drawn on them."""
    pose, camera = found.pose, found.camera
    to_film = None if found.from_film is None else found.from_film.inverse().numpy()
    boxes, keypoints, scores, valid = (
        part[0].numpy() for part in (pose.boxes, pose.keypoints, pose.keypoint_scores, pose.valid)
    )
    drawn = []
    index = 0
    for frames in reader.even_chunks(16):
        for frame in frames:
            if index in chosen:
                picture = _small(frame)
                scale = picture.shape[1] / frame.shape[-1]
                if camera is not None:
                    resized = np.diag([scale, scale, 1.0])
                    moved = None if to_film is None else resized @ to_film[index] @ np.linalg.inv(resized)
                    picture = plot.draw_floor(picture, camera_config(camera), moved)
                drawn.append(
                    (
                        index,
                        plot.draw_people(
                            picture,
                            boxes[:, index] * scale,
                            keypoints[:, index] * scale,
                            scores[:, index],
                            valid[:, index],
                            threshold,
                        ),
                    )
                )
            index += 1
    return drawn


def _small(frame: Tensor, width: int = 640) -> np.ndarray:
    """A frame (3, H, W) as (h, w, 3), at most ``width`` pixels wide."""
    import cv2

    picture = np.ascontiguousarray(frame.permute(1, 2, 0).numpy())
    if picture.shape[1] <= width:
        return picture
    height = round(picture.shape[0] * width / picture.shape[1])
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


def _draw_map(
    axes: "matplotlib.axes.Axes",
    verdict: Verdict,
    maps: RadarMaps | None,
    map_axes: Axes | None,
    start_s: float,
) -> None:
    said = "no map" if verdict.label is None else f"{verdict.label} {verdict.probability:.2f}"
    axes.set_title(f"{verdict.scene}: {said}", fontsize=10, color="tab:green" if verdict.right else "tab:red")
    if maps is None or map_axes is None:
        said = fill(verdict.error or "", 60)  # it may name the film
        axes.text(0.5, 0.5, said, ha="center", va="center", fontsize=8, parse_math=False)
        axes.set_axis_off()
        return
    speed = map_axes.doppler_hz * map_axes.speed_per_hz
    level = plot.decibels(maps.doppler_time.numpy(), 40.0)
    time_s = map_axes.time_s + start_s
    extent = (time_s[0], time_s[-1], speed[0], speed[-1])
    axes.imshow(level, origin="lower", aspect="auto", cmap="turbo", extent=extent, vmin=-40, vmax=0)
    span = min(6.0, float(speed[-1]))
    axes.set(ylim=(-span, span), xlabel="time of the film in s", ylabel="radial speed in m/s")


def _draw_places(axes: "matplotlib.axes.Axes", pose: Pose, fps: float, start_s: float) -> None:
    """Range and height of the hips and height of the head of every person over time."""
    time_s = start_s + np.arange(pose.valid.shape[2]) / fps
    for person in range(pose.valid.shape[1]):
        there = pose.valid[0, person].numpy()
        joints = pose.joints[0, person].numpy()
        hips = mid_hips(pose.joints[0, person]).numpy()
        colour = np.array(plot.PERSON_COLOURS[person % len(plot.PERSON_COLOURS)]) / 255
        label = f"person {person + 1}" if person < _NAMED else None
        axes.plot(time_s, np.where(there, hips[:, 1], np.nan), "-", color=colour, label=label)
        axes.plot(time_s, np.where(there, joints[:, 0, 2], np.nan), ":", color=colour)
        axes.plot(time_s, np.where(there, hips[:, 2], np.nan), "--", color=colour)
    axes.set_title("range (line), height of head (dots) and hips (dashes)", fontsize=10)
    axes.set(xlabel="time of the film in s", ylabel="m", ylim=(-0.5, 10.0))
    axes.grid(visible=True, alpha=0.3)
    if pose.valid.shape[1]:
        axes.legend(fontsize=7, loc="upper right")
