"""Memory and delay of the live simulation over an hour of a film that is played again and again.

    python -m tests.benchmarks.bench_live [--minutes 60] [--film FILE] [--scene through-wall]

The time is that of the film, not of the clock: frames are played as fast as they can be worked on. The networks answer
once for each frame of the film; in later rounds their answers are repeated, which leaves everything else as it is.
Without a film, a generated person walks for ten seconds.
"""

import argparse
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

import tensorsim as ts
from tensorsim.commands.demo import film_person
from tensorsim.data.video_writer import write_video
from tensorsim.live.camera import Camera
from tensorsim.live.view import LiveView
from tensorsim.radar.presets import PRESETS


def resident_mb() -> float:
    """Memory of this process that is in use now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


class Repeated:
    """Answers of the networks by frame of the film."""

    def __init__(self, live: ts.LiveSimulator, frames: int) -> None:
        self.live, self.frames = live, frames
        self.vision = live.vision
        self.found: dict[int, Any] = {}
        self.seen: dict[tuple[int, int], Any] = {}
        live.vision.detect, self._detect = self.detect, live.vision.detect  # type: ignore[method-assign]
        live.vision.estimate, self._estimate = self.estimate, live.vision.estimate  # type: ignore[method-assign]

    def detect(self, frames: torch.Tensor) -> Any:
        index = self.live.index % self.frames
        if index not in self.found:
            self.found[index] = self._detect(frames)
        return self.found[index]

    def estimate(self, frames: torch.Tensor, boxes: torch.Tensor, valid: torch.Tensor) -> Any:
        key = self.live.index % self.frames, valid.shape[1]
        if key not in self.seen:
            self.seen[key] = self._estimate(frames, boxes, valid)
        return self.seen[key]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--film", type=Path)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--scene", choices=sorted(PRESETS), default="free-space")
    arguments = parser.parse_args()
    if arguments.minutes <= 1:
        parser.error(f"--minutes: got {arguments.minutes}, expected more than the first one, to compare with")
    with tempfile.TemporaryDirectory() as folder:
        film = arguments.film or Path(folder) / "film.mp4"
        if arguments.film is None:
            frames = film_person(7, 300, seed=0).film.frames.permute(0, 2, 3, 1).numpy()
            write_video(film, frames, 30.0)
        run(arguments, film)


def run(arguments: argparse.Namespace, film: Path) -> None:
    """Play the film and print what became of memory and delay."""
    preset = PRESETS[arguments.scene]
    config = ts.SimulationConfig().replace(scene__radar=preset.radar, scene__wall=preset.wall)
    camera = Camera(str(film), every_frame=True, loops=10**9)
    length = sum(chunk.shape[0] for chunk in camera.reader.chunks(16))
    live = ts.LiveSimulator(config, camera.fps)
    Repeated(live, length)
    view = LiveView(live)
    minute, longest_s, start = 0.0, 0.0, time.process_time()
    for frame, _ in camera.frames():
        new = live.push(frame)
        view.draw(new, frame.permute(1, 2, 0).numpy(), camera.dropped)
        if new.time_s > 1.0:
            longest_s = max(longest_s, new.delay_s)
        if not minute and new.time_s >= 60.0:
            minute = resident_mb()
            print(f"after {new.time_s:7.1f} s: {minute:7.1f} MB", flush=True)
        if new.time_s >= 60 * arguments.minutes:
            break
    end = resident_mb()
    print(f"after {new.time_s:7.1f} s: {end:7.1f} MB, {100 * (end / minute - 1):+.1f} %")
    print(f"longest delay {longest_s:.3f} s of film, {live.appeared} people appeared")
    print(f"processor {1000 * (time.process_time() - start) / (live.index + 1):.1f} ms per frame")


if __name__ == "__main__":
    main()
