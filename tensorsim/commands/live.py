"""``tensorsim live``: what a radar would see of the people in front of a camera, in real time."""

import sys
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tensorsim.commands.arguments import Option
from tensorsim.commands.networks import NetworkOptions, default_networks, load_networks
from tensorsim.commands.options import RadarOptions, load_recognizer, number_of_people
from tensorsim.exceptions import TensorsimError, collected_warnings, print_warnings
from tensorsim.files import check_folder
from tensorsim.limits import check_range

if TYPE_CHECKING:
    from tensorsim.live import LiveFrame, LiveSimulator
    from tensorsim.live.camera import Camera


@dataclass(frozen=True)
class Live(NetworkOptions, RadarOptions):
    """Simulate the radar in real time from a camera and show the result on a local web page.

    The page shows the camera image with the people in it, a scrolling Doppler-time map, and the labels. Frames that
    arrive too fast to be processed are dropped and counted. Ends with the film, or with Ctrl-C.

    Poses are lifted by nearest-neighbour matching, and the camera is not estimated: set pose.camera in a --config file.
    """

    camera: str
    """Camera number, address of a stream (rtsp://...), or a film to play in real time."""
    person_height: Annotated[Option[tuple[float, ...]], tyro.conf.arg(metavar="METRES ...")] = None
    """Body heights in metres in order of appearance, overriding those of the configuration (1.80, 1.70); the last one
    applies to all further people."""
    fps: Option[float] = None
    """Frames per second, overriding the source's value."""
    every_frame: bool = False
    """Process every frame of a film, however long that takes, instead of dropping frames to keep up with real time."""
    seconds: Annotated[Option[float], tyro.conf.arg(metavar="SECONDS")] = None
    """Stop after this many seconds of video."""
    port: int | None = 8787
    """Port of the page on 127.0.0.1; 0 picks a free one, None shows no page."""
    record: Option[Path] = None
    """Record the page to this video file (.webm or .mp4)."""

    def run(self) -> None:
        """Run the command."""
        self._check()
        # A run's summary may ask to estimate the camera, which needs the whole film.
        config = self.configuration().replace(pose__calibrate=False)
        if self.person_height is not None:
            config = config.replace(pose__person_height_m=self.person_height)
        networks = default_networks(
            self.detector or config.tracking.detector, self.pose or config.pose.network
        )

        import torch

        from tensorsim.live import LiveSimulator
        from tensorsim.live.camera import Camera

        torch.manual_seed(config.seed)
        with collected_warnings() as messages:
            camera = Camera(self.camera, self.fps, self.every_frame)
            recognizer = load_recognizer(config)
            live = LiveSimulator(
                config,
                camera.fps,
                *load_networks(*networks, config.pose.flip_test, self.engine),
                recognizer,
                self.least_probability,
            )
            said = self._warn(messages)
            try:
                with suppress(KeyboardInterrupt):
                    self._play(live, camera)
            finally:
                self._warn(messages[said:])
        seconds = (live.index + 1) / live.fps
        print(
            f"{self.camera}: {seconds:.1f} s, {number_of_people(live.appeared)}, {camera.dropped} frames dropped"
        )

    def _play(self, live: "LiveSimulator", camera: "Camera") -> None:
        """Simulate frame by frame, and show and record what comes out."""
        from tensorsim import plot
        from tensorsim.data.video_writer import VideoWriter
        from tensorsim.live.page import serving
        from tensorsim.live.view import LiveView

        view = LiveView(live, plot.MapStyle(self.colormap, self.dynamic_range))
        stopped: KeyboardInterrupt | SystemExit | TensorsimError | None = None
        with ExitStack() as stack:
            page = None if self.port is None else stack.enter_context(serving(self.port))
            if page is not None:
                print(f"showing http://127.0.0.1:{page.port}/ (Ctrl-C ends)", file=sys.stderr)
            film = None if self.record is None else stack.enter_context(VideoWriter(self.record, camera.fps))
            try:
                for frame, missing in camera.frames():
                    for _ in range(missing):
                        missed = live.miss()
                        view.add(missed)
                        self._say(missed, camera)
                    new = live.push(frame)
                    view.add(new)
                    picture = view.draw(new, frame.permute(1, 2, 0).numpy(), camera.dropped)
                    if page is not None:
                        page.show(picture)
                    if film is not None:
                        for _ in range(1 + missing):  # repeated for missing frames, to keep the length
                            film.add(picture)
                    self._say(new, camera)
                    if self.seconds is not None and new.time_s >= self.seconds:
                        break
            except (KeyboardInterrupt, SystemExit, TensorsimError) as error:  # SIGTERM is a SystemExit
                if film is None or film.count == 0:
                    raise
                stopped = error  # re-raised once the film is complete
        if stopped is not None:
            raise stopped

    @staticmethod
    def _warn(messages: list[str]) -> int:
        """Print warnings, and return how many."""
        print_warnings(messages)
        return len(messages)

    def _say(self, new: "LiveFrame", camera: "Camera") -> None:
        """Print a label when there is one."""
        if new.label is not None and not self.quiet:
            label = f"{new.label.label} ({new.label.probability:.2f})"
            print(f"{new.label.end_s:8.1f} s  {label:<34} dropped {camera.dropped}")

    def _check(self) -> None:
        """Refuse options that cannot work, before anything heavy is imported."""
        super().check(Path())
        if self.record is not None:
            check_folder(self.record.parent, "--record")
        for value in self.person_height or ():
            check_range(value, "body height", "--person-height")
        if self.fps is not None:
            check_range(self.fps, "frame rate", "--fps")
        if self.seconds is not None:
            check_range(self.seconds, "time", "--seconds")
        if self.port is not None and not 0 <= self.port < 65536:
            raise TensorsimError(f"--port: got {self.port}, expected a number from 0 to 65535")
        if self.record is not None and self.record.suffix.lower() not in (".mp4", ".webm"):
            raise TensorsimError(f"--record: got {self.record}, expected a name ending in .mp4 or .webm")
        camera = Path(self.camera)
        if (
            self.record is not None
            and self.record.exists()
            and camera.exists()
            and self.record.samefile(camera)
        ):
            raise TensorsimError(f"--record: got {self.record}, which is --camera, expected another file")
