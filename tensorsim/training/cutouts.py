"""People cut out of rendered pictures, with exact outlines, for pasting onto background pictures.

A shard is a tar of ``KEY.png`` (RGBA, straight alpha, cropped to the person) and ``KEY.json`` with
``{"keypoints": [[x, y, v] * 17]}`` in its pixels (centres at integers; v as in COCO).
"""

import io
import json
import math
import os
import tarfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from tensorsim.body.kinematics import rest_on_floor, rotation
from tensorsim.config import CameraConfig
from tensorsim.device import rank_and_processes
from tensorsim.errors import TensorsimError
from tensorsim.files import complete_file, write_text
from tensorsim.geometry.camera import camera_to_world
from tensorsim.motion.pose_sampler import FAMILIES, sample_poses
from tensorsim.render.renderer import PersonRenderer
from tensorsim.training.pose_pool import everyday_poses

#: Rendered this many times larger than stored, so that outlines have soft edges.
OVERSAMPLING = 2
PER_SHARD = 250


class Cutout(NamedTuple):
    """One person.

    Attributes:
        rgba: (h, w, 4) uint8, straight alpha.
        keypoints: (17, 3) float32: x, y and v (0 outside, 1 hidden, 2 seen), pixels of ``rgba``.
    """

    rgba: npt.NDArray[np.uint8]
    keypoints: npt.NDArray[np.float32]


class Cutouts(Sequence[Cutout]):
    """The cut-outs in shards, in the order of the files and of the names inside them, decoded on access.

    Raises:
        TensorsimError: a file is not such a shard.
    """

    def __init__(self, paths: Iterable[str | os.PathLike[str]]) -> None:
        self.entries: list[tuple[bytes, npt.NDArray[np.float32]]] = []
        for path in paths:
            try:
                with tarfile.open(path) as tar:
                    files = {m.name: tar.extractfile(m).read() for m in tar if m.isfile()}  # type: ignore[union-attr]
                for name in sorted(files):
                    if name.endswith(".png"):
                        label = json.loads(files[name.removesuffix("png") + "json"])
                        points = np.array(label["keypoints"], np.float32).reshape(17, 3)
                        self.entries.append((files[name], points))
            except (OSError, tarfile.TarError, ValueError, KeyError, TypeError) as error:
                raise TensorsimError(f"{path}: not a shard of cut-outs ({error})") from error

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: Any) -> Any:
        import cv2

        data, keypoints = self.entries[index]
        bgra = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if bgra is None:
            raise TensorsimError(f"cut-out {index}: not a picture that can be read")
        return Cutout(np.ascontiguousarray(bgra[..., [2, 1, 0, 3]]), keypoints.copy())


def render_cutout(pose: Tensor, seed: int, side: int = 288) -> Cutout:
    """Render one person in this pose with a random view, clothes and light.

    Args:
        pose: (14, 3) body heights, as drawn by :func:`tensorsim.motion.pose_sampler.sample_poses`.
        seed: seed of appearance, light, heading and camera.
        side: approximate longest side of the result in pixels.
    """
    generator = torch.Generator().manual_seed(seed)

    def number(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    height = number(1.5, 1.95)
    turn = rotation(2, torch.tensor(number(-math.pi, math.pi), dtype=pose.dtype))
    joints = rest_on_floor((turn @ pose[..., None])[..., 0] * height, height)
    distance, camera_height = number(2.2, 8.0), number(0.5, 2.8)
    # The camera looks at the body and is not level.
    centre = (joints.amin(dim=0) + joints.amax(dim=0)) / 2
    position = (float(centre[0]), float(centre[1]) - distance, camera_height)
    pitch = math.atan2(float(centre[2]) - camera_height, distance)
    camera = CameraConfig(position_m=position, pitch_rad=pitch)
    pixels = side * OVERSAMPLING
    # Focal length and principal point such that the joints, with a margin for the flesh, fill the picture.
    x, y, z = ((joints - joints.new_tensor(position)) @ camera_to_world(camera)[:, :3].to(joints)).unbind(-1)
    low, high = torch.stack([x / z, y / z], dim=-1).aminmax(dim=0)
    flesh = 0.17 * height / 1.75 / distance
    focal = pixels / float((high - low).max() + 2 * flesh)
    middle = (low + high) / 2 * focal
    principal = ((pixels - 1) / 2 - float(middle[0]), (pixels - 1) / 2 - float(middle[1]))
    camera = CameraConfig(focal, center_px=principal, position_m=position, pitch_rad=pitch)
    renderer = PersonRenderer(camera, pixels, pixels, blur_px=0, noise=0, jpeg_quality=None)
    film = renderer(joints[None], seed, background=torch.full((3, 1, 1), 0.5))

    mask = film.masks[0, 0].float()
    coverage = _shrink(mask[None])
    colour = _shrink(film.frames[0].float() * mask) / coverage.clamp(min=1e-6)
    rgba = torch.cat([colour, coverage * 255]).round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0).numpy()
    rows, columns = (np.flatnonzero((rgba[..., 3] > 127).any(axis=axis)) for axis in (1, 0))
    top, left = max(rows[0] - 1, 0), max(columns[0] - 1, 0)
    rgba = np.ascontiguousarray(rgba[top : rows[-1] + 2, left : columns[-1] + 2])
    # A pixel of the small picture is the mean of a square of the large one.
    points = (film.keypoints[0, 0] + 0.5) / OVERSAMPLING - 0.5 - torch.tensor([left, top])
    flags = film.visibility[0, 0, :, None]
    return Cutout(rgba, torch.cat([points, flags], dim=-1).numpy().astype(np.float32))


def _shrink(picture: Tensor) -> Tensor:
    return torch.nn.functional.avg_pool2d(picture[None], OVERSAMPLING)[0]


def render_cutouts(count: int, seed: int, out: str | os.PathLike[str], quiet: bool = False) -> list[Path]:
    """Render people into shards ``cutouts-NNN.tar``; existing shards are kept.

    Half of them are in sampled poses, half in moments of everyday movements, such as picking up (see
    :func:`~tensorsim.training.pose_pool.everyday_poses`).

    ``cutouts.json`` next to them states number and seed. A folder of shards without it is taken as it is.

    Args:
        count: number of people, at least 13.
        seed: the same seed gives the same people.
        out: folder, created if missing.
        quiet: no progress bar.

    Returns:
        The shards.

    Raises:
        TensorsimError: too few people, or the folder holds cut-outs of another number or seed.
    """
    from tqdm import tqdm

    near_floor = max(min(count // 2, count - FAMILIES), 0)  # with few people, each family is drawn once
    poses = sample_poses(count - near_floor, seed)
    if near_floor:
        poses = torch.cat([poses, everyday_poses(near_floor, seed)])
    poses = poses[torch.randperm(count, generator=torch.Generator().manual_seed(seed))]
    folder = Path(out)
    settings = {"people": count, "seed": seed}
    described = folder / "cutouts.json"
    if described.is_file():
        try:
            there = json.loads(described.read_text(encoding="utf-8"))
        except ValueError as error:
            raise TensorsimError(f"{described}: damaged ({error}), expected {settings}") from error
        if there != settings:
            raise TensorsimError(f"{folder}: it holds rendered people of {there}, expected {settings}")
    elif not any(folder.glob("cutouts-*.tar")):
        write_text(described, json.dumps(settings))
    shards = [folder / f"cutouts-{k:03d}.tar" for k in range(math.ceil(count / PER_SHARD))]
    rank, processes = rank_and_processes()
    with tqdm(total=count, desc="people", disable=quiet or rank > 0) as progress:
        # Processes started together by torchrun each begin with different shards.
        for k in sorted(range(len(shards)), key=lambda k: (k - rank) % processes):
            people = range(k * PER_SHARD, min((k + 1) * PER_SHARD, count))
            if not shards[k].exists():
                with complete_file(shards[k]) as scratch, tarfile.open(scratch, "w") as tar:
                    for index in people:
                        _add(tar, f"{index:06d}", render_cutout(poses[index], seed * 1_000_003 + index))
                        progress.update()
            else:
                progress.update(len(people))
    return shards


def _add(tar: tarfile.TarFile, key: str, cutout: Cutout) -> None:
    import cv2

    png = cv2.imencode(".png", np.ascontiguousarray(cutout.rgba[..., [2, 1, 0, 3]]))[1].tobytes()
    label = json.dumps({"keypoints": cutout.keypoints.round(2).tolist()}).encode()
    for suffix, data in ((".png", png), (".json", label)):
        info = tarfile.TarInfo(key + suffix)
        info.size = len(data)
        tar.addfile(info, io.BytesIO(data))
