"""Errors of pose networks on films, copied to other motion from the moments that look most alike.

Networks do not err at random: an arm that hides in front of the body is put in the same wrong place for as long as it
hides, a left leg is taken for the right one from some sides, and a sleeve misleads for a whole film. So nothing is
modelled here. Of films whose true motion is known, what networks found is kept, and another motion gets, piece by
piece, the errors of pieces that look like it. Which ones is the shortest path (Viterbi, 1967) through unlikeness and a
price for leaving a film.
"""

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError
from tensorsim.evaluation.clips import Clip, activity_clips
from tensorsim.evaluation.films import FPS, Observed, filmed, project
from tensorsim.vision.pose2d.topdown import MIRRORED

#: Frames of a piece and from one to the next; frames of a piece that are compared.
_PIECE, _STEP, _COMPARED = 12, 6, (0, 4, 8, 11)
#: Starts of pieces within a film lie so many frames apart.
_EVERY = 2
#: What a key point beyond the edge of the picture adds to unlikeness where the other is inside, in body heights, and
#: what leaving a film adds to a path.
_EDGE, _LEAVE = 0.15, 0.15
#: Share of the films that a motion may take errors from, drawn anew for each, so that two of them differ.
_SHARE = 0.3


class Look(NamedTuple):
    """How a motion looks in the picture.

    Attributes:
        pixels: (T, 17, 2) true COCO key points.
        inside: (T, 17) whether they are in the picture.
        unit_px: (T,) what the body's standing height is at the distance of the hips.
    """

    pixels: Tensor
    inside: Tensor
    unit_px: Tensor

    @classmethod
    def of(cls, joints: Tensor, height_m: float) -> "Look":
        """Of joints (T, 14, 3) before the camera of ``tensorsim.evaluation.films``."""
        joints = joints.double()
        pixels, inside, view = project(joints)
        depth = view.project(0.5 * (joints[:, 8] + joints[:, 11]))[1]
        return cls(pixels, inside, view.scale * height_m / depth.clamp_min(0.3))

    @property
    def shape(self) -> Tensor:
        """(T, 17, 2) key points about the middle of the hips, in body heights."""
        return (self.pixels - self.pixels[:, 11:13].mean(1, keepdim=True)) / self.unit_px[:, None, None]


class Watched(NamedTuple):
    """What networks found of the one person of a film.

    Attributes:
        shape, inside: see :class:`Look`.
        error: (T, 17, 2) found less true key points, in body heights.
        scores: (T, 17).
        found: (T,) whether the person was followed.
    """

    shape: Tensor
    inside: Tensor
    error: Tensor
    scores: Tensor
    found: Tensor

    @classmethod
    def of(cls, clip: Clip, seen: Observed) -> "Watched":
        """Of several tracks, the one nearest to the person in each frame; farther than half a body is not found."""
        look = Look.of(clip.joints(FPS), clip.height_m)
        away = (seen.keypoints.double() - look.pixels).norm(dim=-1).median(-1).values
        away, track = away.where(seen.valid, torch.inf).min(0)
        found = away < 0.5 * look.unit_px
        frames = torch.arange(len(found))
        error = (seen.keypoints[track, frames] - look.pixels) / look.unit_px[:, None, None]
        return cls(
            look.shape,
            look.inside,
            error.where(found[:, None, None], 0.0),
            seen.scores[track, frames].double().where(found[:, None], 0.0),
            found,
        )

    def mirrored(self) -> "Watched":
        """Seen in a mirror: left is right."""
        other = list(MIRRORED)
        turn = self.shape.new_tensor([-1.0, 1.0])
        return Watched(
            self.shape[:, other] * turn,
            self.inside[:, other],
            self.error[:, other] * turn,
            self.scores[:, other],
            self.found,
        )


def activity_told(path: Path) -> int | None:
    """Index of the activity whose number, S1 to S12, begins the name of the folder of a file; None without one."""
    name = re.match(r"S(\d+)(?!\d)", path.parent.name)
    return int(name[1]) - 1 if name is not None and 1 <= int(name[1]) <= len(ACTIVITIES) else None


def films_of(folder: Path) -> Iterator[tuple[str, Clip, Observed]]:
    """Path, clip and people found of each film that ``tensorsim evaluate truth`` keeps for its setting c.

    Raises:
        TensorsimError: none below this folder.
    """
    paths = [path for path in sorted(folder.rglob("*.npz")) if re.match(r"S\d+_", path.parent.name)]
    if not paths:
        raise TensorsimError(f"{folder}: got no films, expected those of evaluate truth --settings c")
    for path in paths:
        activity, number = activity_told(path), re.match(r"(\d+)-", path.name)
        if activity is None or number is None:
            raise TensorsimError(f"{path}: got a name that tells no clip, expected one of evaluate truth")
        name = ACTIVITIES[activity]
        clip = activity_clips((name,), 1, int(number[1]))[name][0]
        yield str(path.relative_to(folder)), clip, filmed(path, clip, nn.Identity(), nn.Identity()).found


def watched_films(folder: Path) -> dict[str, Watched]:
    """Those of :func:`films_of` in which there is somebody, and somebody was found."""
    return {
        name: Watched.of(clip, seen)
        for name, clip, seen in films_of(folder)
        if clip.present and seen.valid.shape[0] > 0
    }


def _features(shape: Tensor, inside: Tensor, starts: Tensor) -> Tensor:
    """What is compared of pieces from these frames on, (N, features)."""
    at = torch.tensor(_COMPARED) + starts[:, None]
    seen = shape.where(inside[..., None], 0.0)[at].flatten(2)
    return torch.cat([seen, _EDGE * inside[at].double()], -1).flatten(1)


class FilmErrors:
    """Gives motion the errors of networks on films.

    Args:
        films: see :func:`watched_films`; of at least 12 frames each. Each serves mirrored as well.

    Attributes:
        digest: tells sets of films apart.

    Raises:
        TensorsimError: no films, or a shorter one.
    """

    def __init__(self, films: dict[str, Watched]) -> None:
        shortest = min((len(film.found) for film in films.values()), default=0)
        if shortest < _PIECE:
            raise TensorsimError(
                f"FilmErrors: got films from {shortest} frames on, expected {_PIECE} or more"
            )
        self.films = [one for film in films.values() for one in (film, film.mirrored())]
        content = hashlib.sha256()
        for name, film in films.items():
            content.update(name.encode() + film.error.numpy().tobytes())
        self.digest = content.hexdigest()[:16]
        self._starts = [torch.arange(0, len(f.found) - _PIECE + 1, _EVERY) for f in self.films]
        self._features = [
            _features(f.shape, f.inside, s) for f, s in zip(self.films, self._starts, strict=True)
        ]

    def __call__(self, joints: Tensor, height_m: float, generator: torch.Generator) -> Observed:
        """What networks would find of joints (T, 14, 3) of one person at the frame rate of films, T at least 12."""
        look = Look.of(joints, height_m)
        frames = len(look.unit_px)
        if frames < _PIECE:
            raise TensorsimError(f"joints: got {frames} frames, expected at least {_PIECE}")
        starts = torch.cat([torch.arange(0, frames - _PIECE, _STEP), torch.tensor([frames - _PIECE])])
        ramp = 1.0 + torch.minimum(torch.arange(_PIECE), torch.arange(_PIECE).flip(0)).double()
        weight, found = torch.zeros(2, frames, dtype=torch.float64)
        error, scores = torch.zeros_like(look.pixels), torch.zeros_like(look.pixels[..., 0])
        for start, (film, at) in zip(starts.tolist(), self._pieces(look, starts, generator), strict=True):
            here, there = slice(start, start + _PIECE), slice(at, at + _PIECE)
            shown = ramp * film.found[there]
            weight[here] += ramp
            found[here] += shown
            error[here] += shown[:, None, None] * film.error[there]
            scores[here] += shown[:, None] * film.scores[there]
        share = found.clamp_min(1e-9)
        keypoints = look.pixels + error * (look.unit_px / share)[:, None, None]
        boxes = torch.cat([keypoints.amin(1), keypoints.amax(1)], -1)
        return Observed(
            boxes.float()[None],
            (2 * found > weight)[None],
            keypoints.float()[None],
            (scores / share[:, None]).float()[None],
        )

    def _pieces(self, look: Look, starts: Tensor, generator: torch.Generator) -> list[tuple[Watched, int]]:
        """For each piece the film, and where in it, whose errors it gets."""
        order = torch.randperm(len(self.films), generator=generator)
        chosen = order[: max(1, round(_SHARE * len(order)))].tolist()
        film = torch.cat([torch.full_like(self._starts[c], c) for c in chosen])
        at = torch.cat([self._starts[c] for c in chosen])
        features = torch.cat([self._features[c] for c in chosen])
        unlikeness = torch.cdist(_features(look.shape, look.inside, starts), features)
        # A film goes on a step later; its first pieces follow nothing.
        step = _STEP // _EVERY
        before = (torch.arange(len(at)) - step).clamp_min(0)
        follows = at >= _STEP
        cost, came_from = unlikeness[0], []
        for here in unlikeness[1:]:
            best, left = cost.min(0)
            stays = follows & (cost[before] <= best + _LEAVE)
            came_from.append(torch.where(stays, before, left))
            cost = here + torch.where(stays, cost[before], best + _LEAVE)
        path = [int(cost.argmin())]
        for back in reversed(came_from):
            path.append(int(back[path[-1]]))
        return [(self.films[int(film[p])], int(at[p])) for p in reversed(path)]
