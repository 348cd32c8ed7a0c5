"""``tensorsim dataset``: labelled data sets of radar maps from a recipe."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tensorsim.commands.arguments import Option
from tensorsim.exceptions import TensorsimError, check_count, collected_warnings, print_warnings
from tensorsim.files import check_folder

if TYPE_CHECKING:
    from tensorsim.data.sets.engines import Engine


@dataclass(frozen=True)
class DatasetBuild:
    """Build a data set; running it again with the same arguments resumes it.

    The files depend on the recipe alone, not on the engine or the number of workers.
    """

    recipe: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RECIPE.yaml")]]
    """Recipe of the data set; `tensorsim dataset example` prints one."""
    out: Path
    """Folder for the data set."""
    workers: int = 1
    """Number of processes on this machine; ignored with --address."""
    engine: Literal["processes", "ray"] = "processes"
    """What runs the work; Ray also runs on clusters: pip install "tensorsim[scale]"."""
    address: Option[str] = None
    """Address of a running Ray cluster; all nodes must share the output folder. Default: start one here."""
    cache: Option[Path] = None
    """Folder for the people found in films; several data sets can share it. Default: OUT/.people."""
    strict: bool = False
    """Stop at the first clip that fails instead of recording it in failures.csv."""
    retry: bool = False
    """Retry samples that failed in an earlier run."""
    quiet: bool = False
    """No progress bars."""

    def run(self) -> None:
        """Run the command."""
        check_count(self.workers, "--workers")
        if self.address is not None and self.engine != "ray":
            raise TensorsimError("--address needs --engine ray")
        check_folder(self.out)
        from tensorsim.data.sets.build import build_dataset
        from tensorsim.data.sets.recipe import DatasetRecipe

        recipe = DatasetRecipe.from_yaml(self.recipe)
        with collected_warnings() as messages:
            engine = self._engine()
            built = build_dataset(recipe, self.out, engine, self.cache, self.strict, self.quiet, self.retry)
        print_warnings(messages)
        print(f"{self.out}: {built.samples} samples, {built.made} of them made now")
        if built.failures:
            clips = "1 clip" if built.failures == 1 else f"{built.failures} clips"
            print(f"Samples of {clips} failed, see failures.csv; --retry tries them again.")

    def _engine(self) -> "Engine":
        from tensorsim.data.sets.engines import Processes, RayCluster, Serial

        if self.engine == "ray":
            return RayCluster(self.address, self.workers)
        return Serial() if self.workers == 1 else Processes(self.workers)


@dataclass(frozen=True)
class DatasetExample:
    """Print a small recipe with comments: two activities, 8 samples."""

    large: bool = False
    """Print one for training instead: 100 people doing the 12 activities, seen by three radars, 1200 samples."""

    def run(self) -> None:
        """Run the command."""
        from tensorsim.data.sets.example import EXAMPLE, LARGE_EXAMPLE

        print(LARGE_EXAMPLE if self.large else EXAMPLE, end="")


@dataclass(frozen=True)
class DatasetSample:
    """Regenerate one sample of a data set from its row in the manifest, and compare it with the stored hash."""

    folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="DIR")]]
    """Folder of the data set."""
    id: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="ID")]]
    """ID of the sample in the manifest."""
    out: Option[Path] = None
    """Folder for the arrays of the sample, written as ID.RADAR.OUTPUT.npy."""

    def run(self) -> None:
        """Run the command."""
        from tensorsim.data.sets.again import sample_again
        from tensorsim.data.sets.shards import npy_bytes
        from tensorsim.files import write_bytes

        sample = sample_again(self.folder, self.id)
        if self.out is not None:
            for name, array in sample.arrays.items():
                write_bytes(self.out / f"{self.id}.{name}.npy", npy_bytes(array))
        print(f"{self.id}: {sample.row['label']}, the same to the bit ({sample.row['sha256']})")


@dataclass(frozen=True)
class DatasetVerify:
    """Check the files of a data set against their SHA-256 hashes in dataset.json."""

    folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="DIR")]]
    """Folder of the data set."""

    def run(self) -> None:
        """Run the command."""
        from tensorsim.data.sets.verify import wrong_files

        count, wrong = wrong_files(self.folder)
        for name, reason in wrong.items():
            print(f"WRONG {name}: {reason}")
        if wrong:
            raise TensorsimError(
                f"dataset verify: {len(wrong)} of {count} files of {self.folder} failed verification; `dataset build` "
                "makes missing ones again"
            )
        print(f"ok    {self.folder}: {count} files")
