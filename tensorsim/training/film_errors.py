"""Errors of pose networks on films, transferred to other motion from the most similar segments.

Errors of networks are not random: an arm in front of the body has the same wrong position for as long as it is there,
a left leg is mistaken for the right one from some directions, and clothes cause errors throughout a film. The errors
are therefore copied, not modelled. Films with known true motion are stored with the networks' results; another motion
gets, segment by segment, the errors of similar segments, chosen by dynamic programming (Viterbi, 1967) over the
dissimilarity and a penalty for changing to another film.
"""

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import MIRRORED, mid_hips
from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError
from tensorsim.evaluation.clips import Clip, activity_clips
from tensorsim.evaluation.films import FPS, Observed, filmed, project

#: Frames of a segment, frames from one segment to the next, and the frames of a segment that are compared.
_PIECE, _STEP, _COMPARED = 12, 6, (0, 4, 8, 11)
#: Frames between the starts of segments within a film.
_EVERY = 2
#: Dissimilarity, in body heights, of a keypoint outside the picture to one inside, and the penalty for changing to
#: another film.
_EDGE, _LEAVE = 0.15, 0.15
#: Share of the films from which a motion takes errors, drawn anew for each motion, so that results vary.
_SHARE = 0.3


class Look(NamedTuple):
    """A motion as it appears in the picture.

    Attributes:
        pixels: (T, 17, 2) true COCO keypoints.
        inside: (T, 17) whether they are in the picture.
        unit_px: (T,) standing height of the body in pixels at the distance of the hips.
    """

    pixels: Tensor
    inside: Tensor
    unit_px: Tensor

    @classmethod
    def of(cls, joints: Tensor, height_m: float) -> "Look":
        """From joints (T, 14, 3) and the camera of ``tensorsim.evaluation.films``."""
        joints = joints.double()
        pixels, inside, view = project(joints)
        depth = view.project(mid_hips(joints))[1]
        return cls(pixels, inside, view.scale * height_m / depth.clamp_min(0.3))

    @property
    def shape(self) -> Tensor:
        """(T, 17, 2) keypoints about the middle of the hips, in body heights."""
        return (self.pixels - self.pixels[:, 11:13].mean(1, keepdim=True)) / self.unit_px[:, None, None]


class Watched(NamedTuple):
    """Results of networks for the one person of a film.

    Attributes:
        shape, inside: see :class:`Look`.
        error: (T, 17, 2) found minus true keypoints, in body heights.
        scores: (T, 17).
        found: (T,) whether the person was tracked.
    """

    shape: Tensor
    inside: Tensor
    error: Tensor
    scores: Tensor
    found: Tensor

    @classmethod
    def of(cls, clip: Clip, seen: Observed) -> "Watched":
        """From the track nearest to the person in each frame, if it is within half a body height."""
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
        """The mirror image: left and right swapped."""
        other = list(MIRRORED)
        turn = self.shape.new_tensor([-1.0, 1.0])
        return Watched(
            self.shape[:, other] * turn,
            self.inside[:, other],
            self.error[:, other] * turn,
            self.scores[:, other],
            self.found,
        )


def activity_of_folder(path: Path) -> int | None:
    """Index of the activity S1 to S12 that the name of a file's folder begins with; None without one."""
    name = re.match(r"S(\d+)(?!\d)", path.parent.name)
    return int(name[1]) - 1 if name is not None and 1 <= int(name[1]) <= len(ACTIVITIES) else None


def films_of(folder: Path) -> Iterator[tuple[str, Clip, Observed]]:
    """Path, clip and people found for each film that ``tensorsim evaluate truth`` stores for its setting c.

    Raises:
        TensorsimError: none below this folder.
    """
    paths = [path for path in sorted(folder.rglob("*.npz")) if re.match(r"S\d+_", path.parent.name)]
    if not paths:
        raise TensorsimError(f"{folder}: got no films, expected those of evaluate truth --settings c")
    for path in paths:
        activity, number = activity_of_folder(path), re.match(r"(\d+)-", path.name)
        if activity is None or number is None:
            raise TensorsimError(f"{path}: got a name without a clip, expected one from evaluate truth")
        name = ACTIVITIES[activity]
        clip = activity_clips((name,), 1, int(number[1]))[name][0]
        yield str(path.relative_to(folder)), clip, filmed(path, clip, nn.Identity(), nn.Identity()).found


def watched_films(folder: Path) -> dict[str, Watched]:
    """The films of :func:`films_of` in which the networks found a person who is present."""
    return {
        name: Watched.of(clip, seen)
        for name, clip, seen in films_of(folder)
        if clip.present and seen.valid.shape[0] > 0
    }


def _features(shape: Tensor, inside: Tensor, starts: Tensor) -> Tensor:
    """Features (N, features) of the segments that start at these frames."""
    at = torch.tensor(_COMPARED) + starts[:, None]
    seen = shape.where(inside[..., None], 0.0)[at].flatten(2)
    return torch.cat([seen, _EDGE * inside[at].double()], -1).flatten(1)


class FilmErrors:
    """Adds the errors of networks on films to motion.

    Args:
        films: see :func:`watched_films`; at least 12 frames each. Their mirror images are used too.

    Attributes:
        digest: identifies the set of films.

    Raises:
        TensorsimError: no films, or one of fewer frames.
    """

    def __init__(self, films: dict[str, Watched]) -> None:
        shortest = min((len(film.found) for film in films.values()), default=0)
        if shortest < _PIECE:
            raise TensorsimError(f"FilmErrors: got a film of {shortest} frames, expected {_PIECE} or more")
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
        """Simulated results of networks for joints (T, 14, 3) of one person at the films' frame rate, T at least 12."""
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
        """For each segment, the film and start frame that its errors are taken from."""
        order = torch.randperm(len(self.films), generator=generator)
        chosen = order[: max(1, round(_SHARE * len(order)))].tolist()
        film = torch.cat([torch.full_like(self._starts[c], c) for c in chosen])
        at = torch.cat([self._starts[c] for c in chosen])
        features = torch.cat([self._features[c] for c in chosen])
        dissimilarity = torch.cdist(_features(look.shape, look.inside, starts), features)
        # A film continues one step later; its first segments have no predecessor.
        step = _STEP // _EVERY
        before = (torch.arange(len(at)) - step).clamp_min(0)
        follows = at >= _STEP
        cost, came_from = dissimilarity[0], []
        for here in dissimilarity[1:]:
            best, left = cost.min(0)
            stays = follows & (cost[before] <= best + _LEAVE)
            came_from.append(torch.where(stays, before, left))
            cost = here + torch.where(stays, cost[before], best + _LEAVE)
        path = [int(cost.argmin())]
        for back in reversed(came_from):
            path.append(int(back[path[-1]]))
        return [(self.films[int(film[p])], int(at[p])) for p in reversed(path)]
