"""Motion capture files as joints: npz, BVH, Human3.6M of VideoPose3D, AMASS; and COCO keypoints of video as JSON.

Skeletons differ in their joints and agree in their names, more or less: names are matched, positions are turned to
metres in the world frame (x right, y away, z up) and people get the 14 joints of ``tensorsim.JOINTS``.
"""

import json
import math
import os
import pickle
import re
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.config import COCO_KEYPOINTS, JOINTS
from tensorsim.errors import TensorsimError, check_finite, check_positive

#: Joints 0 to 21 of SMPL, SMPL-H and SMPL-X; further ones are hands and face.
SMPL_JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
#: The joints of Human3.6M's 32 that the body needs, by index.
H36M_JOINTS = {
    14: "nose", 25: "right_shoulder", 26: "right_elbow", 27: "right_wrist", 17: "left_shoulder", 18: "left_elbow",
    19: "left_wrist", 1: "right_hip", 2: "right_knee", 3: "right_ankle", 6: "left_hip", 7: "left_knee", 8: "left_ankle",
}  # fmt: skip
H36M_FPS = 50.0

#: What skeletons call a joint, best first, after the side: Mixamo and CMU name bones by where they start.
_ALIASES = {
    "shoulder": ("arm", "upperarm", "uparm", "shldr", "shoulder"),
    "elbow": ("elbow", "forearm", "lowerarm", "lowarm"),
    "wrist": ("wrist", "hand"),
    "hip": ("upleg", "upperleg", "thigh", "hip"),
    "knee": ("knee", "lowleg", "lowerleg", "leg", "shin", "calf"),
    "ankle": ("ankle", "foot"),
}
#: Metres per unit that capture files come in: metres, centimetres, inches, millimetres, CMU's ASF units.
_UNITS_M = (1.0, 0.01, 0.0254, 0.001, 0.0254 / 0.45)
#: Trunk, thigh and shank of a body 1.75 m tall.
_TYPICAL_M = 1.36
#: Height of ankles over the floor that they stand on.
ANKLE_HEIGHT_M = 0.07


class Motion(NamedTuple):
    """People moving in the world.

    Attributes:
        joints: (P, T, 14, 3) float32 metres, order of ``tensorsim.JOINTS``, x right, y away, z up.
        valid: (P, T) bool, whether the person is there.
        fps: frames per second.
    """

    joints: Tensor
    valid: Tensor
    fps: float


class Keypoints2D(NamedTuple):
    """People in the frames of a video.

    Attributes:
        keypoints: (T, P, 17, 2) pixels, order of ``tensorsim.COCO_KEYPOINTS``.
        scores: (T, P, 17); 0 where a keypoint was not labelled.
        valid: (T, P) bool, whether the person is in that frame.
        size: (height, width) of the frames in pixels; None where the file does not say.
    """

    keypoints: Tensor
    scores: Tensor
    valid: Tensor
    size: tuple[int, int] | None = None


@contextmanager
def _reading(path: Path, kind: str) -> Iterator[None]:
    """Whatever a reader stumbles over in a file that is damaged or another is one error that names the file."""
    try:
        yield
    except TensorsimError:
        raise
    except Exception as error:  # such exceptions share no base class
        raise TensorsimError(f"{path}: got a file that cannot be read as {kind} ({error})") from error


@contextmanager
def _npz(path: Path) -> Iterator[Any]:
    """The arrays of an npz."""
    with _reading(path, "npz"):
        if not zipfile.is_zipfile(path):
            raise ValueError("it is no archive of arrays")
        with np.load(path, allow_pickle=False) as arrays:
            yield arrays


def motion_keys(path: str | os.PathLike[str]) -> list[str | None]:
    """The ``key`` of each motion of a file for :func:`load_motion`; [None] where there is nothing to choose.

    Raises:
        TensorsimError: an npz that cannot be read.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz" or not path.is_file():
        return [None]
    with _npz(path) as arrays:
        if "positions_3d" in arrays.files:
            return [None]
        motions = _motions(arrays)
        return [None] if _preferred(motions) is not None else [*motions] or [None]


def load_motion(
    path: str | os.PathLike[str],
    key: str | None = None,
    fps: float | None = None,
    joint_names: tuple[str, ...] | None = None,
    unit_m: float | None = None,
) -> Motion:
    """Reads a motion capture file; what kind it is follows from its suffix and, for npz, its arrays.

    - ``.bvh``: joints named as by CMU, Mixamo, Biped or Biovision; the vertical axis is found by the reader.
    - ``.npz`` with ``joints_m``, or any array (T, J, 3) or (P, T, J, 3) in world axes, and ``fps``;
      ``joint_names`` in it or as argument, needed unless J is 14 (ours), 17 (COCO) or 22, 24, 52 or more (SMPL);
      ``valid`` (P, T) if there is one.
    - ``.npz`` with ``joints`` or ``Jtr`` and ``mocap_framerate``: AMASS, SMPL joints, z up.
    - ``.npz`` with ``positions_3d``: VideoPose3D's Human3.6M, 32 joints. Its pickle may hold dictionaries, strings
      and arrays; anything else in it is refused and not run.

    Args:
        path: the file.
        key: the array in an npz, or ``"S1/Walking"`` (subject and action); not needed when there is one.
        fps: frames per second; overrides the file, needed where it says nothing.
        joint_names: names of the joints in the file, in order.
        unit_m: metres per unit; None takes the unit in which a BVH is nearest to an adult, metres for npz.

    Raises:
        TensorsimError: files that are missing or not readable, unknown joints, no frame rate, NaN.
    """
    path = Path(path)
    if not path.is_file():
        raise TensorsimError(f"{path}: no such file, expected motion capture (.bvh or .npz)")
    if fps is not None:
        check_positive(fps, "fps")
    if unit_m is not None:
        check_positive(unit_m, "unit_m")
    if path.suffix.lower() == ".bvh":
        return _read_bvh(path, fps, unit_m)
    if path.suffix.lower() != ".npz":
        raise TensorsimError(f"{path}: got a {path.suffix or 'nameless'} file, expected .bvh or .npz")
    with _npz(path) as arrays:
        if "positions_3d" in arrays.files:
            return _read_h36m(path, key, fps)
        return _read_npz(path, arrays, key, fps, joint_names, unit_m)


def place(motion: Motion, range_m: float | None = None, heading_rad: float = 0.0, x_m: float = 0.0) -> Motion:
    """Puts a motion on the floor, turns it and moves its start.

    Args:
        motion: people; they keep their places relative to one another.
        range_m: y of the first person's hips in its first valid frame; None keeps x and y where they are.
        heading_rad: turn about the vertical through these hips, counter-clockwise seen from above.
        x_m: their x, used with ``range_m``.

    Returns:
        The motion with its lowest joint at ankle height over z = 0.

    Raises:
        TensorsimError: a first person who is never there.
    """
    joints = motion.joints
    if not bool(motion.valid[:1].any()):
        raise TensorsimError("motion: got a first person without a valid frame, expected at least one")
    first = int(motion.valid[0].int().argmax())
    middle = F.pad((joints[0, first, 8] + joints[0, first, 11])[:2] / 2, (0, 1))
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    turn = joints.new_tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    to = middle if range_m is None else joints.new_tensor([x_m, range_m, 0.0])
    joints = (joints - middle) @ turn.mT + to
    lift = ANKLE_HEIGHT_M - joints[motion.valid][..., 2].min()
    joints = joints + joints.new_tensor([0.0, 0.0, float(lift)])
    return motion._replace(joints=joints * motion.valid[..., None, None])


def body_joints(positions: Tensor, names: tuple[str, ...], top: Tensor | None = None) -> Tensor:
    """The 14 joints from a skeleton with named joints.

    The neck is the middle of the shoulders. Where no nose is named, it is put before the head: half way to the
    top of the head and as far to the front, or by the size of a typical head where no ``top`` is known.

    Args:
        positions: (..., J, 3) world metres.
        names: J names, sides as "right", "r", "left" or "l" before or after them, in any case and with any prefix.
        top: (..., 3) top of the head.
    """
    index = {_plain(name): i for i, name in reversed(list(enumerate(names)))}

    def find(joint: str) -> Tensor | None:
        side, _, kind = joint.partition("_")
        candidates = [joint]
        if kind:
            candidates = [
                form
                for alias in _ALIASES[kind]
                for form in (side + alias, side[0] + alias, alias + side, alias + side[0], side + kind)
            ]
        for candidate in candidates:
            if candidate in index:
                return positions[..., index[candidate], :]
        return None

    found = {joint: find(joint) for joint in JOINTS[2:]}
    head, nose = find("head"), find("nose")
    missing = [joint for joint, position in found.items() if position is None]
    if head is None and nose is None:
        missing.insert(0, "head")
    if missing:
        raise TensorsimError(
            f"joint names: got {', '.join(names)}; expected names for {', '.join(missing)} as well"
        )
    limbs = torch.stack([position for position in found.values() if position is not None], dim=-2)
    right, left = limbs[..., 0, :], limbs[..., 3, :]
    neck = (right + left) / 2
    if nose is None:
        assert head is not None
        hips = (limbs[..., 6, :] + limbs[..., 9, :]) / 2
        up = F.normalize(neck - hips if top is None else top - head, dim=-1)
        front = F.normalize(torch.linalg.cross(up, right - left), dim=-1)
        size = 0.2 if top is None else (top - head).norm(dim=-1, keepdim=True)
        nose = head + 0.5 * size * (up * (0.4 if top is None else 1.0) + front)
    return torch.cat([torch.stack([nose, neck], dim=-2), limbs], dim=-2)


def load_coco_keypoints(path: str | os.PathLike[str]) -> Keypoints2D:
    """Reads COCO keypoints of a video: annotations or results in one JSON file, or a folder with one per frame.

    Frames are image ids in ascending order (files of a folder in order of name); people are ``track_id`` where
    there is one, else they stand in their order. ``keypoints`` are 51 numbers (x, y, visibility or score).

    Raises:
        TensorsimError: files that are missing or not such JSON, no people, other than 17 keypoints, a ``track_id``
            of some people only.
    """
    path = Path(path)
    if not path.exists():
        raise TensorsimError(f"{path}: no such file, expected COCO keypoints (.json)")
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    people: dict[Any, list[dict[str, Any]]] = {}
    size = None
    for number, file in enumerate(files):
        with _reading(file, "JSON of COCO keypoints"):
            content = json.loads(file.read_text(encoding="utf-8"))
            whole = isinstance(content, dict)
            for image in content.get("images", []) if whole else []:
                people.setdefault(number if path.is_dir() else image["id"], [])
                if "height" in image and "width" in image:
                    size = (int(image["height"]), int(image["width"]))
            people.setdefault(number, []) if path.is_dir() else None
            for person in content.get("annotations", []) if whole else content:
                numbers = person.get("keypoints") if isinstance(person, dict) else None
                if not isinstance(numbers, list) or len(numbers) != 51:
                    raise TensorsimError(
                        f"{file}: got an entry without 17 keypoints, expected 51 numbers each"
                    )
                people.setdefault(number if path.is_dir() else person.get("image_id", 0), []).append(person)
    everybody = [person for frame in people.values() for person in frame]
    if not everybody:
        raise TensorsimError(f"{path}: got no keypoints, expected COCO annotations or results")
    tracked = sum("track_id" in person for person in everybody)
    if 0 < tracked < len(everybody):
        raise TensorsimError(
            f"{path}: got a track_id for {tracked} of {len(everybody)} people, expected one for all or for none"
        )

    with _reading(path, "JSON of COCO keypoints"):
        frames = [people[frame] for frame in sorted(people)]
        tracks = sorted({person["track_id"] for person in everybody if tracked})
        count = len(tracks) or max(len(frame) for frame in frames)
        data = torch.zeros(len(frames), count, 17, 3)
        valid = torch.zeros(len(frames), count, dtype=torch.bool)
        for t, frame in enumerate(frames):
            for p, person in enumerate(frame):
                place = tracks.index(person["track_id"]) if tracked else p
                data[t, place] = torch.tensor(person["keypoints"], dtype=torch.float32).view(17, 3)
                valid[t, place] = True
    check_finite(data, str(path))
    # Annotations flag visibility by 0, 1 or 2; networks write scores.
    scores = data[..., 2]
    if bool((scores == scores.round()).all()) and float(scores.max()) <= 2:
        scores = (scores > 0).float()
    return Keypoints2D(data[..., :2], scores, valid, size)


def _plain(name: str) -> str:
    """A joint's name without prefix, case and punctuation: "mixamorig:RightArm" -> "rightarm"."""
    name = re.sub(
        r"^(bip\d*|valvebiped|mixamorig\d*|character\d*)[\s_:.]+", "", name.strip(), flags=re.IGNORECASE
    )
    return re.sub(r"[^a-z0-9]", "", name.split(":")[-1].lower())


def _motion(
    path: Path, positions: Tensor, names: tuple[str, ...], fps: float | None, valid: Tensor | None = None,
    top: Tensor | None = None,
) -> Motion:  # fmt: skip
    if fps is None:
        raise TensorsimError(f"{path}: got no frame rate in the file, expected one as fps")
    check_positive(fps, f"{path}: fps")
    if positions.shape[-3] < 1:
        raise TensorsimError(f"{path}: got no frames, expected at least one")
    check_finite(positions, str(path))
    try:
        joints = body_joints(positions, names, top)
    except TensorsimError as error:
        raise TensorsimError(f"{path}: {error}") from error
    if joints.dim() == 3:
        joints = joints[None]
    if valid is None:
        valid = torch.ones(joints.shape[:2], dtype=torch.bool)
    if valid.shape != joints.shape[:2]:
        raise TensorsimError(
            f"{path}: got valid of shape {list(valid.shape)}, expected {list(joints.shape[:2])}"
        )
    return Motion(joints.float(), valid, float(fps))


def _read_bvh(path: Path, fps: float | None, unit_m: float | None) -> Motion:
    try:
        import pybvh
    except ImportError as error:
        raise TensorsimError(f"{path}: got no BVH reader; install it with `pip install pybvh`") from error
    with _reading(path, "BVH"):
        clip = pybvh.read_bvh_file(path)
        nodes = torch.from_numpy(np.ascontiguousarray(clip.node_positions(), dtype=np.float64))
        # "+y" and the like; the other two axes keep their handedness and y-up files face the radar.
        vertical = str(clip.world_up)
        head = next((n for n in clip.joint_names if _plain(n) == "head"), None)
        end = None if head is None else clip.joint_tips.get(head)
        index = [clip.node_index[name] for name in clip.joint_names]
    nodes = _upright(nodes, vertical)
    top = None if end is None else nodes[:, end]
    names = tuple(clip.joint_names)
    motion = _motion(path, nodes[:, index], names, clip.fps if fps is None else fps, top=top)
    if unit_m is None:
        size = _size(motion.joints[0])
        unit_m = min(_UNITS_M, key=lambda unit: abs(math.log(max(size * unit, 1e-9) / _TYPICAL_M)))
    return motion._replace(joints=motion.joints * unit_m)


def _upright(points: Tensor, vertical: str) -> Tensor:
    """Points of a right-handed frame with this vertical ("+y", "z", ...) turned to z up."""
    axis = "xyz".index(vertical[-1].lower())
    sign = -1.0 if vertical[0] == "-" else 1.0
    order = {0: (2, 1, 0), 1: (0, 2, 1), 2: (0, 1, 2)}[axis]
    turned = points[..., order].clone()
    # Swapping two axes mirrors; negating y as well makes it a rotation.
    flips = points.new_tensor([1.0, (1.0 if axis == 2 else -1.0) * sign, sign])
    return turned * flips


def _size(joints: Tensor) -> float:
    """Median length of trunk, thigh and shank together, (T, 14, 3) -> one number."""

    def length(a: Tensor, b: Tensor) -> float:
        return float((a - b).norm(dim=-1).median())

    hips = (joints[:, 8] + joints[:, 11]) / 2
    return (
        length(joints[:, 1], hips) + length(joints[:, 8], joints[:, 9]) + length(joints[:, 9], joints[:, 10])
    )


def _motions(arrays: Any) -> list[str]:
    """Names of the arrays (T, J, 3) and (P, T, J, 3)."""
    return [name for name in arrays.files if arrays[name].ndim in (3, 4) and arrays[name].shape[-1] == 3]


def _preferred(motions: list[str]) -> str | None:
    """The array that is taken where there are several, by its usual name."""
    return next((name for name in ("joints_m", "joints", "Jtr") if name in motions), None)


def _read_npz(
    path: Path, arrays: Any, key: str | None, fps: float | None, names: tuple[str, ...] | None,
    unit_m: float | None,
) -> Motion:  # fmt: skip
    candidates = _motions(arrays)
    if key is None:
        key = candidates[0] if len(candidates) == 1 else _preferred(candidates)
    if key not in candidates:
        shown = ", ".join(candidates) or "arrays (T, J, 3), but there are none"
        raise TensorsimError(f"{path}: got key {key!r}, expected one of {shown}")
    for name in (f"{key}_fps", "fps", "mocap_framerate", "mocap_frame_rate"):
        if fps is None and name in arrays.files:
            fps = float(arrays[name])
    positions = torch.from_numpy(arrays[key].astype(np.float64)) * (1.0 if unit_m is None else unit_m)
    count = positions.shape[-2]
    if names is None and "joint_names" in arrays.files:
        names = tuple(str(name) for name in arrays["joint_names"])
    if names is None:
        if count == len(JOINTS):
            names = JOINTS
        elif count == len(COCO_KEYPOINTS):
            names = COCO_KEYPOINTS
        elif count in (22, 24) or count >= 52:
            names, positions = SMPL_JOINTS, positions[..., :22, :]
        else:
            raise TensorsimError(
                f"{path}: got {count} joints without names, expected joint_names or 14, 17, 22, 24 or 52 joints"
            )
    if len(names) != positions.shape[-2]:
        raise TensorsimError(f"{path}: got {len(names)} joint names, expected {positions.shape[-2]}")
    if names == JOINTS:  # the head of our own skeleton is the nose
        names = ("nose", *JOINTS[1:])
    valid = torch.from_numpy(arrays["valid"].astype(bool)) if "valid" in arrays.files else None
    return _motion(path, positions, names, fps, valid)


class _ArraysOnly(pickle.Unpickler):
    """Unpickles dictionaries, strings and numerical arrays; whatever else a pickle asks for is refused."""

    def find_class(self, module: str, name: str) -> Any:
        allowed = {"_reconstruct", "scalar"} if module.startswith(("numpy.core.", "numpy._core.")) else set()
        if module == "numpy":
            allowed = {"ndarray", "dtype"}
        if name not in allowed:
            raise pickle.UnpicklingError(f"the pickle asks for {module}.{name}, expected arrays only")
        return super().find_class(module, name)


def _read_h36m(path: Path, key: str | None, fps: float | None) -> Motion:
    with zipfile.ZipFile(path) as archive, archive.open("positions_3d.npy") as file:
        version = np.lib.format.read_magic(file)
        header = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        header(file)
        try:
            subjects = _ArraysOnly(file, encoding="latin1").load().item()
            clips = {
                f"{subject}/{action}": clip
                for subject in subjects
                for action, clip in subjects[subject].items()
            }
        except (AttributeError, EOFError, ImportError, TypeError) as error:
            raise TensorsimError(f"{path}: got positions_3d that hold no dictionary ({error})") from error
    if key is None and len(clips) == 1:
        key = next(iter(clips))
    if key not in clips:
        shown = ", ".join(list(clips)[:12])
        raise TensorsimError(f"{path}: got key {key!r}, expected a subject and action such as {shown}")
    positions = torch.from_numpy(np.asarray(clips[key], dtype=np.float64))
    if positions.dim() != 3 or positions.shape[1:] != (32, 3):
        raise TensorsimError(f"{path}: got {key} of shape {list(positions.shape)}, expected (T, 32, 3)")
    positions = positions[:, list(H36M_JOINTS)]
    return _motion(path, positions, tuple(H36M_JOINTS.values()), H36M_FPS if fps is None else fps)
