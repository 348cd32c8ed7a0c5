"""The results of a run in one picture: ``python -m tensorsim.plot.overview FOLDER PICTURE``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tensorsim.exceptions import TensorsimError
from tensorsim.files import complete_file
from tensorsim.plot.figure import new_figure
from tensorsim.plot.maps import MapStyle, colormap, decibels, doppler_span, thin_columns

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def overview_figure(folder: Path, style: MapStyle | None = None) -> Figure:
    """A frame of the overlay film, the range-time map and the Doppler-time map of a run, side by side.

    Args:
        folder: written by ``tensorsim simulate`` or ``tensorsim demo``.
        style: of the maps; by default turbo with 40 dB.

    Raises:
        TensorsimError: missing files.
    """
    from tensorsim.data.clip import read_video

    style = MapStyle(dynamic_range_db=40.0) if style is None else style
    for name in ("overlay.mp4", "maps.npz"):
        if not (folder / name).is_file():
            raise TensorsimError(
                f"{folder}: got no {name}, expected a folder that `tensorsim simulate` wrote"
            )
    frames = read_video(folder / "overlay.mp4").video[0]
    with np.load(folder / "maps.npz") as file:
        maps = {name: file[name] for name in file.files}
    span_hz = doppler_span(maps["doppler_time"], maps["doppler_hz"], style.dynamic_range_db)
    figure = new_figure(12.0, 2.9)
    picture, range_axes, doppler_axes = figure.subplots(1, 3, width_ratios=(1.25, 1, 1))
    picture.imshow(frames[frames.shape[0] // 2].permute(1, 2, 0).numpy())
    picture.set_axis_off()
    picture.set_title("people found in the film", fontsize="medium")
    duration_s = maps["range_time_mti"].shape[1] / float(maps["range_time_rate_hz"])
    first_s, last_s = float(maps["time_s"][0]), float(maps["time_s"][-1])
    for axes, name, axis, times, title, unit in (
        (range_axes, "range_time_mti", maps["range_m"], (0, duration_s), "range-time map", "range in m"),
        (
            doppler_axes,
            "doppler_time",
            maps["doppler_hz"],
            (first_s, last_s),
            "Doppler-time map",
            "Doppler in Hz",
        ),
    ):
        image = axes.imshow(
            decibels(thin_columns(maps[name]), style.dynamic_range_db),
            origin="lower",
            aspect="auto",
            cmap=colormap(style.colormap),
            vmin=-style.dynamic_range_db,
            vmax=0,
            extent=(*times, float(axis[0]), float(axis[-1])),
        )
        axes.set_title(title, fontsize="medium")
        axes.set_xlabel("time in s")
        axes.set_ylabel(unit)
    doppler_axes.set_ylim(-span_hz, span_hz)
    figure.colorbar(image, ax=[range_axes, doppler_axes], label="dB below the peak", pad=0.01)
    return figure


def save_small(figure: Figure, path: Path) -> None:
    """Write a PNG with 256 colours, a third of the size, for web pages."""
    from io import BytesIO

    from PIL import Image

    full = BytesIO()
    figure.savefig(full, dpi=100)
    with complete_file(path) as scratch:
        Image.open(full).convert("RGB").quantize(256).save(scratch, format="PNG", optimize=True)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit("usage: python -m tensorsim.plot.overview FOLDER PICTURE.png")
    save_small(overview_figure(Path(sys.argv[1])), Path(sys.argv[2]))
