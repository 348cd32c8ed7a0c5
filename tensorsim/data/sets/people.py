"""The people in a file: read from motion and keypoints, or found in videos by networks and cached."""

import hashlib
from collections.abc import Callable
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import nn

from tensorsim.config import SimulationConfig
from tensorsim.data.layouts.movi import read_movi
from tensorsim.data.layouts.ntu import read_ntu
from tensorsim.data.motion_files import load_motion
from tensorsim.data.sets.recipe import SourceConfig
from tensorsim.data.skeletons import Motion
from tensorsim.device import one_thread
from tensorsim.errors import TensorsimError
from tensorsim.files import complete_file, sha256_of, shown_name, write_text
from tensorsim.pipeline import VideoToPose
from tensorsim.vision.smoothing.along_time import nearest_valid

#: Files of captured motion by suffix; other files are keypoints (.json) or videos.
_MOTION = (".bvh", ".npz", ".skeleton", ".mat")

T = TypeVar("T")


def is_film(file: Path) -> bool:
    """Whether networks have to find the people in a file."""
    return file.suffix.lower() not in (*_MOTION, ".json") and not file.is_dir()


def _at_own_rate(read: Callable[[float | None], T], fps: float | None) -> T:
    """Read at the frame rate that a file states, or at ``fps`` if it states no sensible one."""
    try:
        return read(None)
    except TensorsimError:
        if fps is None:
            raise
        return read(fps)


def finite_everywhere(motion: Motion, name: str) -> Motion:
    """The people who appear in a motion, with joints in every frame: unseen frames copy the nearest seen one.

    Splines run through these frames.

    Raises:
        TensorsimError: a motion without people.
    """
    if not bool(motion.valid.any()):
        raise TensorsimError(f"{name}: contains no people, expected at least one")
    somebody = motion.valid.any(dim=1)
    joints, valid = motion.joints[somebody], motion.valid[somebody]
    nearest = nearest_valid(valid)[..., None, None].expand(-1, -1, 14, 3)
    return Motion(joints.gather(1, nearest), valid, motion.fps)


class PeopleFinder:
    """Reads or finds the people in files; the camera of videos and keypoints is estimated from the people.

    Args:
        source: its ``fps`` and ``image_size`` are used if files do not state them.
        cache: folder for the people found in videos, by hash of the video and the networks; None caches nothing.
    """

    def __init__(self, source: SourceConfig, cache: Path | None) -> None:
        self.source, self.cache = source, cache

    @torch.no_grad()
    def motion(self, path: str, key: str, again: bool = False) -> Motion:
        """The people in a file; joints are finite everywhere.

        Args:
            path: path of the file.
            key: key of the motion in it.
            again: search even if nobody was found before, see :meth:`kept`.

        Raises:
            TensorsimError: a file that is missing or damaged, or a video in which nobody was found.
        """
        file = Path(path)
        if not file.exists():
            raise TensorsimError(f"{path}: no such file")
        if is_film(file):
            digest = "" if self.cache is None else self._digest(file)
            motion = self.kept(file, digest, self._found, again)
        elif file.suffix.lower() in _MOTION:
            motion = self._captured(file, key)
        else:
            motion = self._of_keypoints(file)
        return finite_everywhere(motion, path)

    def _captured(self, file: Path, key: str) -> Motion:
        suffix = file.suffix.lower()
        if suffix == ".skeleton":
            return read_ntu(file)
        if suffix == ".mat":
            return read_movi(file, key)
        return _at_own_rate(lambda fps: load_motion(file, key or None, fps), self.source.fps)

    def _of_keypoints(self, file: Path) -> Motion:
        from tensorsim.sources import keypoint_source

        stage = VideoToPose.from_config(SimulationConfig(), nn.Identity(), nn.Identity())
        found = keypoint_source(file, stage, self.source.fps, self.source.image_size, calibrate=True)
        pose = found.find(True).pose
        return Motion(pose.joints[0], pose.valid[0], found.fps)

    def kept(self, file: Path, digest: str, find: Callable[[Path], Motion], again: bool = False) -> Motion:
        """The result of ``find`` for a video, kept in ``cache`` for the next time, as is the reason for a failure.

        Args:
            file: the video, or a name for it.
            digest: hash of everything that the people depend on.
            find: takes ``file``.
            again: call it even if it failed before.

        Raises:
            TensorsimError: what ``find`` raises, or raised before.
        """
        if self.cache is None:
            return find(file)
        kept = self.cache / f"{digest}.npz"
        failed = kept.with_suffix(".txt")
        if failed.is_file() and not again:
            raise TensorsimError(f"{file}: {failed.read_text(encoding='utf-8')}")
        if not kept.is_file():
            try:
                motion = find(file)
            except TensorsimError as error:
                write_text(failed, shown_name(str(error).removeprefix(f"{file}: ")))
                raise
            failed.unlink(missing_ok=True)
            with complete_file(kept) as scratch, scratch.open("wb") as target:
                np.savez(target, joints=motion.joints.numpy(), valid=motion.valid.numpy(), fps=motion.fps)
        with np.load(kept) as arrays:
            joints, valid = torch.from_numpy(arrays["joints"]), torch.from_numpy(arrays["valid"])
            return Motion(joints, valid, float(arrays["fps"]))

    def _found(self, file: Path) -> Motion:
        from tensorsim.data.video import VideoReader
        from tensorsim.streaming import people_of_film

        reader = _at_own_rate(lambda fps: VideoReader(file, fps=fps), self.source.fps)
        with one_thread():  # for the same bits everywhere
            pose = people_of_film(self.networks, reader, torch.device("cpu"), True, calibrate=True).pose
        return Motion(pose.joints[0], pose.valid[0], reader.fps)

    @cached_property
    def networks(self) -> VideoToPose:
        """Detection, tracking, pose and lifting by the shipped networks."""
        return VideoToPose.from_config(SimulationConfig())

    @cached_property
    def of_networks(self) -> bytes:
        """Hash of the networks and of the versions of this package and those that read videos and run networks."""
        import cv2

        from tensorsim.registry import locate

        files = [locate(None, "RTMDet"), locate(None, "HRNet", "CPM"), locate(None, "TemporalLifter")]
        versions = [version("tensorsim"), cv2.__version__, str(torch.__version__)]
        return " ".join([*versions, *map(sha256_of, files)]).encode()

    def _digest(self, file: Path) -> str:
        content = hashlib.sha256(self.of_networks)
        content.update(f"fps {self.source.fps}, camera estimated".encode())
        with file.open("rb") as source:
            for block in iter(lambda: source.read(1 << 20), b""):
                content.update(block)
        return content.hexdigest()
