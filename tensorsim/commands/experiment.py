"""``tensorsim experiment``: the tables and figures of the paper, reproduced."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from tensorsim.commands.arguments import Option
from tensorsim.exceptions import TensorsimError, check_count
from tensorsim.files import check_folder


@dataclass(frozen=True)
class RunExperiment:
    """Run an experiment, or list them all: `tensorsim experiment list`.

    Writes a report (NAME.md), tables (NAME*.csv), figures (NAME-*.png and .svg) and the settings to repeat it
    (NAME.yaml). Running it again with the same arguments resumes it, with the same results. Options not given keep the
    experiment's defaults, which the report lists.
    """

    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")]
    """Name of an experiment, or list to print the names."""
    out: Option[Path] = None
    """Output folder."""
    quick: bool = False
    """Do a small test run (one to two minutes)."""
    config: Annotated[Option[Path], tyro.conf.arg(metavar="YAML")] = None
    """Settings file, such as the NAME.yaml of an earlier run."""
    cache: Option[Path] = None
    """Folder for scene sets, trained networks and intermediate results. Default: OUT/work."""
    networks: Annotated[Option[tuple[str, ...]], tyro.conf.arg(metavar="NAME ...")] = None
    """Recognisers: spnet, ccln, ..."""
    scenes: Annotated[Option[tuple[str, ...]], tyro.conf.arg(metavar="NAME ...")] = None
    """Scenes: free-space, through-wall."""
    inputs: Annotated[Option[tuple[str, ...]], tyro.conf.arg(metavar="NAME ...")] = None
    """Inputs of the recognisers: doppler, range, ridges, merged."""
    denoisers: Annotated[Option[tuple[str, ...]], tyro.conf.arg(metavar="NAME ...")] = None
    """Denoisers: none, perona-malik, ksvd, dncnn."""
    activities: Annotated[Option[tuple[str, ...]], tyro.conf.arg(metavar="NAME ...")] = None
    """Names of activities. Default: all twelve."""
    data: Option[str] = None
    """Folder of measured sets: glasgow_cfar_masks, kmkim_cw24_iq, radhar_points."""
    films: Option[str] = None
    """Folder of real films with labels.json, as for `tensorsim evaluate films`."""
    maps: Option[str] = None
    """Folder of simulated maps of everyday motion, as made by `tensorsim train everyday`. Default: in the cache."""
    groups: Option[int] = None
    """Number of groups of these maps, with about 100 clips each."""
    clips: Option[int] = None
    """Clips per class."""
    test_clips: Option[int] = None
    """Test clips per class, by other people."""
    size: Option[int] = None
    """Height and width of the images."""
    epochs: Option[int] = None
    """Passes over the training clips."""
    steps: Option[int] = None
    """Number of batches for trainings that do not count epochs."""
    film_steps: Option[int] = None
    """Number of batches when training on the maps of everyday motion."""
    length_s: Option[float] = None
    """Length of a clip in seconds."""
    seeds: Option[int] = None
    """Number of trainings, each with different initial weights."""
    film_seeds: Option[int] = None
    """Number of trainings on the maps of everyday motion, each with different initial weights."""
    snr_db: Annotated[Option[tuple[float, ...]], tyro.conf.arg(metavar="DB ...")] = None
    """Signal-to-noise ratios in dB to test at."""
    seed: Option[int] = None
    """Random seed for people, motion and noise."""
    jobs: int = 1
    """Number of processes, for `networks`, `snr`, `inputs` and `paper` only."""
    settings: Option[str] = None
    """Folder with the NAME.yaml of earlier runs, for `paper`: they set the sizes of its experiments."""
    quiet: bool = False
    """No progress bars."""

    def run(self) -> None:
        """Run the command."""
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
        check_folder(self.out)
        if self.cache is not None:
            check_folder(self.cache, "--cache")
        check_count(self.jobs, "--jobs")
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
