"""All experiments in one report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tensorsim.errors import TensorsimError
from tensorsim.experiments.work import Report, Table, Work

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tensorsim.experiments.catalogue import Experiment


@dataclass(frozen=True)
class PaperConfig:
    """Settings of ``paper``.

    Attributes:
        quick: run all of them in their quick form.
        settings: folder with the NAME.yaml of earlier runs; experiments without one use their defaults.
        data, films: folders of measured sets and of real films for ``real``, which is left out if neither is given.
        maps: folder of simulated maps of everyday motion for ``real``; "" is one in the cache.
    """

    quick: bool = False
    settings: str = ""
    data: str = ""
    films: str = ""
    maps: str = ""

    def __post_init__(self) -> None:
        if self.settings and not any(Path(self.settings).glob("*.yaml")):
            raise TensorsimError(
                f"--settings: got {self.settings}, expected a folder with NAME.yaml of experiments"
            )
        if self.settings and self.quick:
            raise TensorsimError("--settings: got a folder and --quick, expected one of them")
        if self.maps and not self.films:
            raise TensorsimError(
                "--maps: has no effect without --films, which networks trained on these maps label"
            )


def paper_report(settings: Mapping[str, Any], work: Work, experiments: Mapping[str, Experiment]) -> Report:
    """The reports of these experiments in one, each with its settings."""
    notes: list[str] = [
        "The experiments of RadHARSimulator V2 (arXiv 2511.09022), made again on declared data with declared figures."
    ]
    tables: list[Table] = []
    drawn: dict[str, Figure] = {}
    for name, experiment in experiments.items():
        if name not in settings:
            notes.append(
                f"**{name}** is left out: no folder of measured sets (--data) or of films (--films) was given."
            )
            continue
        found = experiment.run(settings[name], work)
        notes += [f"**{name}**: {found.notes[0]}", *found.notes[1:]]
        tables += [
            Table(f"{name}: {t.title}", t.columns, t.rows, t.digits, f"{name}-{t.file}" if t.file else name)
            for t in found.tables
        ]
        drawn |= {f"{name}-{figure}": content for figure, content in found.figures.items()}
    return Report(notes, tables, drawn)
