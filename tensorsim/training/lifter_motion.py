"""Motion to train a lifter on: activities, exercises, falls, randomly joined poses, captures, everyday motion,
blows and kicks.

Everything is stored as joints at 60 frames per second, about 4 s each, on the floor, and is turned, placed and filmed
anew every time it is used.
"""

import io
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from tensorsim.body.kinematics import BodyPose, forward_kinematics, rest_on_floor
from tensorsim.body.proportions import Proportions
from tensorsim.body.skeleton import body_height, mid_hips
from tensorsim.data.motion_files import load_motion, motion_keys
from tensorsim.errors import TensorsimError
from tensorsim.files import write_bytes
from tensorsim.motion import everyday, exercises, martial_arts, scripts
from tensorsim.motion.act import Act
from tensorsim.motion.activities import perform
from tensorsim.motion.people import People, PeopleConfig, draw_people
from tensorsim.motion.pose_sampler import FAMILIES, sample_angles
from tensorsim.motion.resample import PoseResampler
from tensorsim.motion.timing import minimum_jerk

#: Frames per second and number of frames of a motion.
RATE_HZ, FRAMES = 60.0, 256
#: People, and ways of moving, of all kinds and in all headings.
_PEOPLE = PeopleConfig(
    height_m=(1.4, 2.0), limb_deviation=0.05, speed_m_s=(0.4, 1.8), heading_rad=math.pi, variation=0.2,
    tempo=(0.5, 1.1), start_range_m=(0.0, 0.0), keep_range_m=(0.0, 1e6), start_side_m=0.0,
)  # fmt: skip
#: Number of people whose motion is computed at once.
_CHUNK = 24
#: Where captured joints seem to move faster, a marker was lost.
_FASTEST_M_S = 20.0
#: Segments whose lengths vary between bodies: joint, parent joint, and group that varies together.
_CHAIN = (
    (2, 1, 0), (5, 1, 0), (0, 1, 1), (3, 2, 2), (6, 5, 2), (4, 3, 3), (7, 6, 3),
    (9, 8, 4), (12, 11, 4), (10, 9, 5), (13, 12, 5),
)  # fmt: skip


class MotionPool(NamedTuple):
    """Motions of equal length.

    Attributes:
        joints: (N, FRAMES, 14, 3) metres, z up from the floor.
        height_m: (N,) standing heights.
        kind: (N,) int64 index into ``KINDS``.
    """

    joints: Tensor
    height_m: Tensor
    kind: Tensor


#: Kinds of motion and the share of each.
KINDS = {
    "activities": 0.22, "exercises": 0.11, "falls": 0.12, "joined poses": 0.12, "captures": 0.15, "everyday": 0.06,
    "blows and kicks": 0.22,
}  # fmt: skip
#: Kicks of a ball and falls of everyday people, which happen at time 0 of their scripts.
_EVERYDAY = (
    everyday.kick_ball, everyday.fall_onto_seat, everyday.fall_on_knees, everyday.walk_and_fall_any_way,
)  # fmt: skip
#: Blows and kicks, which are over in a few frames and therefore rare unless there are many; the first is at time 0.
_BLOWS = (
    martial_arts.kick_round, scripts.kick, martial_arts.punch_once, martial_arts.swing_fist, martial_arts.kick_round,
    scripts.kick, exercises.box, scripts.punch,
)  # fmt: skip
#: Kinds that follow scripts: their scripts, used in turn, and ``farthest_s`` of :func:`_performed`.
_SCRIPTED: dict[str, tuple[tuple[Callable[[Tensor, People], Act], ...], float]] = {
    "activities": (scripts.SCRIPTS, 2.0),
    "exercises": (tuple(exercises.EXERCISES.values()), 0.5),
    "everyday": (_EVERYDAY, -3.0),
    "blows and kicks": (_BLOWS, -2.0),
}


def fall_any_way(time: Tensor, who: People) -> Act:
    """Falls as :func:`.everyday.fall_any_way`, some as slow as lying down."""
    slow = torch.where(who.gait_phase < 0.3, 0.45, 1.0)
    return everyday.fall_any_way(time, who._replace(tempo=slow * who.tempo))


def _performed(
    script: Callable[[Tensor, People], Act], count: int, farthest_s: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Joints (count, FRAMES, 14, 3) of people who follow a script, and their heights.

    Each motion begins at a random time between 0 and ``farthest_s`` of the script.
    """
    who = draw_people(count, _PEOPLE, generator)
    start = farthest_s * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    time = torch.arange(FRAMES, dtype=torch.float64) / RATE_HZ + start
    return perform(script, time, who), who.height_m


def _joined(count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Bodies that move between random poses while drifting and turning; the lowest joint is on the floor."""
    keys = 16
    who = draw_people(count, _PEOPLE, generator)
    families = torch.randint(FAMILIES, (2,), generator=generator).tolist()
    drawn = [sample_angles(family, count * keys, generator) for family in families]
    change = torch.rand(count, keys, generator=generator) < 0.35
    pace = torch.rand(count, 1, generator=generator, dtype=torch.float64)
    hold = 0.25 + (0.25 + 1.2 * pace) * torch.rand(count, keys, generator=generator, dtype=torch.float64)
    ends = hold.cumsum(dim=1)
    time = (torch.arange(FRAMES, dtype=torch.float64) / RATE_HZ).expand(count, -1).contiguous()
    key = torch.searchsorted(ends, time, right=True).clamp(max=keys - 2)
    since = time - (ends.gather(1, key) - hold.gather(1, key))
    share = minimum_jerk((since / hold.gather(1, key)).clamp(0.0, 1.0))
    turns = (torch.randn(count, keys, generator=generator, dtype=torch.float64) * 0.6).cumsum(dim=1)

    def between(of_keys: Tensor) -> Tensor:
        """Angles (count, keys, ...) at each time."""
        rows = torch.arange(count)[:, None]
        weight = share.reshape(share.shape + (1,) * (of_keys.dim() - 2))
        return torch.lerp(of_keys[rows, key], of_keys[rows, key + 1], weight)

    fields = {}
    for name in BodyPose._fields:
        one, other = (getattr(pose, name).unflatten(0, (count, keys)) for pose in drawn)
        chosen = change.reshape(change.shape + (1,) * (one.dim() - 2))
        fields[name] = between(torch.where(chosen, other, one))
    pose = BodyPose(**fields)
    pose = pose._replace(heading=pose.heading + between(turns))
    sizes = Proportions(*(torch.as_tensor(p)[:, None] for p in who.proportions))
    joints = rest_on_floor(forward_kinematics(pose, who.height_m[:, None], sizes), who.height_m[:, None])
    stops = 0.5 * torch.randn(count, keys, 2, generator=generator, dtype=torch.float64).cumsum(dim=1)
    drift = between(stops * torch.rand(count, 1, 1, generator=generator, dtype=torch.float64))
    return joints + torch.nn.functional.pad(drift, (0, 1))[:, :, None], who.height_m


def with_other_bones(joints: Tensor, factors: Tensor) -> Tensor:
    """Motion (T, 14, 3) of a body whose segments have other lengths.

    Args:
        joints: metres.
        factors: (7,) for shoulders, head, upper arms, forearms, thighs, shanks and trunk.
    """
    moved = joints.clone()
    hips = mid_hips(joints)
    neck = hips + factors[6] * (joints[:, 1] - hips)
    moved[:, 1] = neck
    for joint, parent, group in _CHAIN:
        moved[:, joint] = moved[:, parent] + factors[group] * (joints[:, joint] - joints[:, parent])
    return moved + (joints[..., 2].amin() - moved[..., 2].amin()) * moved.new_tensor([0.0, 0.0, 1.0])


def captures(paths: tuple[Path, ...], held_out: bool) -> dict[str, tuple[Tensor, float]]:
    """Captured motion (T, 14, 3) and its frame rate by name: every second sequence is held out.

    The first frame, often a calibration pose, is left out. A file without a frame rate may state it in its name, such
    as ``walks_120hz.npz``.

    Raises:
        TensorsimError: files that cannot be read.
    """
    found = {}
    for path in paths:
        named = re.search(r"(\d+)hz", path.stem)
        for key in motion_keys(path):
            motion = load_motion(path, key, float(named[1]) if named else None)
            found[f"{path.stem} {key}"] = (motion.joints[0, 1:].double(), float(motion.fps))
    return {name: one for i, (name, one) in enumerate(found.items()) if (i % 2 == 1) == held_out}


def _captured(
    sequences: list[tuple[Tensor, float]], count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Pieces of captured motion at 0.75 to 1.3 times its speed, of bodies with other proportions and sizes."""
    pieces: list[Tensor] = []
    heights: list[float] = []
    while len(pieces) < count:
        lengths = torch.tensor([len(joints) / fps for joints, fps in sequences]).clamp(max=12.0)
        joints, fps = sequences[int(torch.multinomial(lengths, 1, generator=generator))]
        speed = 0.75 + 0.55 * float(torch.rand(1, generator=generator))
        dense = PoseResampler(RATE_HZ)(joints, fps * speed)
        factors = 1 + 0.06 * torch.randn(7, generator=generator, dtype=torch.float64).clamp(-2, 2)
        dense = with_other_bones(dense, factors)
        # Short captures are played forwards and backwards.
        while len(dense) < FRAMES:
            dense = torch.cat([dense, dense.flip(0)[1:]])
        start = int(torch.randint(len(dense) - FRAMES + 1, (1,), generator=generator))
        height = 1.4 + 0.6 * float(torch.rand(1, generator=generator))
        piece = dense[start : start + FRAMES]
        if float((piece[1:] - piece[:-1]).norm(dim=-1).max()) * RATE_HZ > _FASTEST_M_S:
            continue  # a marker was lost
        pieces.append(piece * (height / float(body_height(piece).median())))
        heights.append(height)
    return torch.stack(pieces), torch.tensor(heights, dtype=torch.float64)


def _batches(
    kind: str, count: int, sequences: list[tuple[Tensor, float]], generator: torch.Generator
) -> Iterator[tuple[Tensor, Tensor]]:
    """Motions of one kind with heights, a chunk at a time."""
    for i, first in enumerate(range(0, count, _CHUNK)):
        size = min(_CHUNK, count - first)
        if kind in _SCRIPTED:
            in_turn, farthest_s = _SCRIPTED[kind]
            yield _performed(in_turn[i % len(in_turn)], size, farthest_s, generator)
        elif kind == "falls":
            joints, heights = _performed(fall_any_way, size, 0.0, generator)
            # Reversed in time, they get up.
            back = torch.rand(size, generator=generator) < 0.25
            yield torch.where(back[:, None, None, None], joints.flip(1), joints), heights
        elif kind == "captures":
            yield _captured(sequences, size, generator)
        else:
            yield _joined(size, generator)


def build_pool(
    path: Path | None,
    count: int,
    motions: tuple[Path, ...] = (),
    seed: int = 0,
    held_out: bool = False,
    quiet: bool = False,
) -> MotionPool:
    """The motions of a file, made and stored first if it is not there.

    Args:
        path: ``.pt`` file; None stores nothing.
        count: total number of motions.
        motions: motion capture files. Without any, the other kinds take their share.
        seed: seed of everything random.
        held_out: use the captures that are not trained on, see :func:`captures`.
        quiet: no progress bar.

    Raises:
        TensorsimError: a damaged file, or one of other motions.
    """
    names = [file.name for file in motions]
    settings = {"count": count, "seed": seed, "held_out": held_out, "motions": names}
    if path is not None and path.is_file():
        try:
            stored = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:
            raise TensorsimError(
                f"{path}: damaged ({type(error).__name__}); remove it to generate it again"
            ) from error
        if stored.get("settings") != settings:
            raise TensorsimError(f"{path}: got motions of {stored.get('settings')}, expected {settings}")
        return MotionPool(*(stored[name] for name in MotionPool._fields))
    generator = torch.Generator().manual_seed(seed)
    sequences = list(captures(motions, held_out).values())
    shares = {kind: share for kind, share in KINDS.items() if sequences or kind != "captures"}
    counts = {kind: max(1, round(count * share / sum(shares.values()))) for kind, share in shares.items()}
    joints, heights, kinds = [], [], []
    with tqdm(total=sum(counts.values()), desc="motion", disable=quiet) as bar:
        for kind, number in counts.items():
            for made, tall in _batches(kind, number, sequences, generator):
                joints.append(made.float())
                heights.append(tall.float())
                kinds.append(torch.full((len(made),), list(KINDS).index(kind)))
                bar.update(len(made))
    pool = MotionPool(torch.cat(joints), torch.cat(heights), torch.cat(kinds))
    if path is not None:
        content = io.BytesIO()
        torch.save(pool._asdict() | {"settings": settings}, content)
        write_bytes(path, content.getbuffer())
    return pool
