"""The page of a report: its content as JSON, and the script that shows it."""

import base64
import json
from collections.abc import Sequence
from dataclasses import asdict
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tensorsim import plot
from tensorsim.files import write_text
from tensorsim.report.film import FilmStrip
from tensorsim.types import Pose, RadarMaps

if TYPE_CHECKING:
    from tensorsim.results import Axes, Pictures

#: Maps are stored down to this many dB below the peak, or to the dynamic range if larger; the page can show less.
STORED_DB = 80.0
_MOST_COLUMNS, _MOST_ROWS = 1200, 400
_COLOURMAPS = ("turbo", "viridis", "jet", "parula", "gray")
_FILES = ("style.css", "maps.js", "scene.js", "player.js")


def write_report(
    folder: Path,
    summary: dict[str, Any],
    pose: Pose,
    fps: float,
    maps: RadarMaps,
    axes: "Axes",
    film: FilmStrip,
    pictures: "Pictures",
    truth: RadarMaps | None = None,
    further: Sequence[dict[str, Any]] = (),
) -> None:
    """Write ``report.html``, which needs no other file and no network (a long film is beside it).

    Args:
        folder: output folder.
        summary: content of ``summary.json``.
        pose: pose of one clip (B = 1), on the CPU.
        fps: frames per second of the pose.
        maps: maps on the CPU, without batch dimensions.
        axes: axes of the maps.
        film: film with all frames added.
        pictures: how the maps are drawn.
        truth: maps of the true motion, shown below those of the film.
        further: maps as returned by :func:`map_contents`, shown below all others.
    """
    frames = pose.valid.shape[2]
    content = {
        "title": pictures.subtitle or "tensorsim",
        "fps": fps,
        "frames": frames,
        "duration_s": frames / fps,
        "film": film.content(),
        "people": people_content(pose),
        "scene": scene_content(summary),
        "maps": map_contents(maps, axes, pictures)
        + ([] if truth is None else map_contents(truth, axes, pictures, " of the true motion"))
        + list(further),
        "style": asdict(pictures.style),
        "ridge_colours": list(plot.RIDGE_COLOURS),
        "colourmaps": {name: colour_table(name) for name in _COLOURMAPS},
        "timeline": timeline_content(summary.get("timeline") or [], frames / fps),
        "summary": {key: value for key, value in summary.items() if key not in ("files", "run")},
    }
    write_text(folder / "report.html", page(content))


def page(content: dict[str, Any]) -> str:
    """The page with its content; ``</script>`` in a name cannot end the JSON."""
    files = resources.files("tensorsim.report")
    text = files.joinpath("page.html").read_text(encoding="utf-8")
    for name in _FILES:
        text = text.replace(f"/*{name}*/", files.joinpath(name).read_text(encoding="utf-8"))
    data = json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return text.replace("/*content*/", data)


def packed(values: np.ndarray) -> str:
    """The bytes of an array, little-endian, in base64."""
    return base64.b64encode(
        np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<")).tobytes()
    ).decode()


def people_content(pose: Pose) -> dict[str, Any]:
    """Joints (P, T, 14, 3) in whole centimetres as int16, and presence as bytes."""
    valid = pose.valid[0].numpy()
    shown = np.flatnonzero(valid.any(1))
    joints = np.clip(pose.joints[0].numpy()[shown] * 100, -32768, 32767)
    return {
        "count": len(shown),
        "numbers": [int(person) + 1 for person in shown],
        "joints_cm": packed(joints.round().astype(np.int16)),
        "valid": packed(valid[shown].astype(np.uint8)),
        "bones": [list(bone) for bone in plot.BODY_BONES],
        "colours": [list(plot.PERSON_COLOURS[person % len(plot.PERSON_COLOURS)]) for person in shown],
    }


def scene_content(summary: dict[str, Any]) -> dict[str, Any]:
    """Positions of the radar and the wall."""
    radar, wall = summary["radar"], summary.get("wall")
    antennas = [np.atleast_2d(radar[name])[0].tolist() for name in ("tx_m", "rx_m")]
    place = {} if wall is None else {"wall": {key: wall[key] for key in ("center_m", "size_m")}}
    return {"antennas_m": antennas, **place}


def timeline_content(windows: list[dict[str, Any]], duration_s: float) -> list[dict[str, Any]]:
    """Overlapping windows as intervals that do not overlap: at any time, the window with the nearest centre."""
    middles = [(window["start_s"] + window["end_s"]) / 2 for window in windows]
    borders = [0.0, *((a + b) / 2 for a, b in pairwise(middles)), duration_s]
    return [
        {"start_s": start, "end_s": end, "label": window["label"], "probability": window["probability"]}
        for window, start, end in zip(windows, borders, borders[1:], strict=False)
    ]


def colour_table(name: Any) -> str:
    """The 256 colours of a colour map as RGB bytes."""
    return packed((plot.colormap(name)(np.linspace(0, 1, 256))[:, :3] * 255).round().astype(np.uint8))


def map_contents(maps: RadarMaps, axes: "Axes", pictures: "Pictures", of: str = "") -> list[dict[str, Any]]:
    """The Doppler-time map with its ridges, and both range-time maps."""
    from tensorsim.results import strong_ridges

    magnitude, range_db = maps.doppler_time.numpy(), pictures.style.dynamic_range_db
    span = plot.doppler_span(magnitude, axes.doppler_hz, range_db)
    rows = np.abs(axes.doppler_hz) <= span
    ridges = plot.drawn_ridges(
        strong_ridges(maps, axes),
        axes.doppler_hz,
        magnitude,
        axes.doppler_hz[rows].size * float(np.diff(axes.doppler_hz).mean()),
        range_db,
        pictures.peak("doppler_time"),
    )
    step_s = float(np.diff(axes.time_s).mean()) if len(axes.time_s) > 1 else 0.1
    doppler = {
        **_content("doppler_time", maps, axes.doppler_hz, rows, pictures),
        "title": f"Doppler-time map{of}",
        "axis": axes.doppler_label,
        "start_s": float(axes.time_s[0]) - step_s / 2,
        "end_s": float(axes.time_s[-1]) + step_s / 2,
        "second_axis": {"label": "m/s", "per_unit": axes.speed_per_hz},
        "ridges": [[round(float(hz), 1) if abs(hz) <= span else None for hz in ridge] for ridge in ridges],
    }
    contents = [doppler]
    for name, title in (
        ("range_time_mti", f"Range-time map{of}, moving targets"),
        ("range_time", f"Range-time map{of}"),
    ):
        columns = getattr(maps, name).shape[1]
        late_s = (maps.range_time.shape[1] - columns) / 2 / axes.range_time_rate_hz
        contents.append(
            {
                **_content(name, maps, axes.range_m, np.ones(len(axes.range_m), bool), pictures),
                "title": title,
                "axis": "range in m",
                "start_s": late_s,
                "end_s": late_s + columns / axes.range_time_rate_hz,
                "second_axis": None,
                "ridges": [],
            }
        )
    return contents


def _content(
    name: str, maps: RadarMaps, axis: np.ndarray, rows: np.ndarray, pictures: "Pictures"
) -> dict[str, Any]:
    """A map as a grey PNG, top row first: 255 is the peak, 0 the lowest stored level."""
    import cv2

    magnitude = getattr(maps, name).numpy()[rows]
    peak = pictures.peak(name)
    peak = float(magnitude.max(initial=0.0)) if peak is None else peak
    stored_db = max(STORED_DB, pictures.style.dynamic_range_db)
    level = plot.decibels(_fewer(_fewer(magnitude, _MOST_COLUMNS).T, _MOST_ROWS).T, stored_db, peak)
    grey = ((np.minimum(level, 0.0) / stored_db + 1) * 255).round().astype(np.uint8)
    data = bytes(cv2.imencode(".png", grey[::-1])[1])
    step = float(axis[1] - axis[0])
    return {
        "name": name,
        "png": base64.b64encode(data).decode(),
        "stored_db": stored_db,
        "low": float(axis[rows][0]) - step / 2,
        "high": float(axis[rows][-1]) + step / 2,
        "reference": "the peak" if pictures.peaks is None else "the echo of a person",
    }


def _fewer(magnitude: np.ndarray, most: int) -> np.ndarray:
    """At most ``most`` columns, by root mean squares of neighbours."""
    columns = magnitude.shape[1]
    if columns <= most:
        return magnitude
    edges = np.linspace(0, columns, most + 1).astype(int)
    power = np.add.reduceat(np.square(magnitude, dtype=np.float64), edges[:-1], axis=1)
    return np.sqrt(power / np.diff(edges)).astype(magnitude.dtype)
