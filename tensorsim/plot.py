"""Pictures of maps, skeletons and people. Needs matplotlib and OpenCV, imported on use."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Bones of the 14-joint radar body and of COCO-17, as pairs of indices.
# fmt: off
BODY_BONES = (
    (0, 1), (1, 2), (2, 3), (3, 4), (1, 5), (5, 6), (6, 7),
    (1, 8), (8, 9), (9, 10), (1, 11), (11, 12), (12, 13), (8, 11),
)
COCO_BONES = (
    (0, 1), (0, 2), (1, 3), (2, 4), (5, 6), (5, 7), (7, 9), (6, 8), (8, 10),
    (5, 11), (6, 12), (11, 12), (11, 13), (13, 15), (12, 14), (14, 16),
)
# fmt: on
#: One colour per person, RGB.
PERSON_COLOURS = ((255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189), (23, 190, 207))

#: Pictures show this much below the peak.
DYNAMIC_RANGE_DB = 50.0

_MAX_COLUMNS = 2000


def _figure(width: float = 9.0, height: float = 5.0) -> Figure:
    # A Figure of its own instead of pyplot: no global state, no window system.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def decibels(magnitude: np.ndarray, dynamic_range_db: float) -> np.ndarray:
    """Magnitude in dB below its peak, clipped to ``-dynamic_range_db``; an all-zero map is at the floor."""
    peak = float(magnitude.max(initial=0.0))
    if peak <= 0:
        return np.full_like(magnitude, -dynamic_range_db)
    return np.maximum(20 * np.log10(np.maximum(magnitude / peak, 1e-12)), -dynamic_range_db)


def _thin_columns(magnitude: np.ndarray) -> np.ndarray:
    """Reduce the time axis to about 2000 columns by power averages: more than a picture can show only aliases."""
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
    dynamic_range_db: float = DYNAMIC_RANGE_DB,
    reference: np.ndarray | None = None,
    reference_ridges: np.ndarray | None = None,
) -> Figure:
    """Draw a map (rows, columns) in dB below its peak, and beside it the one that the true motion has.

    Args:
        magnitude: (R or F, K) linear magnitude.
        time_s: (K,) centre of each column in seconds.
        axis: (R or F,) centre of each row in the units of ``axis_label``.
        ridges: (C, K) lines to draw over it in units of ``axis``; NaN is not drawn.
        speed_per_axis: m/s per unit of ``axis``, for a second scale on the right.
        half_span: show rows from ``-half_span`` to ``half_span`` only.
        dynamic_range_db: what lies further below the peak has the colour of the floor.
        reference: the map of the true motion, of the same axes.
        reference_ridges: its ridges.
    """
    panels = [(magnitude, ridges, title)]
    if reference is not None:
        panels = [
            (magnitude, ridges, f"{title}, from the film"),
            (reference, reference_ridges, f"{title}, from the true motion"),
        ]
    figure = _figure(width=9.0 if reference is None else 15.0)
    row = np.atleast_1d(figure.subplots(1, len(panels), sharey=True))
    step = float(axis[1] - axis[0])
    span_s = float(time_s[1] - time_s[0]) if len(time_s) > 1 else 1.0
    low, high = float(axis[0]) - step / 2, float(axis[-1]) + step / 2
    extent = (float(time_s[0]) - span_s / 2, float(time_s[-1]) + span_s / 2, low, high)
    if half_span is not None:
        low, high = max(low, -half_span), min(high, half_span)
    for axes, (levels, lines, heading) in zip(row, panels, strict=True):
        image = axes.imshow(
            decibels(_thin_columns(levels), dynamic_range_db),
            origin="lower",
            aspect="auto",
            interpolation="nearest",
            cmap="turbo",
            vmin=-dynamic_range_db,
            vmax=0.0,
            extent=extent,
        )
        if lines is not None:
            _draw_ridges(axes, time_s, lines)
        axes.set_ylim(low, high)
        axes.set_title(heading)
        axes.set_xlabel("time in s")
    row[0].set_ylabel(axis_label)
    if speed_per_axis is not None:
        scale = speed_per_axis
        right = row[-1].secondary_yaxis(
            "right",
            functions=(lambda x: np.multiply(x, scale), lambda v: np.divide(v, scale)),
        )
        right.set_ylabel("radial speed in m/s, positive = approaching")
    pad = (0.02 if speed_per_axis is None else 0.1) / len(panels)
    figure.colorbar(image, ax=list(row), label="dB below the peak", pad=pad)
    return figure


def _draw_ridges(axes: Any, time_s: np.ndarray, ridges: np.ndarray) -> None:
    for i, ridge in enumerate(ridges):
        axes.plot(
            time_s, ridge, ".", color="white", alpha=0.8 - 0.2 * i, markersize=2.0, label=f"ridge {i + 1}"
        )
    axes.legend(loc="upper right", fontsize="small", markerscale=3, labelcolor="white", framealpha=0.3)


def skeleton_figure(joints_m: np.ndarray, valid: np.ndarray, fps: float, poses: int = 6) -> Figure:
    """Draw joints (P, T, 14, 3) in the world at a few moments spread over each person's time in the scene."""
    figure = _figure(9.0, 7.0)
    axes: Any = figure.add_subplot(projection="3d")
    shown: list[np.ndarray] = []
    for person in range(joints_m.shape[0]):
        frames = np.flatnonzero(valid[person])
        if frames.size == 0:
            continue
        colour = np.array(PERSON_COLOURS[person % len(PERSON_COLOURS)]) / 255
        chosen = np.unique(frames[np.linspace(0, frames.size - 1, poses).astype(int)])
        for k, frame in enumerate(chosen):
            body = joints_m[person, frame]
            shown.append(body)
            shade = 0.35 + 0.65 * (k + 1) / chosen.size
            for a, b in BODY_BONES:
                axes.plot(*zip(body[a], body[b], strict=True), color=colour, alpha=shade, linewidth=1.8)
            axes.text(*(body[0] + (0, 0, 0.15)), f"{frame / fps:.1f} s", color=colour, fontsize=7)
        track = joints_m[person, frames][:, (8, 11)].mean(axis=1)
        axes.plot(
            track[:, 0],
            track[:, 1],
            0 * track[:, 2],
            color=colour,
            linestyle=":",
            label=f"person {person + 1}",
        )
    axes.scatter([0], [0], [1.5], color="black", marker="^", s=50, label="radar")
    points = np.concatenate([*shown, np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 1.8]])])
    low, high = points.min(axis=0), points.max(axis=0)
    high[1:] = np.maximum(high[1:], (1.0, 2.0))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(0, high[2]))
    axes.set_box_aspect((high[0] - low[0], high[1] - low[1], high[2]))
    axes.set(
        xlabel="x in m", ylabel="y (range) in m", zlabel="z in m", title="skeletons in the world of the radar"
    )
    axes.view_init(elev=20, azim=-60)
    axes.legend(loc="upper left")
    return figure


def confusion_figure(counts: np.ndarray, names: list[str], title: str) -> Figure:
    """Confusion matrix (classes, classes), true class in rows, shaded by the share of the true class."""
    figure = _figure(6.0, 5.6)
    axes = figure.add_subplot()
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for (row, column), count in np.ndenumerate(counts):
        if count:
            colour = "white" if share[row, column] > 0.5 else "black"
            axes.text(column, row, str(count), ha="center", va="center", color=colour, fontsize=8)
    axes.set_xticks(range(len(names)), names)
    axes.set_yticks(range(len(names)), names)
    axes.set_xlabel("predicted")
    axes.set_ylabel("true")
    axes.set_title(title)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a PNG."""
    figure.savefig(path, dpi=120)


def draw_people(
    image: np.ndarray,
    boxes: np.ndarray,
    keypoints: np.ndarray,
    scores: np.ndarray,
    valid: np.ndarray,
    threshold: float,
) -> np.ndarray:
    """Draw boxes, ids and COCO skeletons of one frame.

    Args:
        image: (H, W, 3) uint8 RGB; not changed.
        boxes: (P, 4) ``xyxy`` pixels.
        keypoints: (P, 17, 2) pixels.
        scores: (P, 17); a bone is drawn when both ends reach ``threshold``.
        valid: (P,) bool.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    import cv2

    image = np.ascontiguousarray(image).copy()
    stroke = max(1, round(min(image.shape[:2]) / 240))
    for person in np.flatnonzero(valid):
        colour = PERSON_COLOURS[person % len(PERSON_COLOURS)]
        x1, y1, x2, y2 = (round(float(v)) for v in boxes[person])
        cv2.rectangle(image, (x1, y1), (x2, y2), colour, stroke)
        cv2.putText(
            image,
            f"{person + 1}",
            (x1, max(y1 - 4, 12)),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.35 * stroke + 0.2,
            colour,
            stroke,
        )
        points = [(round(float(u)), round(float(v))) for u, v in keypoints[person]]
        for a, b in COCO_BONES:
            if scores[person, a] >= threshold and scores[person, b] >= threshold:
                cv2.line(image, points[a], points[b], (255, 255, 255), stroke + 1, cv2.LINE_AA)
                cv2.line(image, points[a], points[b], colour, stroke, cv2.LINE_AA)
        for joint, point in enumerate(points):
            if scores[person, joint] >= threshold:
                cv2.circle(image, point, stroke + 1, (255, 255, 0), -1, cv2.LINE_AA)
    return image
