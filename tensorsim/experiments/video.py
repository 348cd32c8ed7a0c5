"""Ablation of the vision module: other detectors, trackers, pose networks and lifters on films of known motion."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from tensorsim.errors import TensorsimError, TensorsimWarning, check_seed
from tensorsim.evaluation.clips import ActivityClip, activity_clips
from tensorsim.evaluation.films import CAMERA, FPS, HEIGHT, WIDTH, Observed
from tensorsim.evaluation.report import EMPTY
from tensorsim.evaluation.scores import MAPS, Maps, compare
from tensorsim.evaluation.settings import Pipelines, Setting, lifting_files
from tensorsim.evaluation.truth import pose_errors
from tensorsim.experiments import figures
from tensorsim.experiments.ablations import GUESSES, NORMALISATION, SHORT
from tensorsim.experiments.work import Report, Table, Work, check_scenes
from tensorsim.motion.activities import activity_index
from tensorsim.pipeline import VideoToPose, pretrained_pose
from tensorsim.radar.presets import PRESETS
from tensorsim.registry import find, shipped_weights
from tensorsim.render.renderer import PersonRenderer
from tensorsim.training.maps import SCENES
from tensorsim.vision.detection.acf import AcfDetector
from tensorsim.vision.detection.rtmdet import RTMDet
from tensorsim.vision.lifting.lifter import NearestPoseLifter
from tensorsim.vision.lifting.temporal_lifter import TemporalLifter
from tensorsim.vision.lifting.videopose3d import VideoPose3D, VideoPoseLifter
from tensorsim.vision.tracking.mosse import MosseTracker

FULL = "RTMDet, GNN, HRNet, matching"
MOSSE = "RTMDet, MOSSE"
ACF = "ACF, GNN"
CPM = "CPM, matching"
TCN = "HRNet, TCN (VideoPose3D)"
TEMPORAL = "HRNet, TemporalLifter"
#: Published weights that a row needs, and its name.
BY_NAME = {"cpm-coco": "CPM of MMPose, matching"}


@dataclass(frozen=True)
class VideoConfig:
    """Settings of ``video-ablation``.

    Attributes:
        activities: names; empty is all twelve.
        scenes: names of radar presets.
        clips: clips per activity.
        length_s: length of a clip.
        seed: seed of the first clip.
    """

    activities: tuple[str, ...] = ()
    scenes: tuple[str, ...] = SCENES
    clips: int = 2
    length_s: float = 4.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in self.activities:
            activity_index(name)
        check_scenes(self.scenes)
        check_seed(self.seed, "seed")
        if self.clips < 1 or not 0.5 <= self.length_s <= 60:
            raise TensorsimError(
                f"clips, length_s: got {self.clips} and {self.length_s}, expected at least 1 and from 0.5 to 60 s"
            )

    def rows(self) -> dict[str, list[ActivityClip]]:
        """The clips by activity, with one extra clip each for comparison with the last one."""
        found = activity_clips(self.activities, self.clips + 1, self.seed)
        return {
            row: [
                ActivityClip(c.row, c.name, c.seed, self.length_s)
                for c in clips
                if isinstance(c, ActivityClip)
            ]
            for row, clips in found.items()
        }


#: From frames (T, 3, H, W) and the height of the person in metres to joints (P, T, 14, 3) and presence (P, T).
Chain = Callable[[Tensor, float], tuple[Tensor, Tensor]]


class Watcher:
    """The compared chains, each from frames to joints; all know the camera and the height of the person.

    Attributes:
        chains: chains by name.
        missing: omitted rows, and why.
    """

    def __init__(self) -> None:
        self.detector = RTMDet.from_pretrained()
        self.pose = pretrained_pose()
        self.matching = NearestPoseLifter(pitch_rad=CAMERA.pitch_rad)
        tcn = VideoPoseLifter(VideoPose3D.from_pretrained(), HEIGHT, WIDTH)
        self.chains: dict[str, Chain] = {
            FULL: _lifted(self.detector, self.pose, self.matching),
            MOSSE: self._by_mosse,
            ACF: _lifted(AcfDetector.from_pretrained(), self.pose, self.matching),
            CPM: _lifted(self.detector, pretrained_pose("cpm-pose-small"), self.matching),
            TCN: _lifted(self.detector, self.pose, tcn),
            TEMPORAL: self._by_temporal_lifter,
        }
        self.missing: dict[str, str] = {}
        for name, row in BY_NAME.items():
            if find(name).path.is_file():
                self.chains[row] = _lifted(self.detector, pretrained_pose(name), self.matching)
            else:
                self.missing[row] = f"needs the published weights: tensorsim models fetch {name}"

    def _by_temporal_lifter(self, frames: Tensor, height_m: float) -> tuple[Tensor, Tensor]:
        lifter = TemporalLifter.from_pretrained(None, CAMERA, (height_m,))
        return _joints(
            VideoToPose(self.detector, self.pose, (height_m,), camera=CAMERA, lifter=lifter), frames
        )

    def _by_mosse(self, frames: Tensor, height_m: float) -> tuple[Tensor, Tensor]:
        """Tracks by MOSSE; RTMDet starts the filters in the first frame in which it detects a person."""
        for first in range(0, len(frames), 2):
            start = self.detector(frames[first : first + 1])
            if bool((start.valid & (start.scores >= 0.5)).any()):
                break
        tracks = MosseTracker()(frames[None, first:], start)
        before = torch.zeros(tracks.valid.shape[1], first, dtype=torch.bool)
        boxes = torch.cat([tracks.boxes.new_zeros(len(before), first, 4), tracks.boxes[0]], dim=1)
        valid = torch.cat([before, tracks.valid[0]], dim=1)
        stage = VideoToPose(self.detector, self.pose, (height_m,), camera=CAMERA, lifter=self.matching).eval()
        keypoints, scores = stage.estimate(frames, boxes.transpose(0, 1), valid.transpose(0, 1))
        return Observed(boxes, valid, keypoints.transpose(0, 1), scores.transpose(0, 1)).lifted_by(stage)


def _lifted(detector: nn.Module, pose: nn.Module, lifter: nn.Module) -> Chain:
    """The chain with a lifter that knows nothing of the camera but its tilt."""

    def watch(frames: Tensor, height_m: float) -> tuple[Tensor, Tensor]:
        return _joints(VideoToPose(detector, pose, (height_m,), camera=CAMERA, lifter=lifter), frames)

    return watch


def _joints(stage: VideoToPose, frames: Tensor) -> tuple[Tensor, Tensor]:
    seen = stage.eval()(frames[None], FPS)
    return seen.joints[0], seen.valid[0]


def video_report(config: VideoConfig, work: Work) -> Report:
    """Maps and joints of every chain on rendered films, compared with those of the true motion."""
    rows = config.rows()
    watcher = Watcher()
    pipelines = Pipelines({scene: PRESETS[scene] for scene in config.scenes})
    cells: dict[tuple[str, str], list[dict[str, Any]]] = {}
    jobs = [(row, k) for row in rows for k in range(config.clips)]
    weights = shipped_weights("RTMDet", "HRNet", "AcfDetector", "CPM", "VideoPose3D") | lifting_files()
    for row, k in tqdm(jobs, desc="films", unit="film", disable=work.quiet):
        clip, other = rows[row][k], rows[row][k + 1]

        def make(clip: ActivityClip = clip, other: ActivityClip = other) -> dict[str, Any]:
            return _film(clip, other, watcher, pipelines)

        settings = {
            "row": row, "clip": clip.name, "other": other.name, "length_s": config.length_s, "scenes": config.scenes,
            "chains": list(watcher.chains), "weights": weights,
        }  # fmt: skip
        for name, cell in work.kept("film", settings, make).items():
            cells.setdefault((row, name), []).append(cell)
    return _report(config, rows, watcher, cells)


@torch.inference_mode()
def _film(clip: ActivityClip, other: ActivityClip, watcher: Watcher, pipelines: Pipelines) -> dict[str, Any]:
    """For each chain and guess: scores of the maps by scene, and joint errors."""
    joints = clip.joints(FPS).float()
    there = torch.full((1, len(joints)), clip.present)
    frames = PersonRenderer(CAMERA, HEIGHT, WIDTH)(joints, seed=clip.seed, valid=there).frames
    truth = {scene: pipelines.truth(scene, clip) for scene in pipelines.scenes}
    cells: dict[str, Any] = {}

    def scores(maps: dict[str, Maps]) -> dict[str, Any]:
        return {s: compare(maps[s].like(truth[s]), truth[s], pipelines.speed_m_s(s)) for s in maps}

    setting = Setting("c")

    def seen(scene: str, found: Tensor, valid: Tensor) -> Maps:
        try:
            return pipelines.maps(setting, scene, clip, found, valid)
        except TensorsimError:  # motion too fast for the radar
            return truth[scene].empty()

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TensorsimWarning)
        for name, watch in watcher.chains.items():
            found, valid = watch(frames, clip.height_m)
            maps = {scene: seen(scene, found, valid) for scene in pipelines.scenes}
            cells[name] = {"scores": scores(maps), "pose": pose_errors(found, valid, clip)}
        cells["empty map"] = {"scores": scores({s: truth[s].empty() for s in truth}), "pose": {}}
        guess = {s: pipelines.truth(s, other) for s in truth}
        cells["another clip"] = {"scores": scores(guess), "pose": {}}
    return cells


def _report(
    config: VideoConfig,
    rows: dict[str, list[ActivityClip]],
    watcher: Watcher,
    cells: dict[tuple[str, str], list[dict[str, Any]]],
) -> Report:
    names = [*watcher.chains, *GUESSES]
    nan = float("nan")

    def mean(values: list[float]) -> float:
        finite = [v for v in values if v == v and v != float("inf")]
        return sum(finite) / len(finite) if finite else nan

    def psnr(row: str, name: str, scene: str, view: str) -> float:
        return mean([c["scores"][scene][view]["psnr"] for c in cells.get((row, name), ())])

    keys = [(scene, view) for scene in config.scenes for view in MAPS]
    somebody = [row for row in rows if row != EMPTY]
    means = {
        (name, s, view): mean([psnr(row, name, s, view) for row in somebody])
        for name in names
        for s, view in keys
    }
    main = [[name, *(means[name, scene, view] for scene, view in keys)] for name in names]
    columns = ["chain", *(f"{SHORT[view]}, {scene}" for scene, view in keys)]
    tables = [Table("PSNR in dB, mean of the activities", columns, main)]
    for scene in config.scenes:
        lines = [[row, *(psnr(row, name, scene, "doppler_time") for name in names)] for row in rows]
        heading = f"Doppler-time maps by activity, {scene}, PSNR in dB"
        tables.append(Table(heading, ["activity", *names], lines, file=scene))
    shown = {
        name: {scene: (means[name, scene, "doppler_time"], nan) for scene in config.scenes} for name in names
    }
    errors = []
    for name in watcher.chains:
        poses = [c["pose"] for row in rows for c in cells.get((row, name), ())]
        ghosts = mean([c["pose"]["people"] for c in cells.get((EMPTY, name), ())])
        errors.append([name, *(mean([pose.get(key, nan) for pose in poses]) for key in _ERRORS), ghosts])
    tables.append(
        Table(
            "Errors of the joints in metres where somebody is followed, and people found",
            ["chain", *_ERRORS.values(), f"people found in {EMPTY}"],
            errors,
            3,
            "joints",
        )
    )
    notes = [
        f"Rendered films of generated people, {config.clips} of {config.length_s:g} s per activity, with the shipped "
        "networks; every chain differs from the first one in what it is named after. CPM learnt from the people that "
        "HRNet learnt from, but for a tenth as long, VideoPose3D from the motion that the TemporalLifter learnt from "
        "(their cards have the figures). The paper films real people and compares with measured maps; its "
        "films and maps are not published.",
        f"{EMPTY} is not part of means, for any chain; the last table has the people found in it. Where a chain finds "
        "motion that is too fast for the pulse rate of a scene, its map counts as empty.",
        *(f"Left out: **{row}** ({why})." for row, why in watcher.missing.items()),
        NORMALISATION,
    ]
    drawn = {
        "psnr": figures.bars(shown, "PSNR of the Doppler-time map, dB", "Vision module, mean of activities")
    }
    return Report(notes, tables, drawn)


_ERRORS = {
    "root": "hips, rms",
    "joints": "joints about the hips, mean",
    "range": "of these along y, rms",
    "followed": "frames followed, share",
    "people": "people",
}


def quick_video() -> VideoConfig:
    """One second of one walk."""
    return VideoConfig(activities=("walking",), clips=1, length_s=1.0)
