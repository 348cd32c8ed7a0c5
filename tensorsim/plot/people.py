"""Pictures of people: skeletons in radar coordinates, and boxes and keypoints in a frame."""

from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np

from tensorsim.config import Vector
from tensorsim.config.names import LIMBS
from tensorsim.plot.figure import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Lines of the drawn 14-joint radar body and of COCO-17, as pairs of indices.
BODY_BONES = ((0, 1), (1, 2), (1, 5), (1, 8), (1, 11), (8, 11), *LIMBS)
# fmt: off
COCO_BONES = (
    (0, 1), (0, 2), (1, 3), (2, 4), (5, 6), (5, 7), (7, 9), (6, 8), (8, 10),
    (5, 11), (6, 12), (11, 12), (11, 13), (13, 15), (12, 14), (14, 16),
)
# fmt: on
#: Indices of the hips among the 14 joints.
_HIPS = [8, 11]
#: One colour per person, RGB.
PERSON_COLOURS = ((255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189), (23, 190, 207))

#: Nothing is drawn further outside a picture; OpenCV takes 32-bit coordinates.
_FAR_PX = 10_000
#: A joint further than this from the middle of its hips has been misplaced.
_LIMB_REACH_M = 1.5


def skeleton_figure(
    joints_m: np.ndarray,
    valid: np.ndarray,
    fps: float,
    poses: int = 6,
    *,
    subtitle: str | None = None,
    radar_m: Vector = (0.0, 0.0, 1.5),
) -> Figure:
    """Draw people in the coordinates of the radar at a few moments spread over each person's time in the scene.

    All joints are drawn. The axes include every joint within reach of its body; text below the picture says how many
    are further away, and how far the lowest joint is below the floor.

    Args:
        joints_m: (P, T, 14, 3) world metres.
        valid: (P, T) bool, whether the person is in the scene.
        fps: frames per second.
        poses: number of moments to draw per person.
        subtitle: a line below the title, see :func:`caption`.
        radar_m: the middle of the antennas, ``RadarConfig.middle_m``.
    """
    from matplotlib.ticker import MultipleLocator

    figure = new_figure(9.0, 7.0)
    axes: Any = figure.add_subplot(projection="3d")
    shown: list[np.ndarray] = []
    for person in range(joints_m.shape[0]):
        frames = np.flatnonzero(valid[person])
        if frames.size == 0:
            continue
        chosen = np.unique(frames[np.linspace(0, frames.size - 1, poses).astype(int)])
        shown.append(joints_m[person, chosen])
        _draw_person(axes, person, joints_m[person], frames, chosen, fps)
    axes.scatter(*([value] for value in radar_m), color="black", marker="^", s=50, label="radar")
    bodies = np.concatenate([*shown, np.zeros((0, 14, 3))])
    hips = bodies[:, _HIPS].mean(axis=1, keepdims=True)
    attached = np.linalg.norm(bodies - hips, axis=-1) <= _LIMB_REACH_M
    points = np.concatenate([bodies[attached], [[-0.75, 0.0, 0.0], [0.75, 1.0, 2.0], radar_m]])
    low, high = points.min(axis=0), points.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low)
    # All axes have the same scale: the longest determines how far apart labels have to be.
    longest = (high - low).max()
    steps = (step * 10**power for power in count() for step in (0.5, 1.0, 2.0))
    least = next(step for step in steps if step >= longest / 16)
    for scale, label, spacing in (
        (axes.xaxis, "x", 0.5 if high[0] - low[0] < 4.0 else 1.0),
        (axes.yaxis, "y (range)", 1.0),
        (axes.zaxis, "z", 0.5),
    ):
        scale.set_major_locator(MultipleLocator(max(spacing, least)))
        scale.set_tick_params(labelsize="small")
        scale.set_label_text(f"{label} in m")
    # The shorter the other axis, the further an axis name is moved away; the labels of y are on a slope.
    axes.xaxis.labelpad = 5.0 * longest / (high[1] - low[1])
    axes.yaxis.labelpad = max(12.0, 5.0 * longest / (high[0] - low[0]))
    axes.set_title("skeletons in radar coordinates")
    axes.view_init(elev=20, azim=-60)
    axes.legend(loc="upper left")
    remarks = [] if subtitle is None else [subtitle]
    if not attached.all():
        remarks.append(
            f"{(~attached).sum()} of {attached.size} joints lie more than {_LIMB_REACH_M} m from their hips"
        )
    if low[2] < -0.02:
        remarks.append(f"the lowest joint is {-low[2]:.2f} m below the floor")
    if remarks:
        figure.supxlabel("\n".join(remarks), fontsize="small", color="dimgray", parse_math=False)
    return figure


def _draw_person(
    axes: Any, person: int, joints: np.ndarray, frames: np.ndarray, chosen: np.ndarray, fps: float
) -> None:
    """Draw poses of ``chosen`` frames, later ones stronger, and the path of the hips on the floor in all ``frames``."""
    from matplotlib.patheffects import withStroke

    colour = np.array(PERSON_COLOURS[person % len(PERSON_COLOURS)]) / 255
    labelled = np.full((1, 3), np.inf)
    for k, frame in enumerate(chosen):
        shade = 0.35 + 0.65 * (k + 1) / chosen.size
        # One line that NaN interrupts after each bone: many lines take long to draw.
        bones = np.pad(joints[frame][np.array(BODY_BONES)], ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
        axes.plot(*bones.reshape(-1, 3).T, color=colour, alpha=shade, linewidth=1.8)
        top = joints[frame, 0] + (0, 0, 0.15)
        # A pose close to a labelled one gets no time: for a person who stays in place, the legend has the time span.
        if (np.linalg.norm(labelled - top, axis=1) > 0.4).all():
            outline = [withStroke(linewidth=2.0, foreground="white")]
            axes.text(*top, f"{frame / fps:.1f} s", color=colour, fontsize=7, zorder=10, path_effects=outline)
            labelled = np.concatenate([labelled, top[None]])
    track = joints[frames][:, _HIPS].mean(axis=1)
    label = f"person {person + 1}, {frames[0] / fps:.1f} to {frames[-1] / fps:.1f} s"
    axes.plot(track[:, 0], track[:, 1], 0 * track[:, 2], color=colour, linestyle=":", label=label)


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
        x1, y1, x2, y2 = boxes[person].clip(-_FAR_PX, _FAR_PX).round().astype(int).tolist()
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
        points = keypoints[person].clip(-_FAR_PX, _FAR_PX).round().astype(int).tolist()
        for a, b in COCO_BONES:
            if scores[person, a] >= threshold and scores[person, b] >= threshold:
                cv2.line(image, points[a], points[b], (255, 255, 255), stroke + 1, cv2.LINE_AA)
                cv2.line(image, points[a], points[b], colour, stroke, cv2.LINE_AA)
        for joint, point in enumerate(points):
            if scores[person, joint] >= threshold:
                cv2.circle(image, point, stroke + 1, (255, 255, 0), -1, cv2.LINE_AA)
    return image
