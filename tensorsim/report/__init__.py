"""``report.html``: film, people in the world and maps of a run, played in sync in one file."""

from tensorsim.report.film import FilmStrip
from tensorsim.report.page import write_report

__all__ = ["FilmStrip", "write_report"]
