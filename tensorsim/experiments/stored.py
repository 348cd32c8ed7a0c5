"""The results shipped with the package: tables of the experiments and the settings to repeat them."""

import csv
from pathlib import Path

from tensorsim.errors import TensorsimError

#: Folder of the reports (NAME.md), tables (NAME*.csv) and settings (NAME.yaml).
RESULTS = Path(__file__).with_name("results")


def stored_names() -> list[str]:
    """Experiments whose results are shipped with the package."""
    return sorted(path.stem for path in RESULTS.glob("*.yaml"))


def stored_table(name: str) -> list[dict[str, str]]:
    """Rows of a table by column, in the order of the file.

    Args:
        name: name of a CSV file without its suffix: an experiment, or ``NAME-PART``.

    Raises:
        TensorsimError: no such table.
    """
    path = RESULTS / f"{name}.csv"
    if not path.is_file():
        known = ", ".join(sorted(file.stem for file in RESULTS.glob("*.csv")))
        raise TensorsimError(f"results: got {name!r}, expected one of {known}")
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
