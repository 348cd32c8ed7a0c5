"""All experiments in one report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tensorsim.experiments.work import Report, Table, Work

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tensorsim.experiments.catalogue import Experiment


@dataclass(frozen=True)
class PaperConfig:
    """Settings of ``paper``.

    Attributes:
        quick: all of them in their quick form.
        data, films: folders of measured sets and of real films for ``real``; without both, that one is left out.
    """

    quick: bool = False
    data: str = ""
    films: str = ""


def paper_report(config: PaperConfig, work: Work, experiments: Mapping[str, Experiment]) -> Report:
    """The reports of the experiments under one roof; each has its own settings."""
    from dataclasses import replace

    notes: list[str] = [
        "The experiments of RadHARSimulator V2 (arXiv 2511.09022), made again on declared data with declared figures."
    ]
    tables: list[Table] = []
    drawn: dict[str, Figure] = {}
    for name, experiment in experiments.items():
        settings = experiment.quick() if config.quick else experiment.config()
        if name == "real":
            if not config.data and not config.films:
                notes.append(
                    "**real** is left out: no folder of measured sets (--data) or of films (--films) was given."
                )
                continue
            settings = replace(settings, data=config.data, films=config.films)
        found = experiment.run(settings, work)
        notes += [f"**{name}**: {found.notes[0]}", *found.notes[1:]]
        tables += [
            Table(f"{name}: {t.title}", t.columns, t.rows, t.digits, f"{name}-{t.file}" if t.file else name)
            for t in found.tables
        ]
        drawn |= {f"{name}-{figure}": content for figure, content in found.figures.items()}
    return Report(notes, tables, drawn)
