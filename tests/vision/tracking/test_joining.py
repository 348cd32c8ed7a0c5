"""Tracks that are one person, on boxes whose truth is known."""

from typing import Any

import pytest
import torch
from torch import Tensor

from tensorsim.types import Detections
from tensorsim.vision.tracking import joining
from tensorsim.vision.tracking.joining import contained, join_tracks
from tensorsim.vision.tracking.tracker import GNNTracker


def clip(*tracks: tuple[slice, tuple[float, float, float, float], float]) -> tuple[Tensor, Tensor, Tensor]:
    """Table, boxes and scores of tracks that stand still, detection i of a frame being that of track i."""
    table = torch.full((len(tracks), 40), -1)
    boxes = torch.zeros(40, len(tracks), 4, dtype=torch.float64)
    scores = torch.zeros(40, len(tracks), dtype=torch.float64)
    for i, (when, box, score) in enumerate(tracks):
        table[i, when] = i
        boxes[when, i] = torch.tensor(box, dtype=torch.float64)
        scores[when, i] = score
    return table, boxes, scores


def count(*tracks: tuple[slice, tuple[float, float, float, float], float], gap: int = 23) -> int:
    """How many people these tracks are."""
    looked = torch.ones(40, dtype=torch.bool)
    return join_tracks(*clip(*tracks), looked, 0.5, gap).shape[0]


STANDING = (100.0, 100.0, 180.0, 300.0)
LYING = (95.0, 210.0, 235.0, 300.0)
HEAD = (120.0, 100.0, 160.0, 150.0)
ELSEWHERE = (400.0, 100.0, 480.0, 300.0)


def test_share_of_the_smaller_box() -> None:
    boxes = torch.tensor([STANDING, HEAD, ELSEWHERE])
    assert contained(boxes[0], boxes[1]) == 1.0
    assert contained(boxes[1], boxes[0]) == 1.0
    assert contained(boxes[0], boxes[2]) == 0.0
    half = boxes[0] + torch.tensor([40.0, 0, 40, 0])
    torch.testing.assert_close(contained(boxes[0], half), torch.tensor(0.5))


def test_who_goes_on_in_another_shape_is_one_person() -> None:
    assert count((slice(0, 15), STANDING, 0.8), (slice(17, 40), LYING, 0.6)) == 1
    assert count((slice(0, 15), STANDING, 0.8), (slice(13, 40), LYING, 0.6)) == 1
    assert count((slice(0, 15), STANDING, 0.8), (slice(17, 40), ELSEWHERE, 0.6)) == 2
    assert count((slice(0, 8), STANDING, 0.8), (slice(20, 40), LYING, 0.6), gap=5) == 2


def test_a_part_found_beside_the_whole_is_one_person() -> None:
    assert count((slice(0, 40), STANDING, 0.8), (slice(10, 25), HEAD, 0.4)) == 1
    # Both are sure: a child before an adult.
    assert count((slice(0, 40), STANDING, 0.8), (slice(10, 25), HEAD, 0.7)) == 2
    assert count((slice(0, 40), STANDING, 0.8), (slice(10, 25), ELSEWHERE, 0.4)) == 2


def test_the_better_detection_stands_for_both() -> None:
    tracks = ((slice(0, 30), STANDING, 0.8), (slice(20, 40), HEAD, 0.4))
    table, boxes, scores = clip(*tracks)
    joined = join_tracks(table, boxes, scores, torch.ones(40, dtype=torch.bool), 0.5, 23)
    assert joined[0].tolist() == [0] * 30 + [1] * 10


def test_others_keep_their_places_when_two_are_joined() -> None:
    tracks = (
        (slice(0, 15), STANDING, 0.8),
        (slice(0, 40), ELSEWHERE, 0.8),
        (slice(5, 40), (700.0, 100.0, 780.0, 300.0), 0.8),
        (slice(17, 40), LYING, 0.6),
        (slice(8, 40), (900.0, 100.0, 980.0, 300.0), 0.8),
    )
    table, boxes, scores = clip(*tracks)
    joined = join_tracks(table, boxes, scores, torch.ones(40, dtype=torch.bool), 0.5, 23)
    assert joined[0].tolist() == [0] * 15 + [-1] * 2 + [3] * 23
    assert torch.equal(joined[1:], table[[1, 2, 4]])


@pytest.mark.parametrize("lying_score", [0.25, 0.35])
def test_who_lies_down_is_followed_although_found_badly(lying_score: float) -> None:
    table, boxes, scores = clip(
        (slice(0, 15), STANDING, 0.8), (slice(15, 40), LYING, lying_score), (slice(0, 40), ELSEWHERE, 0.28)
    )
    valid = scores > 0
    found = Detections(boxes[None], scores[None], torch.zeros_like(table.t())[None], valid[None])
    tracks = GNNTracker()(found)
    assert tracks.valid.shape[1] == 1
    assert tracks.matched.all()
    torch.testing.assert_close(
        tracks.boxes[0, 0, -1], torch.tensor(LYING, dtype=torch.float64), atol=8, rtol=0
    )
    # Below that score it is nothing.
    lower = found._replace(scores=torch.where(found.scores < 0.4, 0.15, found.scores))
    assert GNNTracker()(lower).valid[0, 0].sum() == 15


def test_two_tracks_do_not_exchange_a_sure_for_a_doubtful_detection() -> None:
    """A track that was lost long ago and comes near does not take the place of the one that is there."""
    table, boxes, scores = clip(
        (slice(0, 40), STANDING, 0.8),
        (slice(0, 8), (230.0, 100.0, 310.0, 300.0), 0.7),
        (slice(20, 40), (140.0, 110.0, 200.0, 260.0), 0.35),
    )
    found = Detections(boxes[None], scores[None], torch.zeros_like(table.t())[None], (scores > 0)[None])
    tracks = GNNTracker()(found)
    torch.testing.assert_close(
        tracks.boxes[0, 0], torch.tensor(STANDING, dtype=torch.float64).expand(40, 4), atol=1, rtol=0
    )
    assert tracks.valid[0, 1:, 30:].sum() == 0


@pytest.mark.parametrize(("sure", "people"), [(4, 1), (5, 2)])
def test_who_is_surely_there_twice_in_more_than_a_quarter_of_the_frames_is_two(
    sure: int, people: int
) -> None:
    table, boxes, scores = clip((slice(0, 40), STANDING, 0.8), (slice(10, 26), HEAD, 0.4))
    scores[10 : 10 + sure, 1] = 0.7
    assert join_tracks(table, boxes, scores, torch.ones(40, dtype=torch.bool), 0.5, 23).shape[0] == people


def test_pairs_are_found_where_there_are_more_tracks_than_frames() -> None:
    table = torch.tensor([[0, 0], [1, 1], [2, -1], [-1, 2]])
    right = torch.tensor([300.0, 0.0, 300.0, 0.0], dtype=torch.float64)
    standing = torch.tensor(STANDING, dtype=torch.float64)
    boxes = torch.stack([standing + right, standing + 2 * right, standing]).expand(2, 3, 4)
    found = join_tracks(
        table, boxes, torch.full((2, 3), 0.8).double(), torch.ones(2, dtype=torch.bool), 0.5, 5
    )
    assert found.tolist() == [[0, 0], [1, 1], [2, 2]]


def test_pairs_are_looked_at_once_unless_one_of_them_was_joined(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve people side by side, six of whom are lost and found again; the result is that of looking at all anew."""
    places = [(200.0 * k, 100.0, 200.0 * k + 80.0, 300.0) for k in range(12)]
    tracks = [(slice(0, 15 if k % 2 else 40), place, 0.8) for k, place in enumerate(places)]
    tracks += [(slice(17, 40), place, 0.8) for place in places[1::2]]
    looked, same = torch.ones(40, dtype=torch.bool), joining._same
    calls = 0

    def counted(*arguments: Any) -> bool:
        nonlocal calls
        calls += 1
        return same(*arguments)

    monkeypatch.setattr(joining, "_same", counted)
    table, boxes, scores = clip(*tracks)
    before = table.clone()
    joined = join_tracks(table, boxes, scores, looked, 0.5, 23)
    assert torch.equal(table, before)
    expected = table[:12].clone()
    expected[1::2] = torch.maximum(expected[1::2], table[12:])
    assert torch.equal(joined, expected)
    assert calls <= 18 * 17 // 2 + 6 * 17
