"""NTU RGB+D: ``.skeleton`` files of Kinect v2, 25 joints of up to two people at 30 frames per second.

Source: A. Shahroudy et al., "NTU RGB+D: A Large Scale Dataset for 3D Human Activity Analysis", CVPR 2016. A file name
such as S001C001P001R001A001 gives setup, camera, performer, replication and action.
"""

import re
from pathlib import Path
from typing import NamedTuple

import torch

from tensorsim.data.skeletons import Motion, motion_of
from tensorsim.errors import TensorsimError
from tensorsim.files import reading
from tensorsim.limits import check_range

#: Joints of Kinect v2 in the order of the files.
KINECT_JOINTS = (
    "SpineBase", "SpineMid", "Neck", "Head", "ShoulderLeft", "ElbowLeft", "WristLeft", "HandLeft", "ShoulderRight",
    "ElbowRight", "WristRight", "HandRight", "HipLeft", "KneeLeft", "AnkleLeft", "FootLeft", "HipRight", "KneeRight",
    "AnkleRight", "FootRight", "SpineShoulder", "HandTipLeft", "ThumbLeft", "HandTipRight", "ThumbRight",
)  # fmt: skip
FPS = 30.0
_NAME = re.compile(r"S(\d{3})C(\d{3})P(\d{3})R(\d{3})A(\d{3})", re.IGNORECASE)


class NtuName(NamedTuple):
    """The information in a file name.

    Attributes:
        setup, camera, performer, replication, action: numbers from 1 on.
    """

    setup: int
    camera: int
    performer: int
    replication: int
    action: int


def ntu_name(path: Path) -> NtuName:
    """The numbers in the name of a file.

    Raises:
        TensorsimError: a name of another form.
    """
    found = _NAME.match(path.stem)
    if found is None:
        raise TensorsimError(
            f"{path}: got an unknown kind of name, expected one such as S001C001P001R001A001"
        )
    return NtuName(*(int(number) for number in found.groups()))


def read_ntu(path: Path) -> Motion:
    """The people in a ``.skeleton`` file in metres; x right, y away from the camera, z up.

    Raises:
        TensorsimError: a file that is damaged or truncated, has no people, or does not have 25 joints.
    """
    with reading(path, "NTU RGB+D skeletons"):
        check_range(path.stat().st_size, "size of a file", str(path))
        numbers = iter(path.read_text(encoding="ascii").split())
        frames = int(next(numbers, "0"))
        people: dict[str, dict[int, list[list[float]]]] = {}
        for frame in range(frames):
            for _ in range(int(next(numbers))):
                body = next(numbers)
                for _ in range(9):  # hands, lean, tracking state
                    float(next(numbers))
                count = int(next(numbers))
                if count != len(KINECT_JOINTS):
                    raise ValueError(f"{count} joints in frame {frame}, expected {len(KINECT_JOINTS)}")
                rows = [[float(next(numbers)) for _ in range(12)] for _ in range(count)]
                people.setdefault(body, {})[frame] = [row[:3] for row in rows]
        if not people:
            raise ValueError("no people in its frames")
    positions = torch.zeros(len(people), frames, len(KINECT_JOINTS), 3, dtype=torch.float64)
    valid = torch.zeros(len(people), frames, dtype=torch.bool)
    for person, seen in enumerate(people.values()):
        for frame, rows in seen.items():
            positions[person, frame] = torch.tensor(rows, dtype=torch.float64)
            valid[person, frame] = True
    # The sensor's axes: x to its left, y up, z away from it.
    x, y, z = positions.unbind(-1)
    return motion_of(path, torch.stack([-x, z, y], dim=-1), KINECT_JOINTS, FPS, valid)
