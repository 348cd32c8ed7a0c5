"""Small whole files, their readers, and changes to their bytes."""

import functools
import io
import json
import random
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tensorsim.data import VideoReader, load_keypoints, load_motion, write_video
from tensorsim.weights import load_state_dict
from tests.bvh import write_bvh


def _read_film(path: Path) -> None:
    for _ in VideoReader(path).chunks(4):
        pass


#: The reader of each file.
READERS: dict[str, Callable[[Path], Any]] = {
    "own.npz": load_motion,
    "data_3d_h36m.npz": load_motion,
    "walk.bvh": load_motion,
    "coco.json": load_keypoints,
    "weights.pth": load_state_dict,
    "legacy.pth": load_state_dict,
    "weights.safetensors": load_state_dict,
    "film.mp4": _read_film,
}


@functools.cache
def originals() -> dict[str, bytes]:
    """The whole files."""
    from safetensors.torch import save

    def saved(write: Callable[[io.BytesIO], Any]) -> bytes:
        file = io.BytesIO()
        write(file)
        return file.getvalue()

    values = np.random.default_rng(0)
    joints = values.random((3, 14, 3))
    clip = {"S1": {"Walking": values.random((3, 32, 3)).astype("f4")}}
    people = [
        {"image_id": i, "track_id": 1, "keypoints": values.random(51).round(2).tolist()} for i in range(3)
    ]
    state = {"a": torch.rand(3, 4), "b": torch.zeros(2)}
    with tempfile.TemporaryDirectory() as folder:
        write_video(Path(folder) / "film.mp4", values.integers(0, 255, (5, 32, 48, 3), np.uint8), 24.0)
        film = (Path(folder) / "film.mp4").read_bytes()
        write_bvh(Path(folder) / "walk.bvh", joints, 30.0)
        bvh = (Path(folder) / "walk.bvh").read_bytes()
    return {
        "own.npz": saved(lambda f: np.savez(f, joints_m=joints, fps=30.0)),
        "data_3d_h36m.npz": saved(lambda f: np.savez(f, positions_3d=np.array(clip, dtype=object))),
        "walk.bvh": bvh,
        "coco.json": json.dumps(people).encode(),
        "weights.pth": saved(lambda f: torch.save(state, f)),
        "legacy.pth": saved(lambda f: torch.save(state, f, _use_new_zipfile_serialization=False)),
        "weights.safetensors": save(state),
        "film.mp4": film,
    }


def mutated(draw: random.Random, data: bytes) -> bytes:
    """Bytes with some flipped, cut, repeated, or replaced by extreme numbers."""
    content = bytearray(data)
    for _ in range(draw.choice([1, 1, 2, 5, 20])):
        at = draw.randrange(len(content) or 1)
        kind = draw.randrange(5)
        if kind == 0 and content:
            content[at] ^= 1 << draw.randrange(8)
        elif kind == 1:
            content = content[: max(1, at)]
        elif kind == 2:
            content[at : at + 8] = draw.choice([b"\xff" * 8, bytes(8), b"\x7f" * 8, b"1e999999", b"-1 nan  "])
        elif kind == 3:
            content[at:at] = content[at : at + draw.randint(1, 64)]
        else:
            del content[at : at + draw.randint(1, 16)]
    return bytes(content)
