"""Real films of known activity: the people found in them, and the activity recognised in the maps of each scene.

A folder's ``labels.json`` lists its films: ``file``, the seconds ``start_s`` to ``end_s`` in which the activity
happens, and the activities that count as right (``accept``).
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tensorsim.config import ACTIVITIES, RadarConfig
from tensorsim.config.documents import digest
from tensorsim.data.video import VideoReader
from tensorsim.errors import TensorsimError
from tensorsim.evaluation.film_variants import Observed, over_variants
from tensorsim.files import complete_file, sha256_of, sha256_of_arrays
from tensorsim.pipeline import PoseToDoppler, VideoToPose, warn_of_empty_clips
from tensorsim.recognition import ActivityRecognizer
from tensorsim.streaming import (
    Found,
    detections_of_film,
    keypoints_of_film,
    lifted_film,
    maps_of_pose,
    steps_of_camera,
    within_reach,
)
from tensorsim.summary import label_of, people_of
from tensorsim.types import Detections, Pose, RadarMaps
from tensorsim.vision.calibration.calibrator import camera_row
from tensorsim.vision.calibration.camera_motion import MOVING_SHARE, BackgroundMotion
from tensorsim.vision.calibration.stabilisation import at_even_times
from tensorsim.vision.smoothing.even_time import to_even_time


@dataclass(frozen=True)
class LabelledFilm:
    """A film of known activity.

    Attributes:
        folder, file: where the film is.
        start_s, end_s: the seconds in which the activity happens.
        accept: labels that count as right, from ``tensorsim.ACTIVITIES``.
    """

    folder: Path
    file: str
    start_s: float
    end_s: float
    accept: tuple[str, ...]

    @property
    def path(self) -> Path:
        """Path of the film."""
        return self.folder / self.file


@dataclass(frozen=True)
class Verdict:
    """The activity recognised in the maps of one scene.

    Attributes:
        scene: name of the scene.
        label: the most probable activity; None where the simulation refused the film.
        probability: probability of the label.
        right: whether the label is accepted.
        right_probability: total probability of all accepted labels; 0 where there is no label.
        error: why there is no label.
    """

    scene: str
    label: str | None
    probability: float | None
    right: bool
    right_probability: float = 0.0
    error: str | None = None


class Scene(NamedTuple):
    """How a scene is simulated and recognised."""

    stage: PoseToDoppler
    recognizer: ActivityRecognizer


def read_labels(folder: Path) -> list[LabelledFilm]:
    """The films listed in the ``labels.json`` of a folder.

    Raises:
        TensorsimError: the file is missing or not such a list; no films; an unknown activity or none; impossible
            times; a missing film; or the same seconds listed twice.
    """
    table = folder / "labels.json"
    try:
        listed = json.loads(table.read_text(encoding="utf-8"))
        films = [
            LabelledFilm(
                folder, str(row["file"]), float(row["start_s"]), float(row["end_s"]), tuple(row["accept"])
            )
            for row in listed
        ]
    except FileNotFoundError:
        raise TensorsimError(f"{folder}: got no labels.json, expected a folder of labelled films") from None
    except (ValueError, KeyError, TypeError) as error:
        raise TensorsimError(
            f"{table}: got {type(error).__name__} ({error}), expected a list of objects with file, start_s, end_s "
            "and accept"
        ) from None
    if not films:
        raise TensorsimError(f"{table}: got no films, expected at least one")
    for film in films:
        if not 0 <= film.start_s < film.end_s:
            raise TensorsimError(
                f"{table}: {film.file}: got the seconds {film.start_s:g} to {film.end_s:g}, expected a start from "
                "0 on and a later end"
            )
        if not film.accept:
            raise TensorsimError(f"{table}: {film.file}: got no activity to accept, expected at least one")
        for label in film.accept:
            if label not in ACTIVITIES:
                raise TensorsimError(
                    f"{table}: {film.file}: got {label!r}, expected one of the 12 activities"
                )
        if not film.path.is_file():
            raise TensorsimError(f"{table}: {film.file}: no such file beside it")
    (cut, count), *_ = Counter((film.file, film.start_s, film.end_s) for film in films).most_common(1)
    if count > 1:
        raise TensorsimError(
            f"{table}: {cut[0]}: got the seconds {cut[1]:g} to {cut[2]:g} twice, expected them once, with all "
            "activities to accept"
        )
    return films


def whole_films(films: Iterable[LabelledFilm]) -> list[LabelledFilm]:
    """Each film once, from beginning to end; a label accepted in any of its parts is accepted."""
    accept: dict[tuple[Path, str], dict[str, None]] = {}
    for film in films:
        accept.setdefault((film.folder, film.file), {}).update(dict.fromkeys(film.accept))
    return [LabelledFilm(*place, 0.0, math.inf, tuple(names)) for place, names in accept.items()]


class FilmReader:
    """Finds the people in films; the networks' outputs are cached in a folder and reused.

    Detections are keyed by film, cut and detector; keypoints by these, the tracks and the pose network; networks by
    their file and what runs them; and everything by the version of this package. Tracking, lifting and smoothing are
    computed anew.

    Args:
        stage: the stage that holds the networks.
        networks: files of detector and pose network.
        cache: the folder of the cache.
        stride: keep every n-th frame of the films.
        calibrate: estimate the camera of each film from the people in it.
    """

    def __init__(
        self,
        stage: VideoToPose,
        networks: tuple[Path, Path],
        cache: Path,
        stride: int = 1,
        calibrate: bool = True,
    ) -> None:
        self.stage, self.cache, self.stride, self.calibrate = stage, cache, stride, calibrate
        # Their repr shows what runs the networks, and whether the pose network also sees mirror images.
        self.detector, self.pose = (
            digest([sha256_of(path), repr(network)])
            for path, network in zip(networks, (stage.detector, stage.pose), strict=True)
        )

    def open(self, film: LabelledFilm) -> VideoReader:
        """The labelled seconds of a film."""
        return VideoReader(film.path, start_s=film.start_s, end_s=film.end_s, stride=self.stride)

    def people(
        self, film: LabelledFilm, reader: VideoReader, device: torch.device, quiet: bool = False
    ) -> Found:
        """The people of a film, and its camera if it is estimated; arguments as for :meth:`observed`."""
        return self.lifted(self.observed(film, reader, device, quiet), reader.fps)

    def observed(
        self, film: LabelledFilm, reader: VideoReader, device: torch.device, quiet: bool = False
    ) -> Observed:
        """What the networks find in a film, from the cache where available.

        Args:
            film: the film.
            reader: reader from :meth:`open`; afterwards it knows the times of the frames.
            device: device to compute on.
            quiet: no progress bars.
        """
        stage = self.stage
        cut = f"{film.start_s} {film.end_s} {self.stride} {stage.interval_at(reader.fps)} with times"
        key = digest([sha256_of(film.path), cut, self.detector])

        def detect() -> tuple[Tensor, ...]:
            found, looked = detections_of_film(stage, reader, device, quiet)
            times_s = torch.zeros(0) if reader.uneven_times_s is None else reader.uneven_times_s
            return *found, looked, times_s

        *detections, observed, times_s = self._kept(f"detections-{key}", detect)
        reader.uneven_times_s = times_s if times_s.numel() else None
        tracks = stage.follow(Detections(*(part.to(device) for part in detections)), observed.to(device))
        key = digest([key, self.pose, sha256_of_arrays(tracks.boxes.cpu().numpy())])

        def estimate() -> tuple[Tensor, ...]:
            background = BackgroundMotion(reader.fps)
            found = keypoints_of_film(stage, reader, tracks, device, quiet, background)
            shift_px_s = math.nan if background.shift_px_s is None else background.shift_px_s
            return *found, torch.tensor(shift_px_s)

        keypoints, scores, shift_px_s = self._kept(f"keypoints-{key}", estimate)
        keypoints, scores, size = keypoints.to(device), scores.to(device), (reader.height, reader.width)
        shift = None if bool(shift_px_s.isnan()) else float(shift_px_s)
        steps = None
        if self.calibrate and shift is not None and shift > MOVING_SHARE * reader.width:

            def follow() -> tuple[Tensor, ...]:
                steps = steps_of_camera(reader, tracks, quiet)
                return (torch.zeros(0, 4) if steps is None else steps,)

            (steps,) = self._kept(f"camera-{key}", follow)
            steps = steps if steps.numel() else None
        if reader.uneven_times_s is not None:
            tracks, keypoints, scores = to_even_time(tracks, keypoints, scores, times_s[None], reader.fps)
            steps = None if steps is None else at_even_times(steps, times_s, reader.fps)
        return Observed(tracks, keypoints, scores, size, shift, steps)

    def lifted(self, seen: Observed, fps: float) -> Found:
        """The people in metres, and the camera if it is estimated, from the result of :meth:`observed`."""
        found = lifted_film(
            self.stage,
            seen.tracks,
            seen.keypoints,
            seen.scores,
            seen.size,
            fps,
            self.calibrate,
            seen.camera_steps,
        )
        warn_of_empty_clips(found.pose.valid)
        return found._replace(background_px_s=seen.background_px_s)

    def _kept(self, name: str, make: Callable[[], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """Tensors from a file of the cache, computed and written first if it is missing."""
        path = self.cache / f"{name}.npz"
        if path.is_file():
            with np.load(path, allow_pickle=False) as arrays:
                return tuple(torch.from_numpy(arrays[key]) for key in arrays)
        made = tuple(tensor.cpu() for tensor in make())
        with complete_file(path) as scratch, scratch.open("wb") as file:
            np.savez(file, *(tensor.numpy() for tensor in made))
        return made


def judged(
    film: LabelledFilm,
    found: Found,
    fps: float,
    scene: str,
    how: Scene,
    seed: int,
    device: torch.device,
    quiet: bool = False,
) -> tuple[Verdict, RadarMaps | None]:
    """The verdict on a film in one scene, and its maps; maps are None where the simulation refuses its motion."""
    pose = within_reach(found, how.stage.simulator.radar).pose
    torch.manual_seed(seed)
    try:
        maps = maps_of_pose(how.stage, pose, fps, device, quiet)
    except TensorsimError as error:
        return Verdict(scene, None, None, False, error=str(error)), None
    said = label_of(how.recognizer, maps, pose.valid.shape[2] / fps)
    label, probabilities = said["label"], said["probabilities"]
    of_accepted = round(sum(probabilities.get(name, 0.0) for name in film.accept), 4)
    return Verdict(scene, label, probabilities[label], label in film.accept, of_accepted), maps


def followed(pose: Pose, fps: float, radar: RadarConfig) -> list[dict[str, Any]]:
    """A row per person: that of :func:`~tensorsim.summary.people_of`, tracked time, and speed of the fastest joint."""
    rows = people_of(pose, fps, radar)
    for row in rows:
        person = row["id"] - 1
        there = pose.valid[0, person]
        row["followed_s"] = round(float(there.sum()) / fps, 2)
        moved = pose.joints[0, person].diff(dim=0).norm(dim=-1).amax(dim=-1) * fps
        row["fastest_joint_m_s"] = round(float((moved * (there[1:] & there[:-1])).max()), 1)
    return rows


def film_row(
    film: LabelledFilm,
    found: Found,
    people: list[dict[str, Any]],
    frames: int,
    fps: float,
    verdicts: Iterable[Verdict],
) -> dict[str, Any]:
    """The entry of a film in ``films.json``."""
    return {
        "file": film.file,
        "start_s": film.start_s,
        "end_s": film.end_s if math.isfinite(film.end_s) else None,
        "seconds": round(frames / fps, 2),
        "accept": list(film.accept),
        "camera": camera_row(found.camera),
        "background_px_s": None if found.background_px_s is None else round(found.background_px_s, 1),
        "people": people,
        "scenes": {verdict.scene: asdict(verdict) for verdict in verdicts},
    }


def markdown(rows: list[dict[str, Any]]) -> str:
    """The table of films, and how many are right in each scene, also over their variants if these were labelled."""
    scenes = list(rows[0]["scenes"])
    heads = ["film", "right is", *scenes, "followed"]
    lines = [heads, ["---"] * len(heads)]
    names = Counter(row["file"] for row in rows)
    for row in rows:
        part = f", {row['start_s']:g} to {row['end_s']:g} s" if names[row["file"]] > 1 else ""
        followed_s = ", ".join(f"{p['followed_s']:.1f}" for p in row["people"]) or "nobody"
        verdicts = [_said(row["scenes"][scene]) for scene in scenes]
        right = " or ".join(name.split()[0] for name in row["accept"])
        lines.append([row["file"] + part, right, *verdicts, f"{followed_s} of {row['seconds']:.1f} s"])
    counts = [f"**{sum(row['scenes'][scene]['right'] for row in rows)} of {len(rows)}**" for scene in scenes]
    lines.append(["right", "", *counts, ""])
    if "variants" in rows[0]:
        means = [over_variants(rows, scene) for scene in scenes]
        lines.append(
            ["right, mean over variants", "", *(f"{right:.1f} of {len(rows)}" for right, _ in means), ""]
        )
        lines.append(
            ["mean log of the right label's probability", "", *(f"{log:.2f}" for _, log in means), ""]
        )
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _said(verdict: Mapping[str, Any]) -> str:
    if verdict["label"] is None:
        return "no map"
    return f"{verdict['label'].split()[0]} {verdict['probability']:.2f}{' right' if verdict['right'] else ''}"
