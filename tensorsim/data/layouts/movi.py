"""MoVi: ``F_amass_Subject_N.mat`` with the motions of one subject, 52 joints at 120 frames per second.

Source: S. Ghorbani et al., "MoVi: A large multi-purpose human motion and video dataset", PLOS ONE 16(6), 2021. The
structure ``Subject_N_F_amass`` has ``move``, a list of structures with ``description`` and ``jointsLocation_amass``
(T, 52, 3) in metres, z up.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from tensorsim.data.npz import SMPL_JOINTS
from tensorsim.data.skeletons import Motion, motion_of
from tensorsim.errors import TensorsimError
from tensorsim.files import reading
from tensorsim.limits import check_range

FPS = 120.0


def _moves(path: Path) -> list[dict[str, Any]]:
    """The motions of a subject."""
    from scipy.io import loadmat

    with reading(path, "motions of MoVi"):
        check_range(path.stat().st_size, "size of a file", str(path))
        content = loadmat(path, simplify_cells=True)
        subjects = [value for name, value in content.items() if name.startswith("Subject_")]
        if len(subjects) != 1 or "move" not in subjects[0]:
            raise ValueError(
                f"the variables {', '.join(n for n in content if n[0] != '_')}, expected Subject_N_F_amass"
            )
        moves = subjects[0]["move"]
    return [moves] if isinstance(moves, dict) else [move for move in moves if isinstance(move, dict)]


def movi_descriptions(path: Path) -> list[str]:
    """What the subject does in each motion of a file.

    Raises:
        TensorsimError: not a MoVi file.
    """
    return [str(move.get("description", "")).strip() for move in _moves(path)]


def read_movi(path: Path, key: str) -> Motion:
    """Motion number ``key``, from 0 on.

    Raises:
        TensorsimError: not a MoVi file, or no such motion.
    """
    moves = _moves(path)
    if not (key.isdecimal() and int(key) < len(moves)):
        got = f"motion {key}" if key else "no key"
        raise TensorsimError(f"{path}: got {got}, expected the number of a motion, 0 to {len(moves) - 1}")
    number = int(key)
    with reading(path, "motions of MoVi"):
        positions = torch.from_numpy(np.asarray(moves[number]["jointsLocation_amass"], np.float64))
        if positions.dim() != 3 or positions.shape[1] < 22 or positions.shape[2] != 3:
            raise ValueError(f"joints of shape {list(positions.shape)}, expected (T, 52, 3)")
    return motion_of(path, positions[:, :22], SMPL_JOINTS, FPS)
