"""People cut out of photographs along their outlines, separated from the background by colour around their joints."""

import numpy as np
import numpy.typing as npt

from tensorsim.training.shards import POINTS, Floats, Sample

Picture = npt.NDArray[np.uint8]

#: Bones, and the thickness of the body around them relative to the length of the trunk.
BONES = (
    ("left_shoulder", "left_hip", 0.32), ("right_shoulder", "right_hip", 0.32), ("left_shoulder", "right_hip", 0.32),
    ("right_shoulder", "left_hip", 0.32), ("left_shoulder", "right_shoulder", 0.32), ("left_hip", "right_hip", 0.32),
    ("neck", "left_hip", 0.32), ("neck", "right_hip", 0.32), ("neck", "head_top", 0.32),
    ("left_hip", "left_knee", 0.2), ("left_knee", "left_ankle", 0.2), ("left_ankle", "left_ankle", 0.32),
    ("right_hip", "right_knee", 0.2), ("right_knee", "right_ankle", 0.2), ("right_ankle", "right_ankle", 0.32),
    ("left_shoulder", "left_elbow", 0.14), ("left_elbow", "left_wrist", 0.14),
    ("right_shoulder", "right_elbow", 0.14), ("right_elbow", "right_wrist", 0.14),
)  # fmt: skip
#: Factors on these thicknesses: surely body, probably body, and the limit of the body.
SURELY, LIKELY, AT_MOST = 0.35, 1.0, 2.6
#: The outline failed if less than the first share of the probable body is inside, or more than the second around it.
LEAST_INSIDE, MOST_AROUND = 0.7, 0.4


def outline(sample: Sample, person: int = 0, side: int = 160) -> Picture | None:
    """Cut a labelled person out.

    Args:
        sample: the picture.
        person: which of its people.
        side: longest side of the region looked at, pixels of the result.

    Returns:
        (h, w, 4) uint8 RGB and straight alpha, cropped to the person; None where joints are not labelled or body and
        background cannot be separated by colour.

    Reference:
        Rother et al., "GrabCut", 2004, started from the skeleton instead of a rectangle.
    """
    import cv2

    box, points = sample.boxes[person], sample.keypoints[person]
    if not all(points[POINTS.index(name), 2] > 0 for bone in BONES for name in bone[:2]):
        return None
    image = sample.image()
    margin = 0.12 * (box[2:] - box[:2]).max()
    left, top = np.floor(np.maximum(box[:2] - margin, 0)).astype(int)
    right, bottom = np.ceil(np.minimum(box[2:] + margin, image.shape[1::-1])).astype(int)
    scale = side / max(right - left, bottom - top)
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    region = cv2.resize(image[top:bottom, left:right], None, fx=scale, fy=scale, interpolation=how)
    joints = (points[:, :2] + 0.5 - np.array([left, top])) * scale - 0.5

    surely, likely, at_most = (
        _body(region.shape[:2], joints, thickness) for thickness in (SURELY, LIKELY, AT_MOST)
    )
    labels = np.full(region.shape[:2], cv2.GC_BGD, np.uint8)
    labels[at_most] = cv2.GC_PR_BGD
    labels[likely] = cv2.GC_PR_FGD
    labels[surely] = cv2.GC_FGD
    if at_most.all() or not surely.any():
        return None
    cv2.setRNGSeed(0)
    ground, body = np.zeros((1, 65)), np.zeros((1, 65))  # the colours of both, fitted there
    cv2.grabCut(region, labels, (0, 0, 0, 0), ground, body, 3, cv2.GC_INIT_WITH_MASK)
    inside = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    # Pieces without a bone are background of similar colour.
    pieces = cv2.connectedComponents(inside.astype(np.uint8))[1]
    inside &= np.isin(pieces, np.unique(pieces[surely]))
    if inside[likely].mean() < LEAST_INSIDE or inside[at_most & ~likely].mean() > MOST_AROUND:
        return None
    alpha = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), 0.8) * 255
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    rgba = np.dstack([region, alpha.round().astype(np.uint8)])
    return np.ascontiguousarray(rgba[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1])


def _body(shape: tuple[int, ...], joints: Floats, thickness: float) -> npt.NDArray[np.bool_]:
    """(h, w) mask of the bones thickened ``thickness`` times."""
    import cv2

    at = {name: joints[POINTS.index(name)] for bone in BONES for name in bone[:2]}
    trunk = float(np.linalg.norm(at["neck"] - (at["left_hip"] + at["right_hip"]) / 2))
    mask = np.zeros(shape, np.uint8)
    for first, second, thick in BONES:
        ends = [(round(float(x)), round(float(y))) for x, y in (at[first], at[second])]
        cv2.line(mask, ends[0], ends[1], 1, max(1, round(thick * thickness * trunk)))
    return mask > 0
