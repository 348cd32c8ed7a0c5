"""Options of commands that simulate a whole clip: those that look ahead, and those of the output."""

import dataclasses
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import tyro

from tensorsim.array_files import array_formats
from tensorsim.commands.arguments import Option
from tensorsim.commands.options import RadarOptions, warn_of_label
from tensorsim.files import check_name
from tensorsim.process import is_command, keep_freed_memory, load_torch

if TYPE_CHECKING:
    import torch

    from tensorsim.config import SimulationConfig
    from tensorsim.pipeline import PoseToDoppler
    from tensorsim.plot.apart import Drawing
    from tensorsim.recognition import ActivityRecognizer
    from tensorsim.report import FilmStrip
    from tensorsim.results import Pictures
    from tensorsim.types import Pose, RadarMaps


@dataclass(frozen=True, kw_only=True)
class ClipOptions(RadarOptions):
    """How to simulate a whole clip, and what output to write."""

    people: Annotated[Option[str], tyro.conf.arg(metavar="all|moving|nearest|NUMBER")] = None
    """Who is in the scene: everybody, those who move, the nearest person, or one person by number. Default: all."""
    sway: Option[bool] = None
    """Make people sway while they stand. Default: off."""
    vital_signs: Option[bool] = None
    """Make people breathe and their hearts beat. Default: off."""
    motion: Option[Literal["smooth", "paper"]] = None
    """How motion is smoothed: two-sided smoothing with spline interpolation, or, as in the paper, a forward filter with
    linear interpolation and a Savitzky-Golay filter. Default: smooth."""
    denoiser: Option[str] = None
    """Denoiser for the displayed maps: none, perona-malik, ksvd (takes minutes), dncnn, or your own DnCNN weights
    (.pth, .safetensors or a name from `tensorsim models list`). Default: none."""
    figure_format: Literal["png", "pdf", "svg"] = "png"
    """File format of the figures."""
    hide_ridges: bool = False
    """Do not draw ridges on the Doppler-time map."""
    sound: bool = False
    """Also write doppler.wav, the micro-Doppler as sound: approaching motion on the left, receding motion on the
    right."""
    full_rate: bool = False
    """Keep one column per pulse in the range-time maps instead of 256 per second."""
    save: Annotated[str, tyro.conf.arg(metavar="npz,mat,h5")] = "npz"
    """File formats of maps and poses: npz, which is always written, plus mat (MATLAB) or h5 (HDF5)."""
    device: str = "auto"
    """Device: cpu, cuda, cuda:1, ...; auto uses a GPU if there is one."""

    def check(self, out: Path) -> None:
        """Refuse options that cannot work, before anything heavy is imported."""
        super().check(out)
        check_name(out, "--out")
        array_formats(self.save)

    @contextmanager
    def ready(self, out: Path) -> "Iterator[Drawing]":
        """Check the options, then load torch here and, for drawing during the block, matplotlib in another process."""
        self.check(out)
        if is_command():  # it affects the whole process, which may otherwise be somebody else's
            keep_freed_memory()
        from tensorsim.plot.apart import drawing_apart

        with drawing_apart() as drawing:
            load_torch()
            yield drawing

    def _begun(self) -> "SimulationConfig":
        config = super()._begun()
        if self.motion is None:
            return config
        from tensorsim.config import SimulationConfig, SmoothingConfig

        smoothing = SimulationConfig.paper().smoothing if self.motion == "paper" else SmoothingConfig()
        return config.replace(smoothing=smoothing)

    def described(self) -> dict[str, Any]:
        """The options given, as recorded in ``summary.json``."""
        defaults = {field.name: field.default for field in dataclasses.fields(self)}
        return {
            name: str(value) if isinstance(value, Path) else value
            for name, value in asdict(self).items()
            if value != defaults[name]
        }

    def pictures(
        self, stage: "PoseToDoppler", label: str | None, film: str | None, somebody: bool = True
    ) -> "Pictures":
        """How the maps and the people of this run are drawn.

        Args:
            stage: the stage that made the maps.
            label: the activity, if it is known.
            film: the source of the people.
            somebody: whether a person is in the scene; maps of an empty scene are scaled by the echo of a person.
        """
        from tensorsim import plot
        from tensorsim.results import Pictures

        simulator = stage.simulator
        return Pictures(
            plot.MapStyle(self.colormap, self.dynamic_range, not self.hide_ridges),
            self.figure_format,
            plot.caption(simulator.radar, label, film),
            None if somebody else plot.person_peaks(simulator),
        )

    def write_results(self, folder: Path, run: "Run", truth: "RadarMaps | None" = None) -> dict[str, Any]:
        """Label the maps of a run and write them, their pictures, the poses and the sound.

        Args:
            folder: output folder.
            run: the simulated run.
            truth: maps of the true motion, if known; drawn next to the others.

        Returns:
            The entries on the label for ``summary.json``.
        """
        from tensorsim import results
        from tensorsim.summary import label_of

        pose, maps, stage = run.pose, run.maps, run.stage
        duration_s = pose.valid.shape[2] / run.fps
        label = label_of(run.recognizer, maps, duration_s, self.least_probability)
        warn_of_label(run.recognizer, int(pose.valid.any(-1).sum()), duration_s)
        pictures = self.pictures(stage, label["label"], run.film, run.somebody)
        axes, formats = results.axes_of(stage, maps), array_formats(self.save)

        def save() -> None:
            results.save_maps(folder / "maps", maps, axes, formats)
            if truth is not None:
                results.save_maps(folder / "maps_truth", truth, axes, formats)
            results.save_pose(folder, pose, run.fps, formats)

        with ThreadPoolExecutor(1) as pool:
            saved = pool.submit(save)
            results.draw_maps(folder, maps, axes, run.drawing, truth, pictures)
            saved.result()
        if self.sound:
            results.write_doppler_sound(folder, stage, pose, run.fps, run.device)
        return label

    def write_report(
        self,
        folder: Path,
        run: "Run",
        strip: "FilmStrip",
        summary: dict[str, Any],
        truth: "RadarMaps | None" = None,
        further: Sequence[dict[str, Any]] = (),
    ) -> None:
        """Write ``report.html`` of a run with its overlay film and this summary, and further maps below the others."""
        from tensorsim import report, results

        axes = results.axes_of(run.stage, run.maps)
        pictures = self.pictures(run.stage, summary["label"], run.film, run.somebody)
        report.write_report(
            folder, summary, run.pose, run.fps, run.maps, axes, strip, pictures, truth, further
        )


class Run(NamedTuple):
    """What was simulated, and how.

    Attributes:
        config: of the run.
        stage: made the maps.
        recognizer: of the maps; None gives no label.
        pose, maps: what came out, on the CPU; the maps without batch dimensions.
        fps: frames per second of the poses.
        film: what the people come from, for the titles.
        somebody: whether a person is in the scene.
        device: that ``stage`` is on.
        drawing: draws the pictures.
    """

    config: "SimulationConfig"
    stage: "PoseToDoppler"
    recognizer: "ActivityRecognizer | None"
    pose: "Pose"
    maps: "RadarMaps"
    fps: float
    film: str
    somebody: bool
    device: "torch.device"
    drawing: "Drawing"
