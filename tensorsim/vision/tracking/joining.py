"""Tracks that are one person: those that follow two parts of a body, and those that continue where another ended."""

import torch
from torch import Tensor

from tensorsim.geometry.boxes import box_area, box_intersection


def contained(a: Tensor, b: Tensor) -> Tensor:
    """Share of the smaller of two boxes that the other covers: (..., 4) xyxy, broadcast -> (...), 0 for empty ones."""
    smaller = torch.minimum(box_area(a), box_area(b))
    return box_intersection(a, b) / smaller.clamp(min=1e-9)


def join_tracks(
    table: Tensor, boxes: Tensor, scores: Tensor, looked: Tensor, strong_score: float, longest_gap: int
) -> Tensor:
    """Join the tracks of one clip that belong to one person.

    Two tracks are one person if

    - both are present at the same time, the smaller box mostly inside the other (median of :func:`contained` at least
      0.6), and in at most a quarter of these frames both have detections of ``strong_score``: two people who hug are
      both detected, while a crouching body is found once whole and once in part; or
    - one starts at most ``longest_gap`` observed frames after the other ended, or while it ends (in the first quarter
      of its own frames), and of the last box of the one and the next box of the other, one covers at least half of the
      smaller one. The box of somebody who falls changes its shape abruptly.

    In frames where both have a detection, the one with the better score is kept. Tracks are joined until no pair is
    left.

    Args:
        table: (I, T) int64 detection of each track in each frame, -1 for none.
        boxes: (T, K, 4) xyxy.
        scores: (T, K).
        looked: (T,) bool, the frames that were observed.
        strong_score: score from which a detection is certain.
        longest_gap: in observed frames.

    Returns:
        (I', T) int64 with I' <= I, in the order of the first of the joined tracks.
    """
    order = looked.to(torch.int64).cumsum(0)
    count = table.shape[0]
    table, left = table.clone(), torch.ones(count, dtype=torch.bool)
    # Pairs to look at, in order: each once, and again where one of the two has been joined since.
    due = torch.ones(count, count, dtype=torch.bool).triu(1)
    i = 0
    while i < count:
        joined = False
        columns: list[int] = torch.nonzero(due[i])[:, 0].tolist()
        for j in columns:
            due[i, j] = False
            if _same(table[i], table[j], boxes, scores, order, strong_score, longest_gap):
                table[i] = _joined(table[i], table[j], scores)
                left[j] = False
                due[j], due[:, j] = False, False
                due[:i, i], due[i, i + 1 :] = left[:i], left[i + 1 :]
                joined = True
                break
        i = 0 if joined else i + 1
    return table[left]


def _same(
    a: Tensor, b: Tensor, boxes: Tensor, scores: Tensor, order: Tensor, strong_score: float, longest_gap: int
) -> bool:
    """Whether two tracks (T,) are one person."""
    at_a, at_b = torch.nonzero(a >= 0).squeeze(-1), torch.nonzero(b >= 0).squeeze(-1)
    if at_a.shape[0] == 0 or at_b.shape[0] == 0:
        return False
    if int(at_a[0]) > int(at_b[0]):
        a, b, at_a, at_b = b, a, at_b, at_a
    last, first = at_a[-1], at_b[0]
    during = int((at_b <= last).sum())
    if 4 * during <= at_b.shape[0]:
        after = at_b[during]
        gap = int(order[after] - order[last])
        if gap <= longest_gap and bool(contained(boxes[last, a[last]], boxes[after, b[after]]) >= 0.5):
            return True
    if int(last) < int(first):
        return False
    # Frames during both: a track stays at its last box in a frame in which only the other is matched.
    stop = torch.minimum(at_a[-1], at_b[-1])
    time = torch.arange(a.shape[0], device=a.device)
    both = time[(time >= first) & (time <= stop) & ((a >= 0) | (b >= 0))]
    box_a, box_b = _latest(a, at_a, both, boxes), _latest(b, at_b, both, boxes)
    inside = contained(box_a, box_b)
    twice = int(((_score(a, scores) >= strong_score) & (_score(b, scores) >= strong_score))[both].sum())
    return bool(inside.median() >= 0.6) and 4 * twice <= both.shape[0]


def _latest(track: Tensor, at: Tensor, when: Tensor, boxes: Tensor) -> Tensor:
    """The last box (n, 4) that a track (T,), matched in the frames ``at``, had up to the frames ``when`` (n,)."""
    frame = at[torch.searchsorted(at, when, right=True) - 1]
    return boxes[frame, track[frame]]


def _score(track: Tensor, scores: Tensor) -> Tensor:
    """Score of the detection of a track in every frame (T,), -1 where it has none."""
    found = scores.gather(1, track.clamp(min=0)[:, None])[:, 0]
    return torch.where(track >= 0, found, -1.0)


def _joined(a: Tensor, b: Tensor, scores: Tensor) -> Tensor:
    """One track of two, with the better detection where both have one."""
    return torch.where(_score(b, scores) > _score(a, scores), b, a)
