"""Pictures of maps: range-time, Doppler-time with its ridges, and confusion matrices."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from tensorsim.exceptions import TensorsimError, TensorsimWarning, check_positive
from tensorsim.plot.figure import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

    from tensorsim.config import RadarConfig
    from tensorsim.radar.simulator import RadarSimulator

#: One colour per ridge, of which there are 6 at most: distinct from each other and from the strong end of colour maps.
RIDGE_COLOURS = ("white", "magenta", "black", "blue", "cyan", "#ff9ccb")

#: Pictures show levels down to this far below the peak.
DYNAMIC_RANGE_DB = 50.0

ColormapName = Literal["turbo", "viridis", "jet", "parula", "gray"]

#: Colours at equal steps of a map from dark blue through green to yellow, of steadily rising lightness, similar to
#: MATLAB's parula.
_PARULA_LIKE = ("#2f2d8c", "#2a5bdc", "#1a88dc", "#12a6c0", "#3cb88c", "#93bf57", "#e8bc3e", "#f8f02c")
_MAX_COLUMNS = 2000
#: A ridge is hidden where the map around it is narrower than this fraction of the picture: dots would cover it.
_LEAST_HEIGHT = 0.03


@dataclass(frozen=True)
class MapStyle:
    """How maps are drawn.

    Args:
        colormap: of matplotlib, or ``"parula"`` for one like MATLAB's.
        dynamic_range_db: what lies further below the peak has the colour of the floor.
        ridges: whether to draw the ridges.

    Raises:
        TensorsimError: an unknown colour map, or a range that is not positive.
    """

    colormap: ColormapName = "turbo"
    dynamic_range_db: float = DYNAMIC_RANGE_DB
    ridges: bool = True

    def __post_init__(self) -> None:
        if self.colormap not in get_args(ColormapName):
            raise TensorsimError(f"colormap: got {self.colormap!r}, expected one of {get_args(ColormapName)}")
        check_positive(self.dynamic_range_db, "dynamic_range_db")


def colormap(name: ColormapName) -> Colormap:
    """The colour map of this name, see :class:`MapStyle`."""
    import matplotlib
    from matplotlib.colors import LinearSegmentedColormap

    if name == "parula":
        return LinearSegmentedColormap.from_list("parula-like", _PARULA_LIKE)
    return matplotlib.colormaps[name]


def decibels(magnitude: np.ndarray, dynamic_range_db: float, peak: float | None = None) -> np.ndarray:
    """Magnitude in dB below a peak, its own by default, clipped to ``-dynamic_range_db`` (also where it is zero)."""
    peak = float(magnitude.max(initial=0.0)) if peak is None else peak
    if peak <= 0:
        return np.full_like(magnitude, -dynamic_range_db)
    return np.maximum(20 * np.log10(np.maximum(magnitude / peak, 1e-12)), -dynamic_range_db)


def person_peaks(simulator: RadarSimulator) -> dict[str, float]:
    """Peaks of the maps of a target of 1 m^2 at 3 m that approaches at 1 m/s: about those of one person.

    It is nearer or farther if the range bins do not include 3 m, and slower if 1 m/s is more than half the unambiguous
    speed or would move it by more than 1 m.

    An empty scene has no echo of its own to refer to; drawn relative to these peaks, its noise appears as weak as it
    is. The state of the random generator is left unchanged.

    Returns:
        By name: ``range_time``, ``range_time_mti`` and ``doppler_time``.
    """
    import torch

    radar, bins = simulator.radar, simulator.range_profile.range_m
    time_s = torch.arange(2 * simulator.min_pulses, device=bins.device) / radar.prf_hz
    distance_m = min(max(3.0, float(bins[0])), float(bins[-1]) + radar.range_resolution_m / 2)
    speed_m_s = min(1.0, radar.unambiguous_speed_m_s / 2, 1.0 / float(time_s[-1]))
    positions = bins.new_tensor(radar.middle_m, dtype=torch.float32).repeat(time_s.shape[0], 1, 1)
    positions[:, 0, 1] += distance_m - speed_m_s * time_s
    with torch.random.fork_rng(), torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore", TensorsimWarning)  # about a target that is not the user's
        maps = simulator(positions, torch.ones(1, device=bins.device))
    return {
        name: float(getattr(maps, name).max()) for name in ("range_time", "range_time_mti", "doppler_time")
    }


def caption(radar: RadarConfig, label: str | None = None, film: str | os.PathLike[str] | None = None) -> str:
    """One line below the title of a picture: the film if given, the radar, and the label if given."""
    # File names need not be UTF-8, but matplotlib draws nothing else.
    parts = [] if film is None else [Path(film).name.encode(errors="replace").decode()]
    parts.append(
        f"{radar.carrier_hz / 1e9:.4g} GHz, sweep {radar.bandwidth_hz / 1e9:.3g} GHz, PRF {radar.prf_hz:.5g} Hz"
    )
    return " | ".join(parts if label is None else [*parts, label])


def thin_columns(magnitude: np.ndarray) -> np.ndarray:
    """Reduce the time axis to about 2000 columns by averaging power: more than a picture can show would alias."""
    block = magnitude.shape[1] // _MAX_COLUMNS
    if block < 2:
        return magnitude
    columns = magnitude.shape[1] // block * block
    power = np.square(magnitude[:, :columns]).reshape(magnitude.shape[0], -1, block)
    return np.sqrt(power.mean(axis=2))


def map_figure(
    magnitude: np.ndarray,
    time_s: np.ndarray,
    axis: np.ndarray,
    title: str,
    axis_label: str,
    ridges: np.ndarray | None = None,
    speed_per_axis: float | None = None,
    half_span: float | None = None,
    reference: np.ndarray | None = None,
    reference_ridges: np.ndarray | None = None,
    *,
    style: MapStyle | None = None,
    subtitle: str | None = None,
    peak: float | None = None,
    note: str | None = None,
) -> Figure:
    """Draw a map (rows, columns) in dB below its peak and, if given, beside it that of the true motion.

    Args:
        magnitude: (R or F, K) linear magnitude.
        time_s: (K,) centre of each column in seconds.
        axis: (R or F,) centre of each row in the units of ``axis_label``.
        title: heading; with a reference each map says which it is.
        axis_label: name and unit of the vertical axis.
        ridges: (C, K) lines to draw over it in units of ``axis``; NaN is not drawn. They are hidden where they would
            cover the map: where it is narrow around them, or where another ridge is drawn already.
        speed_per_axis: m/s per unit of ``axis``, for a second scale on the right.
        half_span: show rows from ``-half_span`` to ``half_span`` only.
        reference: the map of the true motion, of the same axes.
        reference_ridges: its ridges.
        style: colours, dynamic range, and whether ridges are drawn.
        subtitle: a line below the title, see :func:`caption`.
        peak: the magnitude of 0 dB; by default each map's own. For an empty scene take :func:`person_peaks`.
        note: text to write over the map, such as "no person in the scene".
    """
    style = MapStyle() if style is None else style
    panels = [(magnitude, ridges, title)]
    if reference is not None:
        panels = [
            (magnitude, ridges, f"{title} from the film"),
            (reference, reference_ridges, f"{title} from the true motion"),
        ]
    figure = new_figure(width=9.0 if reference is None else 15.0)
    row = np.atleast_1d(figure.subplots(1, len(panels), sharey=True))
    step = float(axis[1] - axis[0]) if len(axis) > 1 else 1.0
    span_s = float(time_s[1] - time_s[0]) if len(time_s) > 1 else 1.0
    low, high = float(axis[0]) - step / 2, float(axis[-1]) + step / 2
    extent = (float(time_s[0]) - span_s / 2, float(time_s[-1]) + span_s / 2, low, high)
    if half_span is not None:
        low, high = max(low, -half_span), min(high, half_span)
    for axes, (levels, lines, heading) in zip(row, panels, strict=True):
        image = axes.imshow(
            decibels(thin_columns(levels), style.dynamic_range_db, peak),
            origin="lower",
            aspect="auto",
            interpolation="nearest",
            cmap=colormap(style.colormap),
            vmin=-style.dynamic_range_db,
            vmax=0.0,
            extent=extent,
        )
        if lines is not None and style.ridges:
            drawn = drawn_ridges(lines, axis, levels, high - low, style.dynamic_range_db, peak)
            _draw_ridges(axes, time_s, drawn)
        if note is not None:
            _write_note(axes, note)
        axes.set_ylim(low, high)
        axes.set_title(heading)
        axes.set_xlabel("time in s")
    row[0].set_ylabel(axis_label)
    if row[0].lines:
        # Below the maps, where it covers nothing.
        figure.legend(
            handles=row[0].lines,
            loc="outside lower center",
            ncols=len(row[0].lines),
            fontsize="small",
            markerscale=3,
            facecolor="darkgray",
        )
    if subtitle is not None:
        figure.suptitle(subtitle, fontsize="small", color="dimgray", parse_math=False)
    if speed_per_axis is not None:
        _add_speed_axis(row[-1], speed_per_axis)
    label = "dB below the peak" if peak is None else "dB below the echo of a person"
    figure.colorbar(image, ax=list(row), label=label, pad=0.02)
    return figure


def doppler_span(
    magnitude: np.ndarray, doppler_hz: np.ndarray, dynamic_range_db: float = DYNAMIC_RANGE_DB
) -> float:
    """Largest Doppler in Hz, either way, up to which a Doppler-time map (F, K) has something to show, with a margin.

    Noise may be above the floor of the colours, but rows of noise stand out neither from other rows nor over time.
    """
    levels = decibels(magnitude, 120.0)
    strongest = levels.max(1)
    noise = np.minimum(np.median(strongest), np.median(levels, axis=1) + 9)
    rows = (strongest > -dynamic_range_db) & (strongest > noise + 6)
    return 1.25 * float(np.abs(doppler_hz[rows]).max(initial=doppler_hz[-1] / 8))


def _write_note(axes: Axes, note: str) -> None:
    """Write text in the middle of a map."""
    box = {"facecolor": "black", "alpha": 0.6, "edgecolor": "none"}
    axes.text(0.5, 0.5, note, transform=axes.transAxes, ha="center", va="center", color="white", bbox=box)


def _add_speed_axis(axes: Axes, speed_per_axis: float) -> None:
    """A second scale on the right: a twin, because the layout leaves room for that but not for a secondary axis."""
    right = axes.twinx()
    low, high = axes.get_ylim()
    right.set_ylim(low * speed_per_axis, high * speed_per_axis)
    right.set_ylabel("radial speed in m/s")


def drawn_ridges(
    ridges: np.ndarray,
    axis: np.ndarray,
    magnitude: np.ndarray,
    height: float,
    dynamic_range_db: float,
    peak: float | None = None,
) -> np.ndarray:
    """Ridges without the points that would cover the map (F, K) in a picture of it.

    Args:
        ridges, axis: see :func:`clear_ridges`.
        magnitude: of the map.
        height: of the visible part of the axis.
        dynamic_range_db, peak: of the picture's colours, see :func:`decibels`.
    """
    shown = decibels(magnitude, dynamic_range_db, peak) > -dynamic_range_db
    return clear_ridges(ridges, axis, shown, _LEAST_HEIGHT * height)


def clear_ridges(ridges: np.ndarray, axis: np.ndarray, shown: np.ndarray, least_height: float) -> np.ndarray:
    """Ridges without the points that would cover what they mark.

    Args:
        ridges: (C, K) in units of ``axis``; where two meet, the first one is kept.
        axis: (F,) ascending, evenly spaced.
        shown: (F, K) bool, where the map stands out from the floor of the colours.
        least_height: points stay where the connected stretch of shown rows around them is this high, in units of
            ``axis``, and no earlier ridge is within a quarter of that.

    Returns:
        (C, K), NaN where not drawn.
    """
    step = float(axis[1] - axis[0])
    kept = np.full(ridges.shape, np.nan)
    for k in range(ridges.shape[1]):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], shown[:, k], [False]]).astype(int)))
        starts, stops = edges[::2], edges[1::2]
        for c in range(ridges.shape[0]):
            if np.isnan(ridges[c, k]):
                continue
            bin_index = round((ridges[c, k] - float(axis[0])) / step)
            height = (stops - starts)[(starts <= bin_index) & (bin_index < stops)].sum() * step
            distance = np.abs(kept[:c, k] - ridges[c, k])
            if height >= least_height and not (distance < least_height / 4).any():
                kept[c, k] = ridges[c, k]
    return kept


def _draw_ridges(axes: Axes, time_s: np.ndarray, ridges: np.ndarray) -> None:
    for i, ridge in enumerate(ridges):
        colour = RIDGE_COLOURS[i % len(RIDGE_COLOURS)]
        axes.plot(time_s, ridge, ".", color=colour, markersize=2.5, markeredgewidth=0, label=f"ridge {i + 1}")


def confusion_figure(counts: np.ndarray, names: list[str], title: str) -> Figure:
    """Confusion matrix (classes, classes), true class in rows, shaded by the share of the true class."""
    figure = new_figure(6.0, 5.6)
    axes = figure.add_subplot()
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for (row, column), count in np.ndenumerate(counts):
        if count:
            colour = "white" if share[row, column] > 0.5 else "black"
            axes.text(column, row, str(count), ha="center", va="center", color=colour, fontsize=8)
    axes.set_xticks(range(len(names)), names, parse_math=False)
    axes.set_yticks(range(len(names)), names, parse_math=False)
    axes.set_xlabel("predicted")
    axes.set_ylabel("true")
    axes.set_title(title)
    return figure
