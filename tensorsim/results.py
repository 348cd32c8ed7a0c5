"""What a simulation writes into its folder: maps, poses, pictures and the overlay video."""

import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from tensorsim import plot
from tensorsim.array_files import save_arrays
from tensorsim.config import CameraConfig, RadarConfig, SimulationConfig
from tensorsim.data.sound import doppler_sound, slow_time_signal, write_sound
from tensorsim.data.video_writer import VideoWriter
from tensorsim.device import one_thread
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.pipeline import PoseToDoppler, warn_of_empty_clips
from tensorsim.plot.apart import Drawing
from tensorsim.progress import picture, progress_bar
from tensorsim.report.film import FilmStrip
from tensorsim.streaming import Found, maps_of_pose, within_reach
from tensorsim.threads import beside
from tensorsim.types import Pose, RadarMaps
from tensorsim.vision.calibration.calibrator import camera_config
from tensorsim.vision.tracking.selection import select_people

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tensorsim.sources import Source


@dataclass(frozen=True)
class Axes:
    """Axes of a set of maps.

    Attributes:
        range_m: (R,).
        doppler_hz: (F,), positive = approaching if ``signed``.
        time_s: (K,) centres of the Doppler-time columns.
        range_time_rate_hz: columns of the range-time maps per second.
        speed_per_hz: speed in m/s per Hz of Doppler.
        block: pulses per column of the range-time maps.
        signed: whether the Doppler-time map distinguishes approaching from receding; the paper's does not.
    """

    range_m: np.ndarray
    doppler_hz: np.ndarray
    time_s: np.ndarray
    range_time_rate_hz: float
    speed_per_hz: float
    block: int = 1
    signed: bool = True

    @property
    def doppler_label(self) -> str:
        """Label of the Doppler axis."""
        return "Doppler in Hz, " + ("positive = approaching" if self.signed else "without its sign")

    def range_time_s(self, columns: int) -> np.ndarray:
        """Times (columns,) of the centres of the range-time columns."""
        return (np.arange(columns) + (self.block - 1) / (2 * self.block)) / self.range_time_rate_hz


def axes_of(stage: PoseToDoppler, maps: RadarMaps) -> Axes:
    """Axes of maps made by this stage."""
    simulator = stage.simulator
    doppler = simulator.doppler
    pulses = doppler.length + (maps.doppler_time.shape[-1] - 1) * doppler.hop
    # The output of the two-pulse canceller lies midway between the two pulses that it subtracts.
    delay_s = simulator.mti.delay_pulses / simulator.radar.prf_hz
    return Axes(
        range_m=simulator.range_profile.range_m.cpu().numpy(),
        doppler_hz=doppler.doppler_hz.cpu().numpy(),
        time_s=doppler.frame_times_s(pulses).cpu().numpy() + delay_s,
        range_time_rate_hz=simulator.radar.prf_hz / simulator.range_time_block,
        speed_per_hz=simulator.radar.doppler_wavelength_m / 2,
        block=simulator.range_time_block,
        signed=doppler.integration != "paper",
    )


@dataclass(frozen=True)
class Pictures:
    """How the maps of a run are drawn.

    Attributes:
        style: colours and dynamic range.
        suffix: file format, one of ``tensorsim.plot.FIGURE_FORMATS``.
        subtitle: a line below the titles.
        peaks: magnitudes of 0 dB by map, for a scene without people; None: each map's own peak.
    """

    style: plot.MapStyle = field(default_factory=plot.MapStyle)
    suffix: str = "png"
    subtitle: str | None = None
    peaks: dict[str, float] | None = None

    def peak(self, name: str) -> float | None:
        """The magnitude of 0 dB of this map; None: its own peak."""
        return None if self.peaks is None else self.peaks[name]

    def options(self, name: str) -> dict[str, Any]:
        """Arguments of :func:`tensorsim.plot.map_figure` for this map."""
        note = None if self.peaks is None else "no person in the scene"
        return {"style": self.style, "subtitle": self.subtitle, "peak": self.peak(name), "note": note}


def draw_maps(
    folder: Path,
    maps: RadarMaps,
    axes: Axes,
    drawing: Drawing,
    truth: RadarMaps | None = None,
    pictures: Pictures = Pictures(),  # immutable
) -> None:
    """Draw a picture per map.

    Args:
        folder: where to write them.
        maps: on the CPU, without batch dimensions.
        axes: of the maps.
        drawing: draws them.
        truth: maps of the true motion, of the same shapes, drawn beside the others.
        pictures: how they are drawn.
    """
    for name, title in (
        ("range_time", "range-time map"),
        ("range_time_mti", "range-time map after moving target indication"),
    ):
        magnitude = getattr(maps, name).numpy()
        # The output of the two-pulse canceller lies half a pulse later; with a display rate there is no such offset.
        offset = (maps.range_time.shape[1] - magnitude.shape[1]) / 2
        time_s = axes.range_time_s(magnitude.shape[1]) + offset / axes.range_time_rate_hz
        reference = None if truth is None else getattr(truth, name).numpy()
        drawing.draw(
            partial(
                plot.map_figure,
                magnitude,
                time_s,
                axes.range_m,
                title,
                "range in m",
                reference=reference,
                **pictures.options(name),
            ),
            folder / f"{name}.{pictures.suffix}",
        )
    drawing.draw(doppler_figure(maps, axes, pictures, truth), folder / f"doppler_time.{pictures.suffix}")


def doppler_figure(
    maps: RadarMaps, axes: Axes, pictures: Pictures, truth: RadarMaps | None = None
) -> "partial[Figure]":
    """A function that draws a Doppler-time map with its ridges, and beside it that of the true motion, if given."""
    both = [maps] if truth is None else [maps, truth]
    range_db = pictures.style.dynamic_range_db
    return partial(
        plot.map_figure,
        maps.doppler_time.numpy(),
        axes.time_s,
        axes.doppler_hz,
        "Doppler-time map",
        axes.doppler_label,
        ridges=strong_ridges(maps, axes),
        speed_per_axis=axes.speed_per_hz,
        half_span=max(plot.doppler_span(one.doppler_time.numpy(), axes.doppler_hz, range_db) for one in both),
        reference=None if truth is None else truth.doppler_time.numpy(),
        reference_ridges=None if truth is None else strong_ridges(truth, axes),
        **pictures.options("doppler_time"),
    )


def save_maps(path: Path, maps: RadarMaps, axes: Axes, formats: Sequence[str] = ("npz",)) -> None:
    """Write maps and their axes.

    Args:
        path: without a suffix.
        maps: on the CPU, without batch dimensions.
        axes: of the maps.
        formats: see :func:`~tensorsim.array_files.save_arrays`.
    """
    arrays = {
        "range_time": maps.range_time.numpy(),
        "range_time_mti": maps.range_time_mti.numpy(),
        "doppler_time": maps.doppler_time.numpy(),
        "ridges_hz": axes.doppler_hz[maps.ridges.numpy()],
        "range_m": axes.range_m,
        "doppler_hz": axes.doppler_hz,
        "time_s": axes.time_s,
        "range_time_s": axes.range_time_s(maps.range_time.shape[1]),
        "range_time_rate_hz": axes.range_time_rate_hz,
    }
    save_arrays(path, arrays, formats)


def strong_ridges(maps: RadarMaps, axes: Axes) -> np.ndarray:
    """Ridges (3, K) in Hz, NaN where they are no stronger than the floor of the colour scale."""
    floor = float(maps.doppler_time.max()) * 10 ** (-plot.DYNAMIC_RANGE_DB / 20)
    return np.where(maps.ridge_magnitudes.numpy() > floor, axes.doppler_hz[maps.ridges.numpy()], np.nan)


def write_doppler_sound(
    folder: Path, stage: PoseToDoppler, pose: Pose, fps: float, device: torch.device
) -> None:
    """Write ``doppler.wav``, the micro-Doppler of the scene as sound: approaching left, receding right."""
    joints, valid = pose.joints[:1].to(device), pose.valid[:1].to(device)
    coefficients = stage.curve(joints, valid, fps)

    def source(start: int, stop: int) -> tuple[Tensor, Tensor]:
        points, rcs = stage.scene(coefficients, valid, fps, start, stop)
        return points[0], rcs[0]

    signal = slow_time_signal(stage.simulator, source, stage.resampler.pulses(joints.shape[2], fps))
    write_sound(folder / "doppler.wav", doppler_sound(signal.cpu(), stage.simulator.radar.prf_hz))


def save_pose(folder: Path, pose: Pose, fps: float, formats: Sequence[str] = ("npz",)) -> None:
    """Write ``pose.npz``, or the same in other formats (:func:`~tensorsim.array_files.save_arrays`)."""
    arrays: dict[str, np.ndarray | float] = {
        "joints_m": pose.joints[0].numpy(),
        "keypoints_px": pose.keypoints[0].numpy(),
        "keypoint_scores": pose.keypoint_scores[0].numpy(),
        "boxes_px": pose.boxes[0].numpy(),
        "valid": pose.valid[0].numpy(),
        "fps": fps,
    }
    save_arrays(folder / "pose", arrays, formats)


def draw_pose(
    folder: Path, pose: Pose, fps: float, drawing: Drawing, pictures: Pictures, radar: RadarConfig
) -> None:
    """Draw a picture of the skeletons in the world, with the radar."""
    figure = partial(
        plot.skeleton_figure,
        pose.joints[0].numpy(),
        pose.valid[0].numpy(),
        fps,
        subtitle=pictures.subtitle,
        radar_m=radar.middle_m,
    )
    drawing.draw(figure, folder / f"skeleton.{pictures.suffix}")


def write_overlay(
    folder: Path,
    chunks: Iterable[Tensor],
    fps: float,
    pose: Pose,
    threshold: float,
    quiet: bool = False,
    camera: CameraConfig | None = None,
    from_film: Tensor | None = None,
) -> FilmStrip:
    """Write ``overlay.mp4``: frames in chunks (n, 3, H, W) uint8 RGB with boxes, ids and skeletons.

    With a ``camera`` the floor that it sees is drawn as well; ``from_film`` (:class:`~tensorsim.streaming.Found`)
    maps it to where the video's own moving camera sees it.

    Returns:
        The same video in the form that a report uses.
    """
    boxes, keypoints = pose.boxes[0].numpy(), pose.keypoints[0].numpy()
    scores, valid = pose.keypoint_scores[0].numpy(), pose.valid[0].numpy()
    to_film = None if from_film is None else from_film.inverse().numpy()

    def drawn() -> Iterator[np.ndarray]:
        index, floor = 0, np.zeros((0, 2, 2))
        with progress_bar("overlay", valid.shape[1], quiet) as bar:
            for frames in chunks:
                if index == 0 and camera is not None:
                    floor = plot.floor_lines(camera, frames.shape[2], frames.shape[3])
                for frame in frames.permute(0, 2, 3, 1).numpy():
                    lines = floor if to_film is None else plot.through(floor, to_film[index])
                    yield plot.draw_people(
                        plot.draw_lines(frame, lines),
                        boxes[:, index],
                        keypoints[:, index],
                        scores[:, index],
                        valid[:, index],
                        threshold,
                    )
                    index += 1
                    bar.update(1)

    with VideoWriter(folder / "overlay.mp4", fps) as film, FilmStrip(folder, valid.shape[1], fps) as strip:
        for frame in drawn():
            film.add(frame)
            strip.add(frame)
    return strip


def check_length(frames: int, fps: float, stage: PoseToDoppler, uncertain: int = 0) -> None:
    """Refuse a clip shorter than a Doppler window.

    Args:
        frames: number of frames.
        fps: frames per second.
        stage: makes the maps.
        uncertain: how many more frames there may be.

    Raises:
        TensorsimError: the clip is too short.
    """
    pulses, prf_hz = stage.simulator.min_pulses, stage.resampler.prf_hz
    if stage.resampler.pulses(frames + uncertain, fps) < pulses:
        raise TensorsimError(
            f"frames: got {frames} at {fps:.4g} fps, expected at least {math.ceil((pulses - 0.5) / prf_hz * fps)} "
            f"for one Doppler window of {pulses / prf_hz:.3g} s (--stft-window)"
        )


def _chosen(found: Found, people: str, fps: float) -> Found:
    """Keep the people selected by ``people``; warns if nobody is left."""
    chosen = found._replace(pose=select_people(found.pose, people, fps))
    if bool(found.pose.valid.any()) and not bool(chosen.pose.valid.any()):
        warnings.warn(
            f"--people {people} selects none of the people found: the maps show an empty scene",
            TensorsimWarning,
            stacklevel=2,
        )
    else:
        warn_of_empty_clips(chosen.pose.valid)
    return chosen


@contextmanager
def simulated(
    source: "Source",
    stage: PoseToDoppler,
    folder: Path,
    config: SimulationConfig,
    device: torch.device,
    drawing: Drawing,
    pictures: Pictures,
    quiet: bool = False,
) -> Iterator[tuple[Found, RadarMaps, Future[FilmStrip]]]:
    """Find the people of a source, select among them, and simulate their maps.

    Meanwhile and during the block, the picture of the skeletons is drawn, and the overlay video is written in another
    thread; the video is complete at the end of the block. Until then torch runs on one thread.

    Raises:
        TensorsimError: see :func:`check_length`, and :func:`~tensorsim.vision.tracking.selection.select_people`.
    """
    found = source.find(quiet)
    check_length(found.pose.valid.shape[2], source.fps, stage)
    found = _chosen(found, config.pose.people, source.fps)
    found = within_reach(found, config.scene.radar)
    pose = found.pose
    picture(
        "world",
        lambda: _figure_pixels(
            plot.skeleton_figure(
                pose.joints[0].numpy(),
                pose.valid[0].numpy(),
                source.fps,
                radar_m=config.scene.radar.middle_m,
            )
        ),
    )
    draw_pose(folder, pose, source.fps, drawing, pictures, config.scene.radar)
    torch.manual_seed(config.seed)
    camera = None if found.camera is None else camera_config(found.camera, found.radar_ahead_m)

    def overlay(chunks: Iterable[Tensor]) -> FilmStrip:
        return write_overlay(
            folder, chunks, source.fps, pose, source.threshold, quiet, camera, found.from_film
        )

    # The radar simulation is as fast on one thread as on two, and the video needs the other.
    with beside(overlay, source.frames()) as film, one_thread():
        maps = maps_of_pose(stage, pose, source.fps, device, quiet)
        yield found, maps, film


def _figure_pixels(figure: Any) -> np.ndarray:
    """A figure as (H, W, 3) uint8 RGB."""
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()
