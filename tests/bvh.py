"""Joints as a BVH file: every bone hangs along the y axis of its parent and is turned into place."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tensorsim.config import JOINTS

#: Chains of joints (indices of ``JOINTS``) from the hips, and from the neck on.
CHAINS = {"Spine": (1,), "RightLeg": (8, 9, 10), "LeftLeg": (11, 12, 13)}
UPPER = {"Skull": (0,), "RightCollar": (2, 3, 4), "LeftCollar": (5, 6, 7)}


def write_bvh(path: Path, joints: np.ndarray, fps: float, unit: float = 100.0) -> None:
    """Joints (T, 14, 3) in world metres, with constant bones, as a y-up BVH in units of 1 / ``unit`` metres."""
    # Motion files that face the viewer (+z) face the radar (-y).
    points = np.stack([joints[..., 0], joints[..., 2], -joints[..., 1]], axis=-1) * unit
    hips = points[:, [8, 11]].mean(axis=1)
    lines = ["HIERARCHY", "ROOT Hips", "{", "OFFSET 0 0 0"]
    lines.append("CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation")
    columns = [hips, np.zeros_like(hips)]

    def name(joint: int) -> str:
        return "Nose" if joint == 0 else JOINTS[joint].title().replace("_", "")

    def chain(knot: str, start: np.ndarray, frame: Rotation, bones: tuple[int, ...]) -> None:
        """A joint without length that points to the first bone's end, then the bones."""
        titles = [knot, *(name(bone) for bone in bones)]
        offset = 0.0
        for index, title in enumerate(titles):
            lines.extend((f"JOINT {title}", "{", f"OFFSET 0 {offset:.5f} 0"))
            lines.append("CHANNELS 3 Zrotation Xrotation Yrotation")
            if index == len(bones):
                columns.append(np.zeros_like(hips))
                break
            end = points[:, bones[index]]
            turned = _towards(end - start)
            columns.append((frame.inv() * turned).as_euler("ZXY", degrees=True))
            offset, start, frame = np.linalg.norm(end - start, axis=1).mean(), end, turned
        if titles[-1] == "Neck":
            for upper, rest in UPPER.items():
                chain(upper, start, frame, rest)
        else:
            lines.extend(("End Site", "{", "OFFSET 0 0 0", "}"))
        lines.extend("}" for _ in titles)

    for knot, bones in CHAINS.items():
        chain(knot, hips, Rotation.identity(len(hips)), bones)
    lines += ["}", "MOTION", f"Frames: {len(points)}", f"Frame Time: {1 / fps:.8f}"]
    lines += [" ".join(f"{x:.5f}" for x in row) for row in np.concatenate(columns, axis=1)]
    path.write_text("\n".join(lines) + "\n")


def _towards(directions: np.ndarray) -> Rotation:
    """Shortest turns of the y axis to directions (T, 3)."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    axis = np.cross([0.0, 1.0, 0.0], unit)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine, unit[:, 1:2])
    return Rotation.from_rotvec(axis / np.maximum(sine, 1e-12) * angle)
