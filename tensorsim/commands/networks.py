"""What several commands ask for: the detector and the pose network, by path or name."""

import os
from pathlib import Path
from typing import Any

from tensorsim.errors import TensorsimError


def default_networks(detector: str | None, pose: str | None) -> tuple[Path, Path]:
    """Files of the detector and of the pose network.

    Each is the one given (a path, or a name of ``tensorsim models list``), else that of the environment variable
    ``TENSORSIM_DETECTOR`` or ``TENSORSIM_POSE``, else the shipped one.

    Raises:
        TensorsimError: none of these is there.
    """
    return _located("detector", detector, "RTMDet"), _located("pose", pose, "HRNet", "CPM")


def _located(role: str, source: str | None, *networks: str) -> Path:
    from tensorsim.registry import locate

    variable = f"TENSORSIM_{role.upper()}"
    try:
        path = locate(source or os.environ.get(variable) or None, *networks)
    except TensorsimError as error:
        raise TensorsimError(f"--{role}: {error} (here, or in ${variable})") from None
    if not path.is_file():
        raise TensorsimError(f"--{role}: {path} is not a file")
    return path


def load_networks(detector: Path, pose: Path, flip_test: bool) -> tuple[Any, Any]:
    """The two modules of these files: see :func:`tensorsim.pipeline.pretrained_pose` for the second.

    Raises:
        TensorsimError: files that are damaged, unsafe or of another network.
    """
    from tensorsim.pipeline import pretrained_pose
    from tensorsim.vision.rtmdet import RTMDet

    return RTMDet.from_pretrained(detector), pretrained_pose(pose, flip_test)
