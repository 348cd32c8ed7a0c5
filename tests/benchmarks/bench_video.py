"""Time of ``tensorsim simulate`` on a film of ten seconds, 1280x720, 30 frames per second, and the share of each stage.

    python -m tests.benchmarks.bench_video [--film FILE] [--runs 5] [--peer]

Without a film, a generated person is rendered at half the size and enlarged. The time of the whole command is that of
a new process, from its start to its end. Times of stages are those of the processor, in this process, with libraries
loaded and figures drawn here; a busy machine changes them little. Networks and decoders run in threads of their
libraries: while a stage waits for them, its wall time counts. Other threads of libraries do not count; set
OMP_NUM_THREADS=1 so that torch has none. A stage does not count what another stage in it takes, and "the rest" is
outside all stages. Other options go to ``simulate``.

The peer is ONNX Runtime running the same networks on every frame, one by one, with as many threads: detection, then
keypoints with the mirror test in the boxes that were tracked. Its wall time is compared with that of finding people in
``simulate``, which includes the camera and the poses in 3D.
"""

# isort: off
from tensorsim import process

process.prepare()  # as the command does, before torch is loaded: threads that spin take time from the others
process.keep_freed_memory()

# isort: on
import argparse
import functools
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import cv2
import torch

from tensorsim import cli, results, sources, streaming, summary
from tensorsim.commands.clip_options import ClipOptions
from tensorsim.commands.demo import film_person
from tensorsim.commands.networks import default_networks, load_networks
from tensorsim.config import SimulationConfig
from tensorsim.data import video
from tensorsim.data.video_writer import write_video
from tensorsim.pipeline import VideoToPose
from tensorsim.streaming import Found
from tensorsim.types import Detections
from tensorsim.vision.onnx_engine import OnnxEngine

#: What is timed, as object, attribute and name of the stage.
STAGES: tuple[tuple[Any, str, str], ...] = (
    (VideoToPose, "detect", "detection"),
    (VideoToPose, "follow", "tracking"),
    (VideoToPose, "estimate", "keypoints"),
    (VideoToPose, "lift", "lifting, position, smoothing"),
    (streaming, "maps_of_pose", "radar"),
    (results, "maps_of_pose", "radar"),
    (summary, "label_of", "label"),
    (results, "write_overlay", "overlay"),
    (results, "draw_maps", "maps: pictures"),
    (results, "draw_pose", "poses: picture"),
    (results, "save_arrays", "writing arrays"),
    (ClipOptions, "write_report", "report"),
)


class Clock(threading.local):
    """Seconds of each thread by stage; what is inside of another stage counts for the inner one only."""

    def __init__(self, seconds: dict[str, float]) -> None:
        self.seconds = seconds
        self.stack: list[str] = ["the rest"]
        self.since = time.thread_time()

    def turn(self) -> None:
        """Count the time since the last turn for the present stage."""
        now = time.thread_time()
        self.seconds[self.stack[-1]] += now - self.since
        self.since = now

    def timed(self, function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        @functools.wraps(function)
        def wrapper(*arguments: Any, **options: Any) -> Any:
            self.turn()
            self.stack.append(stage)
            try:
                return function(*arguments, **options)
            finally:
                self.turn()
                self.stack.pop()

        return wrapper

    def waiting(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Count the wall time of a function whose work other threads do."""

        @functools.wraps(function)
        def wrapper(*arguments: Any) -> Any:
            start, before = time.perf_counter(), time.thread_time()
            try:
                return function(*arguments)
            finally:
                idle = time.perf_counter() - start - (time.thread_time() - before)
                self.seconds[self.stack[-1]] += idle

        return wrapper

    def timed_chunks(
        self, function: Callable[..., Iterator[Any]]
    ) -> Callable[..., Generator[Any, None, None]]:
        def wrapper(*arguments: Any) -> Generator[Any, None, None]:
            chunks = function(*arguments)
            step = self.timed(self.waiting(lambda: next(chunks, None)), "decoding")
            while (chunk := step()) is not None:
                yield chunk

        return wrapper


class Run(NamedTuple):
    """Seconds by stage, wall seconds, and wall seconds of finding people, of one run."""

    stages: dict[str, float]
    wall: float
    finding: float


def simulate(film: Path, options: list[str]) -> Run:
    """One run of ``tensorsim simulate``."""
    seconds: dict[str, float] = defaultdict(float)
    clock, find, finding = Clock(seconds), sources.people_of_film, [0.0]

    def timed_find(*arguments: Any, **more: Any) -> Found:
        start = time.perf_counter()
        found = find(*arguments, **more)
        finding[0] = time.perf_counter() - start
        return found

    with ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        for owner, name, stage in STAGES:
            stack.enter_context(mock.patch.object(owner, name, clock.timed(getattr(owner, name), stage)))
        stack.enter_context(mock.patch.object(OnnxEngine, "forward", clock.waiting(OnnxEngine.forward)))
        chunks = clock.timed_chunks(video.VideoReader._chunks)
        stack.enter_context(mock.patch.object(video.VideoReader, "_chunks", chunks))
        stack.enter_context(mock.patch.object(sources, "people_of_film", timed_find))
        start = time.perf_counter()
        cli.main(["simulate", str(film), "--out", f"{folder}/out", "--quiet", *options])
        wall = time.perf_counter() - start
        clock.turn()
        return Run(dict(seconds), wall, finding[0])


def whole_command(film: Path, options: list[str]) -> float:
    """Wall seconds of ``tensorsim simulate`` as a user starts it."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "tensorsim",
            "simulate",
            str(film),
            "--out",
            f"{folder}/out",
            "--quiet",
        ]
        start = time.perf_counter()
        subprocess.run([*command, *options], check=True, stdout=subprocess.DEVNULL)
        return time.perf_counter() - start


def peer(film: Path) -> float:
    """Wall seconds of decoding, detection, tracking and keypoints of every frame alone."""
    networks = load_networks(*default_networks(None, None), flip_test=True, engine="onnxruntime")
    stage = VideoToPose.from_config(SimulationConfig().replace(tracking__detection_interval=1), *networks)
    reader = video.VideoReader(film)
    with torch.inference_mode():
        first = next(reader.chunks(1))
        # The networks are exported and opened in their first calls, which do not count.
        stage.estimate(first, torch.tensor([[[0.0, 0.0, 99.0, 99.0]]]), torch.ones(1, 1, dtype=torch.bool))
        stage.detect(first)
        before = time.perf_counter()
        found = [stage.detect(frame) for frame in reader.chunks(1)]
        detections = Detections(*(torch.cat(parts) for parts in zip(*found, strict=True)))
        tracks = stage.follow(detections, torch.ones(1, len(found), dtype=torch.bool))
        for index, frame in enumerate(reader.chunks(1)):
            stage.estimate(frame, tracks.boxes[:, :, index], tracks.valid[:, :, index])
        return time.perf_counter() - before


def rendered(path: Path, people: int) -> None:
    """A film of a person who walks, optionally with a second person in the right half who punches."""
    films = [film_person(activity, 300, seed).film.frames for activity, seed in ((7, 0), (1, 3))[:people]]
    if people == 2:
        quarter = films[0].shape[-1] // 4
        films = [film[..., quarter : 3 * quarter] for film in films]
    frames = torch.cat(films, dim=-1).permute(0, 2, 3, 1).numpy()
    write_video(path, (cv2.resize(frame, (1280, 720)) for frame in frames), 30.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--film", type=Path)
    parser.add_argument("--people", type=int, choices=(1, 2), default=1)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--peer", action="store_true")
    arguments, options = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as folder:
        film = arguments.film or Path(folder) / "film.mp4"
        if arguments.film is None:
            rendered(film, arguments.people)
        commands = [whole_command(film, options) for _ in range(arguments.runs)]
        runs = [simulate(film, options) for _ in range(arguments.runs)]
        others = [peer(film) for _ in range(arguments.runs if arguments.peer else 0)]
    stages = sorted({stage for run in runs for stage in run.stages})
    medians = {stage: statistics.median(run.stages.get(stage, 0.0) for run in runs) for stage in stages}
    total = statistics.median(sum(run.stages.values()) for run in runs)
    for stage, seconds in sorted(medians.items(), key=lambda item: -item[1]):
        print(f"{stage:30} {seconds:7.2f} s {100 * seconds / total:5.1f} %")
    wall = statistics.median(run.wall for run in runs)
    print(
        f"whole command {statistics.median(commands):.2f} s; with libraries loaded {wall:.2f} s, sum of stages "
        f"{total:.2f} s (medians of {len(runs)})"
    )
    if others:
        ours, theirs = statistics.median(run.finding for run in runs), statistics.median(others)
        print(f"people found in {ours:.2f} s, by the peer in {theirs:.2f} s: {theirs / ours:.2f} times")


if __name__ == "__main__":
    main()
