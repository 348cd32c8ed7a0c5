"""Tables and pictures of the truth loop: CSV, Markdown, PNG."""

import csv
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from tensorsim.config import ACTIVITIES
from tensorsim.evaluation.scores import FIGURES, MAPS
from tensorsim.evaluation.settings import SOURCES
from tensorsim.files import complete_file

#: Headings of the figures in the tables.
HEADINGS = {
    "psnr": "PSNR dB",
    "psnr_db": "PSNR of dB maps",
    "ssim": "SSIM",
    "ssim_db": "SSIM of dB maps",
    "nmse": "NMSE",
    "envelope_m_s": "envelope RMSE m/s",
}
#: Errors of joints in a cell, with their names in the tables.
POSE = {
    "followed": "frames followed, share",
    "root": "hips, rms m",
    "joints": "joints about the hips, mean m",
    "range": "of these along y, rms m",
}
#: The row without people: there, PSNR is infinite where the maps are exactly right and arbitrary otherwise.
EMPTY = ACTIVITIES[0]
Cells = list[dict[str, Any]]


def mean(values: Iterable[float]) -> float:
    """Mean of the finite values; NaN if there are none, infinite if all are."""
    listed = [v for v in values if not math.isnan(v)]
    finite = [v for v in listed if math.isfinite(v)]
    if finite:
        return sum(finite) / len(finite)
    return math.inf if listed else math.nan


def figure_of(cells: Cells, scene: str, name: str, figure: str) -> float:
    """Mean over the clips of the cells; NaN if there are none."""
    return mean(c["scores"].get(scene, {}).get(name, {}).get(figure, math.nan) for c in cells)


def write_csv(path: Path, cells: Cells) -> None:
    """One line per clip, setting, scene and map; joint errors are the same for all scenes and maps of a clip."""
    with complete_file(path) as scratch, scratch.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        errors = ("people", *POSE)
        writer.writerow(["row", "clip", "setting", "scene", "map", *FIGURES, *errors])
        for cell in cells:
            posed = [cell["pose"].get(error, math.nan) for error in errors]
            for scene, maps in cell["scores"].items():
                for name, figures in maps.items():
                    values = [figures.get(f, math.nan) for f in FIGURES]
                    place = [cell["row"], cell["clip"], cell["setting"], scene, name]
                    writer.writerow([*place, *values, *posed])


def _text(value: float, figure: str) -> str:
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return "equal" if figure.startswith("psnr") else "inf"
    return f"{value:.1f}" if figure.startswith("psnr") else f"{value:.2f}"


def _table(heads: list[str], lines: list[list[str]]) -> list[str]:
    rule = ["---", *["---:"] * (len(heads) - 1)]
    return ["| " + " | ".join(line) + " |" for line in [heads, rule, *lines]] + [""]


def markdown(cells: Cells) -> str:
    """Tables for whole pipelines, pipelines with one true stage, joint errors, and falsely detected people."""
    rows = list(dict.fromkeys(c["row"] for c in cells))
    names = list(dict.fromkeys(c["setting"] for c in cells))
    scenes = list(dict.fromkeys(scene for c in cells for scene in c["scores"]))
    # Whole pipelines, then guesses.
    whole = sorted((n for n in names if "+" not in n), key=lambda n: n.split("-")[0] not in SOURCES)

    def chosen(setting: str, row: str | None = None) -> Cells:
        return [c for c in cells if c["setting"] == setting and (row is None or c["row"] == row)]

    def overall(setting: str, scene: str, name: str, figure: str) -> float:
        """Mean of the means of all rows with people, so that these rows have equal weight."""
        return mean(figure_of(chosen(setting, row), scene, name, figure) for row in rows if row != EMPTY)

    text = ["# Truth loop", ""]
    text += ["Settings: " + "; ".join(f"**{k}** {v}" for k, v in SOURCES.items()) + ".", ""]
    text += [
        "Each map is scaled by its own peak and compared with that of the true motion at every pulse, without noise, "
        f"shift or fit. {EMPTY} is not part of means, for any setting; people who are found in it are counted. Nor is "
        "the infinite PSNR of a map that is exactly right.",
        "",
        *_left_out(cells, names, scenes),
    ]
    for scene in scenes:
        for name, short in MAPS.items():
            text += [f"## {short}, {scene}", ""]
            for figure in ("psnr", "ssim"):
                lines = [
                    [row, *(_text(figure_of(chosen(n, row), scene, name, figure), figure) for n in whole)]
                    for row in rows
                ]
                means = [_text(overall(n, scene, name, figure), figure) for n in whole]
                lines.append(["**mean**", *means])
                text += _table([HEADINGS[figure], *whole], lines)
            others = [
                f
                for f in FIGURES
                if f not in ("psnr", "ssim") and (f in FIGURES[:5] or name == "doppler_time")
            ]
            text += _table(
                ["mean of rows", *whole],
                [[HEADINGS[f], *(_text(overall(n, scene, name, f), f) for n in whole)] for f in others],
            )
    replaced = [n for n in names if "+" in n]
    if replaced:
        base = replaced[0].split("+")[0]
        text += [f"## {base} with one stage replaced by the truth: PSNR in dB, mean of rows", ""]
        heads = ["stage that is true", *(f"{short}, {scene}" for scene in scenes for short in MAPS.values())]
        lines = [
            [label, *(_text(overall(n, scene, name, "psnr"), "psnr") for scene in scenes for name in MAPS)]
            for label, n in [("none", base), *((n.split("+")[1], n) for n in replaced)]
        ]
        text += _table(heads, lines)
    posed = [n for n in names if any(c["pose"].get("root") is not None for c in chosen(n))]
    if posed:
        text += [
            "## Errors of the joints at the frame rate, in the frames in which somebody is followed, mean of rows",
            "",
            *_pose_table(cells, rows, posed),
        ]
    ghosts = {n: mean(c["pose"].get("people", math.nan) for c in chosen(n, EMPTY)) for n in names}
    if EMPTY in rows:
        found = {n: f"{people:.2f}" for n, people in ghosts.items() if not math.isnan(people)}
        text += [
            f"## People found per clip of {EMPTY}",
            "",
            *_table(["", *found], [["people", *found.values()]]),
        ]
    return "\n".join(text)


def _left_out(cells: Cells, names: list[str], scenes: list[str]) -> list[str]:
    """How many clips each setting lacks: means over different sets of clips are not comparable."""
    counts = {
        (name, scene): [scene not in cell["scores"] for cell in cells if cell["setting"] == name]
        for name in names
        for scene in scenes
    }
    lacking = [
        f"{name}, {scene}: {sum(missing)} of {len(missing)}"
        for (name, scene), missing in counts.items()
        if any(missing)
    ]
    return (
        [f"Clips left out, whose motion the radar cannot follow: {'; '.join(lacking)}.", ""]
        if lacking
        else []
    )


def _pose_table(cells: Cells, rows: list[str], settings: list[str]) -> list[str]:
    def pose_mean(setting: str, key: str) -> float:
        return mean(
            mean(c["pose"].get(key, math.nan) for c in cells if c["setting"] == setting and c["row"] == row)
            for row in rows
        )

    lines = [[label, *(f"{pose_mean(n, key):.3f}" for n in settings)] for key, label in POSE.items()]
    return _table(["error", *settings], lines)


def save_pictures(
    path: Path, pictures: dict[str, list[tuple[str, Any]]], speed_m_s: Any, range_db: float = 40.0
) -> None:
    """DTMs side by side, a row of pictures per row of the table."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from tensorsim.plot import decibels, save_figure

    columns = max(len(shown) for shown in pictures.values())
    figure = Figure(figsize=(3.2 * columns, 1.9 * len(pictures)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(pictures), columns, squeeze=False, sharey=True)
    speed = np.asarray(speed_m_s)
    for line, (row, shown) in zip(grid, pictures.items(), strict=True):
        for axes, (name, magnitude) in zip(line, shown, strict=False):
            axes.imshow(
                decibels(np.asarray(magnitude), range_db), origin="lower", aspect="auto", cmap="turbo",
                vmin=-range_db, vmax=0, extent=(0, magnitude.shape[1], speed[0], speed[-1]),
            )  # fmt: skip
            axes.set_ylim(max(speed[0], -5), min(speed[-1], 5))
            axes.set_xticks([])
            axes.set_title(f"{row}: {name}", fontsize=7, parse_math=False)
    figure.supylabel("radial speed in m/s, positive = approaching", fontsize=8)
    save_figure(figure, path)
