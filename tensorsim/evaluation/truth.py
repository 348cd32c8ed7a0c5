"""The truth loop: maps of every setting compared with those of the true motion, clip by clip, resumable."""

import json
import time
import warnings
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from tensorsim.body.skeleton import mid_hips
from tensorsim.config import PoseConfig
from tensorsim.config.documents import digest
from tensorsim.config.people import Lifting
from tensorsim.errors import TensorsimError, TensorsimWarning, check_count
from tensorsim.evaluation.clips import CapturedClip, Clip, activity_clips, captured_clips
from tensorsim.evaluation.films import FPS, Filmed, filmed
from tensorsim.evaluation.scores import Maps, compare, mean_maps
from tensorsim.evaluation.settings import SOURCES, STAGES, Pipelines, Setting, lifting_files
from tensorsim.files import write_text
from tensorsim.process import end_with_parent
from tensorsim.radar.presets import PRESETS

#: Trivial guesses as baselines: an empty map; the mean of the row's other clips; another clip of the row.
GUESSES = ("empty", "mean", "shuffled")

#: Scores of one cell by scene, map and score name.
Scores = dict[str, dict[str, dict[str, float]]]


@dataclass(frozen=True)
class TruthLoop:
    """What to evaluate.

    Attributes:
        out: output folder; ``cells/`` has the scores of every clip and setting, ``films/`` the networks' results.
        clips: clips per row of the table.
        activities: names of activities; an empty tuple is all twelve.
        motions: motion capture files, each a row.
        motion_fps: their frame rate, overrides that in the files.
        scenes: names of radar presets.
        sources: keys of ``SOURCES``.
        stages: also replace each stage by the truth in turn, in the last of the sources.
        detector, pose: networks for source "c".
        lifter: lifter of settings other than the paper's, instead of the default one.
        seed: seed of the first clip of each activity.
        jobs: number of processes.
    """

    out: Path
    clips: int = 10
    activities: tuple[str, ...] = ()
    motions: tuple[Path, ...] = ()
    motion_fps: float | None = None
    scenes: tuple[str, ...] = ("free-space", "through-wall")
    sources: tuple[str, ...] = ("a", "b")
    stages: bool = True
    detector: Path | None = None
    pose: Path | None = None
    seed: int = 0
    jobs: int = 1
    lifter: Lifting | None = None

    def pipelines(self) -> Pipelines:
        """The pipelines that make the maps of the scenes."""
        lifter = None if self.lifter is None else PoseConfig(lifter=self.lifter)
        return Pipelines({name: PRESETS[name] for name in self.scenes}, lifter)

    def settings(self) -> list[Setting]:
        """All settings in the order of the tables."""
        listed = [Setting(source) for source in self.sources] + [Setting(s, paper=True) for s in self.sources]
        last = max(self.sources)
        known = {"a": STAGES[5:], "b": STAGES[2:], "c": STAGES}[last]
        return listed + [Setting(last, true_stage=stage) for stage in (known if self.stages else ())]

    def rows(self) -> dict[str, list[Clip]]:
        """The clips by row."""
        listed = {}
        if self.activities or not self.motions:
            listed = activity_clips(
                () if self.activities == ("all",) else self.activities, self.clips, self.seed
            )
        for path in self.motions:
            if path.stem in listed:
                raise TensorsimError(
                    f"motion: got {path} after another {path.stem}, expected files with different names"
                )
            listed[path.stem] = captured_clips(path, self.clips, self.motion_fps)
        return listed

    def run(self, quiet: bool = False) -> list[dict[str, Any]]:
        """Compute every missing cell; returns all cells, see :func:`read_cells`.

        Raises:
            TensorsimError: networks that a setting needs are missing, or unknown names.
        """
        self._check()
        work = [
            (row, setting)
            for row, clips in self.rows().items()
            for setting in [*self.settings(), *GUESSES]
            for _ in clips
        ]
        with tqdm(total=len(work), unit="clip", desc="truth", disable=quiet) as bar:
            if self.jobs == 1:
                for row in self.rows():
                    evaluate_row(self, row, bar.update)
            else:
                self._in_processes(bar)
        return self.read_cells()

    def _in_processes(self, bar: tqdm) -> None:
        start = time.time()
        with ProcessPoolExecutor(self.jobs, get_context("spawn"), end_with_parent) as pool:
            futures: set[Future[None]] = {pool.submit(_one_thread_row, self, row) for row in self.rows()}
            while futures:
                done, futures = wait(futures, timeout=2.0, return_when="FIRST_EXCEPTION")
                for future in done:
                    future.result()
                bar.n = sum(path.is_file() for path in self._cell_paths())
                bar.refresh()
        bar.set_postfix_str(f"{time.time() - start:.0f} s")

    def _check(self) -> None:
        for name, chosen, known in (("scene", self.scenes, PRESETS), ("setting", self.sources, SOURCES)):
            for one in chosen:
                if one not in known:
                    raise TensorsimError(f"{name}: got {one!r}, expected one of {', '.join(known)}")
        counts = {
            "scenes": len(self.scenes),
            "settings": len(self.sources),
            "clips": self.clips,
            "jobs": self.jobs,
        }
        for name, count in counts.items():
            check_count(count, name)
        if "c" in self.sources and (self.detector is None or self.pose is None):
            raise TensorsimError("setting c: got no networks, expected a detector and a pose network")

    def _cell_paths(self) -> list[Path]:
        names = [setting.name for setting in self.settings()] + list(GUESSES)
        return [self.cell(row, c, n) for row, clips in self.rows().items() for c in clips for n in names]

    def cell(self, row: str, clip: Clip, setting: str) -> Path:
        """File of a cell; its name includes a hash of the options and version that its scores depend on."""
        options: dict[str, Any] = {"scenes": self.scenes, "clips": 0, "fps": FPS}
        if setting in GUESSES:  # made from the other clips
            options |= {"clips": self.clips, "seed": self.seed}
        else:
            options |= {"lifter": self.lifter, "weights": lifting_files()}
        if isinstance(clip, CapturedClip):
            options |= {"source": clip.source}
        if setting.startswith("c"):
            options |= {"networks": self._networks()}
        return self.out / "cells" / _plain(row) / f"{_plain(clip.name)}-{setting}-{digest(options)}.json"

    def film(self, clip: Clip) -> Path:
        """File of the results of the networks on a clip."""
        source = clip.source if isinstance(clip, CapturedClip) else ""
        key = digest([source, self._networks()])
        return self.out / "films" / _plain(clip.row) / f"{_plain(clip.name)}-{key}.npz"

    def _networks(self) -> list[tuple[str, int]]:
        """Identifies the networks, even after further training, by their files and modification times."""
        files = [path.resolve() for path in (self.detector, self.pose) if path is not None]
        return [(str(file), file.stat().st_mtime_ns if file.is_file() else 0) for file in files]

    def read_cells(self) -> list[dict[str, Any]]:
        """All existing cells, each a dictionary of row, clip, setting, scores by scene, pose errors."""
        return [json.loads(path.read_text("utf-8")) for path in self._cell_paths() if path.is_file()]


def _plain(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name)


def _write(path: Path, cell: dict[str, Any]) -> None:
    write_text(path, json.dumps(cell))


def _one_thread_row(loop: TruthLoop, row: str) -> None:
    torch.set_num_threads(1)
    evaluate_row(loop, row, lambda: None)


def evaluate_row(loop: TruthLoop, row: str, tick: Callable[[], Any]) -> None:
    """Write every missing cell of a row; ``tick`` is called after each cell, missing or not."""
    clips = loop.rows()[row]
    settings: list[Setting] = loop.settings()
    missing = {
        (k, name)
        for k, clip in enumerate(clips)
        for name in [*(s.name for s in settings), *GUESSES]
        if not loop.cell(row, clip, name).is_file()
    }
    for _ in range(len(clips) * (len(settings) + len(GUESSES)) - len(missing)):
        tick()
    if not missing:
        return
    pipelines = loop.pipelines()
    guessing = any(name in GUESSES for _, name in missing)
    truths = _Truths(pipelines, clips, keep=guessing)
    networks: list[nn.Module] = []
    for k, clip in enumerate(clips):
        if not any(index == k for index, _ in missing):
            continue
        for guess in GUESSES:
            if (k, guess) in missing:
                scores = {scene: truths.guess(guess, scene, k) for scene in loop.scenes}
                _write(loop.cell(row, clip, guess), _cell(row, clip, guess, scores, {}))
                tick()
        for setting in settings:
            if (k, setting.name) not in missing:
                continue
            film = _film(loop, clip, networks) if setting.source == "c" else None
            joints, valid = pipelines.joints(setting, clip, film)
            scores = {}
            for scene in loop.scenes:
                if truths.get(scene, k) is None:
                    continue
                try:
                    scores[scene] = truths.compare(
                        pipelines.maps(setting, scene, clip, joints, valid), scene, k
                    )
                except TensorsimError as error:
                    _warn_of_omission(clip, f"{scene}, {setting.name}", error)
            _write(
                loop.cell(row, clip, setting.name),
                _cell(row, clip, setting.name, scores, pose_errors(joints, valid, clip)),
            )
            tick()


def _cell(
    row: str, clip: Clip, setting: str, scores: dict[str, Any], errors: dict[str, float]
) -> dict[str, Any]:
    return {"row": row, "clip": clip.name, "setting": setting, "pose": errors, "scores": scores}


def _film(loop: TruthLoop, clip: Clip, networks: list[nn.Module]) -> Filmed:
    from tensorsim.pipeline import pretrained_pose
    from tensorsim.vision.detection.rtmdet import RTMDet

    assert loop.detector is not None
    assert loop.pose is not None
    if not networks:
        networks += [RTMDet.from_pretrained(loop.detector).eval(), pretrained_pose(loop.pose).eval()]
    return filmed(loop.film(clip), clip, networks[0], networks[1])


def _warn_of_omission(clip: Clip, what: str, error: TensorsimError) -> None:
    warnings.warn(f"{clip.row} {clip.name}, {what}: left out, {error}", TensorsimWarning, stacklevel=3)


class _Truths:
    """The true maps of a row's clips, computed on first use."""

    def __init__(self, pipelines: Pipelines, clips: list[Clip], keep: bool) -> None:
        self.pipelines, self.clips, self.keep = pipelines, clips, keep
        self.made: dict[tuple[str, int], Maps | None] = {}

    def get(self, scene: str, k: int) -> Maps | None:
        """True maps of clip k; None, with a warning, where it is too fast for the radar of the scene."""
        if (scene, k) not in self.made:
            if not self.keep:
                self.made = {key: maps for key, maps in self.made.items() if key[1] == k}
            try:
                self.made[scene, k] = self.pipelines.truth(scene, self.clips[k])
            except TensorsimError as error:
                _warn_of_omission(self.clips[k], scene, error)
                self.made[scene, k] = None
        return self.made[scene, k]

    def compare(self, guess: Maps, scene: str, k: int) -> dict[str, dict[str, float]]:
        """Scores of maps of clip k."""
        truth = self.get(scene, k)
        assert truth is not None
        return compare(guess.like(truth), truth, self.pipelines.speed_m_s(scene))

    def guess(self, name: str, scene: str, k: int) -> dict[str, dict[str, float]]:
        """Scores of a trivial guess of clip k; empty where there is no other clip to guess from."""
        truth = self.get(scene, k)
        if truth is None:
            return {}
        if name == "empty":
            return self.compare(truth.empty(), scene, k)
        order = [(k + 1 + i) % len(self.clips) for i in range(len(self.clips) - 1)]
        others = [m.like(truth) for m in (self.get(scene, i) for i in order) if m is not None]
        if not others:
            return {}
        return self.compare(others[0] if name == "shuffled" else mean_maps(others), scene, k)


def pose_errors(joints: Tensor, valid: Tensor, clip: Clip) -> dict[str, float]:
    """Errors of joints (P, T, 14, 3) in metres for the person tracked longest, in the frames where they are tracked.

    ``followed`` is the share of these frames, ``root`` the rms distance of the mid-hips, ``joints`` the mean distance
    of the joints after aligning the hips, ``range`` the rms error along y of the joints after aligning; ``people`` the
    number of people. There are no errors if nobody is tracked.
    """
    errors = {"people": float(joints.shape[0])}
    if not clip.present:
        return errors
    if not bool(valid.any()):
        return errors | {"followed": 0.0}
    one = int(valid.sum(dim=-1).argmax())
    there = valid[one]
    found, truth = joints[one, there].double(), clip.joints(FPS)[there]
    root = (mid_hips(found) - mid_hips(truth)).norm(dim=-1)
    local = (found - mid_hips(found)[:, None]) - (truth - mid_hips(truth)[:, None])
    return errors | {
        "followed": float(there.double().mean()),
        "root": float(root.square().mean().sqrt()),
        "joints": float(local.norm(dim=-1).mean()),
        "range": float(local[..., 1].square().mean().sqrt()),
    }


def example_maps(loop: TruthLoop, pipelines: Pipelines, scene: str) -> dict[str, list[tuple[str, Tensor]]]:
    """DTMs of the first clip of each row, the truth first and then one per source, for a picture.

    Rows with motion that is too fast for the radar of the scene are left out.
    """
    networks: list[nn.Module] = []
    pictures: dict[str, list[tuple[str, Tensor]]] = {}
    for row, clips in loop.rows().items():
        clip = clips[0]
        try:
            shown = [("truth", pipelines.truth(scene, clip).doppler_time)]
            for source in loop.sources:
                film = _film(loop, clip, networks) if source == "c" else None
                setting = Setting(source)
                maps = pipelines.maps(setting, scene, clip, *pipelines.joints(setting, clip, film))
                shown.append((source, maps.doppler_time))
        except TensorsimError:  # the loop has already warned
            continue
        pictures[row] = shown
    return pictures
