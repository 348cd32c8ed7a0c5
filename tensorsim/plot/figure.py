"""Figures that need no window system, and saving them to files."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from tensorsim.exceptions import TensorsimError
from tensorsim.files import complete_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Suffixes that :func:`save_figure` writes.
FIGURE_FORMATS = ("png", "pdf", "svg")
_DPI = 120


def new_figure(width: float = 9.0, height: float = 5.0) -> Figure:
    """An empty figure of this size in inches; no pyplot, so no global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a picture in the format of its suffix: PNG, or PDF and SVG with lines and letters as vectors.

    Raises:
        TensorsimError: another suffix, or a file that cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    suffix = path.suffix.removeprefix(".").lower()
    if suffix not in FIGURE_FORMATS:
        expected = ", ".join(f".{name}" for name in FIGURE_FORMATS)
        raise TensorsimError(f"{path}: got the suffix {path.suffix!r}, expected one of {expected}")
    # Without the date, the same run always writes the same file.
    dated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
    with warnings.catch_warnings(), complete_file(path) as scratch:
        # File names of films may contain letters that the font lacks: a box is drawn in their place.
        warnings.filterwarnings("ignore", "Glyph .* missing from")
        if suffix == "png":
            # `savefig` draws twice, first for the layout alone, which drawing once settles as well.
            figure.set_dpi(_DPI)
            FigureCanvasAgg(figure).print_png(scratch)
        else:
            figure.savefig(scratch, format=suffix, dpi=_DPI, metadata=dated[suffix])
