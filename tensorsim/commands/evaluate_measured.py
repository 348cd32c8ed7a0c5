"""``tensorsim evaluate measured``: networks trained only on simulated radar, tested on measured radar."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tensorsim.commands.arguments import Option, Several
from tensorsim.exceptions import TensorsimError, check_count, check_seed
from tensorsim.files import check_folder, write_json, write_text


@dataclass(frozen=True)
class EvaluateMeasured:
    """Train on simulation alone and test on measured clips; then fine-tune on 10 measured clips per class, and on all.

    Prints a table and writes measured.json, confusion matrices, calibration results and the weights trained on
    simulation.
    """

    train: Path
    """Folder of measured sets to train on: glasgow_cfar_masks, kmkim_cw24_iq, radhar_points."""
    out: Path
    """Output folder."""
    test: Option[Path] = None
    """Folder of measured sets to test on, with the same layout. Default: the last 30 % of each class of --train, in
    file order; only the rest is then trained on. With --quick or --ablation, which learn nothing from --train, it may
    be the same folder."""
    quick: bool = False
    """Use the shipped weights, trained on simulation alone, and train nothing."""
    ablation: bool = False
    """Instead, train on simulation without each of its effects in turn, and print and write (ablation_SET.md) how much
    each contributes."""
    sets: Several[Literal["glasgow_cfar_masks", "kmkim_cw24_iq", "radhar_points"]] = ()
    """Names of the sets. Default: all that are in --train and, if given, --test."""
    clips: int = 300
    """Simulated clips per class."""
    repeats: int = 1
    """Number of trainings per simulation in an ablation, with consecutive seeds starting at --seed."""
    steps: int = 600
    """Batches of 64 when training on simulation; half as many with a few measured clips, twice as many with all."""
    seed: int = 0
    """Random seed for simulation and training."""
    quiet: bool = False
    """No progress bar."""

    def run(self) -> None:
        """Run the command."""
        check_seed(self.seed, "--seed")
        for name, count in (("--clips", self.clips), ("--steps", self.steps), ("--repeats", self.repeats)):
            check_count(count, name)
        check_folder(self.out)
        folders = [self.train] if self.test is None else [self.train, self.test]
        for folder in folders:
            if not folder.is_dir():
                raise TensorsimError(f"{folder}: no such folder, expected measured sets")

        if self.quick and self.ablation:
            raise TensorsimError("--quick cannot be combined with --ablation, which trains networks")
        for name in ("clips", "steps", "seed"):
            value, usual = getattr(self, name), getattr(EvaluateMeasured, name)
            if self.quick and value != usual:
                raise TensorsimError(f"--{name}: got {value} with --quick, which trains nothing")
        if self.repeats > 1 and not self.ablation:
            raise TensorsimError(f"--repeats: got {self.repeats} without --ablation, expected 1")

        from tensorsim.evaluation.measured.ablation import ablation, ablation_table
        from tensorsim.evaluation.measured.report import figures, table, write
        from tensorsim.evaluation.measured.run import Experiment
        from tensorsim.evaluation.measured.sets import SETS

        there = [s for s in SETS if all((folder / s.name).is_dir() for folder in folders)]
        chosen = [s for s in SETS if s.name in self.sets] if self.sets else there
        if not chosen:
            names = ", ".join(s.name for s in SETS)
            raise TensorsimError(
                f"{', '.join(map(str, folders))}: no data set is present in every folder, expected some of {names}"
            )
        experiments = [
            Experiment(
                measured, self.train, self.test, self.out, self.clips, self.steps, self.seed, self.quiet
            )
            for measured in chosen
        ]
        if not (self.quick or self.ablation):
            for experiment in experiments:
                experiment.check_full()
        results, errors = {}, {}
        for measured, experiment in zip(chosen, experiments, strict=True):
            if self.ablation:
                rows = ablation_table(experiment, ablation(experiment, self.repeats))
                write_text(self.out / f"ablation_{measured.name}.md", rows + "\n")
                print(rows, flush=True)
                continue
            logits = experiment.quick() if self.quick else experiment.full()
            results[measured.name] = figures(measured, logits, experiment.test_labels)
            errors[measured.name] = write(self.out, measured.name, measured, logits, experiment.test_labels)
            write_json(self.out / "measured.json", results)
        if results:
            print(table(results, errors))
