"""``tensorsim experiment``: the tables and figures of the paper, made again."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from tensorsim.exceptions import TensorsimError


@dataclass(frozen=True)
class RunExperiment:
    """Run an experiment, or list them: `tensorsim experiment list`.

    Writes a report (NAME.md), tables (NAME*.csv), figures (NAME-*.png and .svg) and the settings that repeat it
    (NAME.yaml). Run again with the same arguments, it goes on where it stopped, to the same numbers. Options without a
    value keep that of the experiment; the report says what they are.
    """

    name: tyro.conf.Positional[str]
    """list, or a name that it prints."""
    out: Path | None = None
    """Folder of the results."""
    quick: bool = False
    """A small run of a minute or two, to see that everything works."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="YAML")] = None
    """Settings, such as the NAME.yaml of an earlier run."""
    cache: Path | None = None
    """Folder of scene sets, trained networks and single results. Default: OUT/work."""
    networks: tuple[str, ...] | None = None
    """Recognisers: spnet, ccln, ..."""
    scenes: tuple[str, ...] | None = None
    """free-space, through-wall."""
    inputs: tuple[str, ...] | None = None
    """doppler, range, ridges, merged."""
    denoisers: tuple[str, ...] | None = None
    """none, perona-malik, ksvd, dncnn."""
    activities: tuple[str, ...] | None = None
    """Names of activities; all twelve if none is given."""
    data: str | None = None
    """Folder of measured sets: glasgow_cfar_masks, kmkim_cw24_iq, radhar_points."""
    films: str | None = None
    """Folder of real films with labels.json, as `tensorsim evaluate films` takes it."""
    maps: str | None = None
    """Folder of simulated maps of everyday motion, as `tensorsim train everyday` makes them. Default: in the cache."""
    groups: int | None = None
    """Groups of these maps, of some 100 clips each."""
    clips: int | None = None
    """Clips per class."""
    test_clips: int | None = None
    """Clips per class of other people, to test on."""
    size: int | None = None
    """Height and width of the pictures."""
    epochs: int | None = None
    """Passes over the training clips."""
    steps: int | None = None
    """Batches of a training, where it does not count epochs."""
    film_steps: int | None = None
    """Batches of a training on the maps of everyday motion."""
    length_s: float | None = None
    """Length of a clip in seconds."""
    seeds: int | None = None
    """Trainings with different weights."""
    film_seeds: int | None = None
    """Trainings with different weights on the maps of everyday motion."""
    snr_db: tuple[float, ...] | None = None
    """Signal-to-noise ratios of the tests."""
    seed: int | None = None
    """Of people, motion and noise."""
    jobs: int = 1
    """Processes at a time."""
    settings: str | None = None
    """Folder with the NAME.yaml of earlier runs, for `paper`: the sizes of its experiments."""
    quiet: bool = False
    """No progress bars."""

    def run(self) -> None:
        """Do it."""
        from tensorsim.experiments.catalogue import (
            EXPERIMENTS,
            configuration,
            find_experiment,
            run_experiment,
        )
        from tensorsim.experiments.work import Work

        if self.name == "list":
            for name, experiment in EXPERIMENTS.items():
                print(f"{name:18s} {experiment.title}")
            return
        find_experiment(self.name)
        if self.out is None:
            raise TensorsimError("--out: got nothing, expected a folder for the results")
        for option, folder in (("--out", self.out), ("--cache", self.cache)):
            if folder is not None and folder.exists() and not folder.is_dir():
                raise TensorsimError(f"{option}: {folder} is a file, expected a folder")
        if self.jobs < 1:
            raise TensorsimError(f"--jobs: got {self.jobs}, expected at least 1")
        config = configuration(self.name, self.quick, self.config, self._settings())
        work = Work(self.out / "work" if self.cache is None else self.cache, self.jobs, self.quiet)
        report = run_experiment(self.name, self.out, config, work)
        print("\n".join(table.markdown() for table in report.tables))
        print(f"{self.out / self.name}.md")

    def _settings(self) -> dict[str, Any]:
        names = (
            "networks", "scenes", "inputs", "denoisers", "activities", "data", "films", "maps", "groups", "clips",
            "test_clips", "size", "epochs", "steps", "film_steps", "length_s", "seeds", "film_seeds",
            "snr_db", "seed", "settings",
        )  # fmt: skip
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}
