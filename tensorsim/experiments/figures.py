"""Figures of the experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tensorsim.exceptions import TensorsimError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def bars(groups: Mapping[str, Mapping[str, tuple[float, float]]], label: str, title: str) -> Figure:
    """Horizontal bars with their spread.

    Args:
        groups: by name of the bar, then of the group: value and standard deviation (NaN for none). Bars are in
            the order given, the first one on top.
        label: label of the axis, with its unit.
        title: title of the figure.

    Raises:
        TensorsimError: no values.
    """
    from tensorsim.plot.figure import new_figure

    names = list(groups)
    kinds = list(dict.fromkeys(kind for row in groups.values() for kind in row))
    if not kinds:
        raise TensorsimError(
            f"bars: got no values for {', '.join(names) or 'any name'}, expected at least one"
        )
    figure = new_figure(8.0, 1.2 + 0.32 * len(names) * max(1, len(kinds)))
    axes = figure.add_subplot()
    height = 0.8 / len(kinds)
    for k, kind in enumerate(kinds):
        values = [groups[name].get(kind, (np.nan, np.nan)) for name in names]
        places = np.arange(len(names)) + (k - (len(kinds) - 1) / 2) * height
        spread = [0.0 if np.isnan(s) else s for _, s in values]
        axes.barh(places, [v for v, _ in values], height, xerr=spread, label=kind, error_kw={"lw": 1})
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlabel(label)
    axes.set_title(title)
    if len(kinds) > 1:
        axes.legend(fontsize="small")
    return figure


def lines(
    curves: Mapping[str, Sequence[float]], x: Sequence[float], x_label: str, label: str, title: str
) -> Figure:
    """One line per name over ``x``; after ten colours, they repeat with another dash pattern."""
    from tensorsim.plot.figure import new_figure

    figure = new_figure(8.5, 5.0)
    axes = figure.add_subplot()
    for k, (name, values) in enumerate(curves.items()):
        style = ("-", "--", ":")[k // 10 % 3]
        axes.plot(x, values, style, marker="os^Dv"[k % 5], markersize=4, color=f"C{k % 10}", label=name)
    axes.set_xlabel(x_label)
    axes.set_ylabel(label)
    axes.set_title(title)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="x-small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def confusions(matrices: Mapping[str, np.ndarray], names: Sequence[str], title: str) -> Figure:
    """Confusion matrices side by side, true class in rows, shaded by the share of the true class."""
    from tensorsim.plot.figure import new_figure

    columns = min(4, len(matrices))
    rows = -(-len(matrices) // columns)
    figure = new_figure(3.4 * columns, 3.6 * rows)
    grid = figure.subplots(rows, columns, squeeze=False).flatten()
    for axes in grid[len(matrices) :]:
        axes.set_axis_off()
    for axes, (name, counts) in zip(grid, matrices.items(), strict=False):
        share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
        axes.imshow(share, cmap="Blues", vmin=0, vmax=1)
        axes.set_xticks(range(len(names)), names, fontsize=6, rotation=90)
        axes.set_yticks(range(len(names)), names, fontsize=6)
        axes.set_title(f"{name}: {100 * np.trace(counts) / max(1, counts.sum()):.0f} %", fontsize=9)
    figure.suptitle(f"{title} (true class in rows)")
    return figure


def map_grid(maps: Mapping[str, Mapping[str, np.ndarray]], title: str, range_db: float = 40.0) -> Figure:
    """Maps in dB below the peak of each, a row of pictures per name; axis values increase upwards."""
    from tensorsim.plot import decibels
    from tensorsim.plot.figure import new_figure

    columns = max(len(row) for row in maps.values())
    figure = new_figure(2.6 * columns, 0.5 + 2.0 * len(maps))
    grid = figure.subplots(len(maps), columns, squeeze=False)
    for line, (name, row) in zip(grid, maps.items(), strict=True):
        for axes in line[len(row) :]:
            axes.set_axis_off()
        for axes, (heading, magnitude) in zip(line, row.items(), strict=False):
            axes.imshow(
                decibels(magnitude, range_db),
                origin="lower",
                aspect="auto",
                cmap="turbo",
                vmin=-range_db,
                vmax=0,
            )
            axes.set_xticks([])
            axes.set_yticks([])
            axes.set_title(f"{name}: {heading}", fontsize=7)
    figure.suptitle(title)
    return figure
