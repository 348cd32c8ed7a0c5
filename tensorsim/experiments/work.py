"""What all experiments have in common: the folder, cached results, tables and figures."""

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tensorsim.config.documents import digest
from tensorsim.errors import TensorsimError, check_choice, check_distinct
from tensorsim.files import write_text
from tensorsim.training.maps import SCENES

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Work:
    """The working environment of an experiment.

    Attributes:
        cache: folder of cached scene sets, trainings and results, by hash of what they depend on.
        jobs: number of parallel processes.
        quiet: no progress bars.
    """

    cache: Path
    jobs: int = 1
    quiet: bool = False

    def kept(self, name: str, settings: Any, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The result of ``make``, computed once for these settings and read from the cache afterwards.

        Raises:
            TensorsimError: the file in the cache is damaged.
        """
        path = self.cache / "results" / f"{name}-{digest(settings)}.json"
        if not path.is_file():
            write_result(path, make())
        return read_result(path)


def check_scenes(scenes: Sequence[str]) -> None:
    """Refuse unknown scenes, duplicates, and an empty list."""
    if not scenes:
        raise TensorsimError("scenes: got none, expected at least one")
    for scene in scenes:
        check_choice(scene, SCENES, "scenes")
    check_distinct(scenes, "scenes")


def counted(count: int, noun: str) -> str:
    """``1 clip``, ``2 clips``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def write_result(path: Path, content: dict[str, Any]) -> None:
    """Write a result as JSON, completely or not at all. NaN and infinity are preserved."""
    write_text(path, json.dumps(content))


def read_result(path: Path) -> dict[str, Any]:
    """Read what :func:`write_result` wrote.

    Raises:
        TensorsimError: a damaged file.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise TensorsimError(f"{path}: damaged ({error}); remove it to compute it again") from None
    if not isinstance(content, dict):
        raise TensorsimError(f"{path}: got {type(content).__name__}, expected a result")
    return content


@dataclass(frozen=True)
class Table:
    """Rows of numbers and text under named columns.

    Attributes:
        title: heading in the report.
        columns: names, with units.
        rows: one value per column; floats are written with ``digits`` digits in Markdown and in full in CSV.
        digits: decimal places in Markdown.
        file: part of the name of the CSV file; "" for the main table of an experiment.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    digits: int = 1
    file: str = ""

    def markdown(self) -> str:
        """As a Markdown table with its heading."""
        lines = [self.columns, ["---", *["---:"] * (len(self.columns) - 1)]]
        lines += [[self._shown(value) for value in row] for row in self.rows]
        table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        return f"## {self.title}\n\n{table}\n"

    def _shown(self, value: Any) -> str:
        if value is None or (isinstance(value, float) and value != value):
            return "-"
        if isinstance(value, float):
            return "equal" if value == float("inf") else f"{value:.{self.digits}f}"
        return str(value)

    def csv(self) -> str:
        """As CSV with a line of headings."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(["" if value is None else value for value in row] for row in self.rows)
        return text.getvalue()


@dataclass(frozen=True)
class Report:
    """Outcome of an experiment.

    Attributes:
        notes: paragraphs: what was measured and how, assumptions, and what the paper leaves open.
        tables: the first one is the main one.
        figures: figures by name.
    """

    notes: Sequence[str]
    tables: Sequence[Table]
    figures: "dict[str, Figure]" = field(default_factory=dict)

    def markdown(self, title: str) -> str:
        """The whole report."""
        return "\n\n".join([f"# {title}", *self.notes, *(table.markdown() for table in self.tables)])


def mean_and_spread(values: Sequence[float]) -> tuple[float, float]:
    """Mean, and standard deviation of the values (n - 1), NaN for fewer than two."""
    mean = sum(values) / len(values) if values else float("nan")
    if len(values) < 2:
        return mean, float("nan")
    return mean, (sum((v - mean) ** 2 for v in values) / (len(values) - 1)) ** 0.5
