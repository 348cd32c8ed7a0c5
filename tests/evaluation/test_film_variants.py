"""Variants of a film keep what happens in it, and the figures over them are means."""

import math

import pytest
import torch

from tensorsim.evaluation.film_variants import KEYPOINT_ERROR, Observed, mirrored, over_variants, variants
from tensorsim.types import Tracks

FPS, FRAMES, SIZE = 20.0, 40, (120, 200)


@pytest.fixture
def seen() -> Observed:
    """Two people, the second present in the first half only."""
    generator = torch.Generator().manual_seed(0)
    valid = torch.ones(1, 2, FRAMES, dtype=torch.bool)
    valid[:, 1, FRAMES // 2 :] = False
    boxes = torch.tensor([30.0, 10.0, 70.0, 110.0]) + torch.arange(FRAMES)[:, None]
    boxes = boxes * valid.unsqueeze(-1)
    keypoints = 30 + 60 * torch.rand(1, 2, FRAMES, 17, 2, generator=generator)
    scores = torch.rand(1, 2, FRAMES, 17, generator=generator)
    return Observed(Tracks(boxes, valid, valid.clone()), keypoints, scores, SIZE, 1.5)


def test_the_mirror_image_exchanges_left_and_right_of_picture_and_people(seen: Observed) -> None:
    other = mirrored(seen)
    left_wrist, right_wrist = 9, 10
    torch.testing.assert_close(
        other.keypoints[..., left_wrist, 0], SIZE[1] - 1 - seen.keypoints[..., right_wrist, 0]
    )
    torch.testing.assert_close(other.keypoints[..., left_wrist, 1], seen.keypoints[..., right_wrist, 1])
    assert torch.equal(other.scores[..., right_wrist], seen.scores[..., left_wrist])
    assert other.tracks.boxes[0, 0, 0].tolist() == [129.0, 10.0, 169.0, 110.0]
    assert not other.tracks.boxes[0, 1, -1].any(), "zeros where nobody is"
    again = mirrored(other)
    torch.testing.assert_close(again.keypoints, seen.keypoints)
    torch.testing.assert_close(again.tracks.boxes, seen.tracks.boxes)
    assert torch.equal(again.scores, seen.scores)


def test_six_variants_of_one_activity(seen: Observed) -> None:
    found = variants(seen, FPS)
    assert list(found)[:2] == ["as it is", "mirrored"]
    assert len(found) == 6
    assert found["as it is"] is seen
    cut = 5  # frames in a quarter of a second
    later, earlier = found["begins later"], found["ends earlier"]
    for part, whole in zip((*later.tracks, *later[1:3]), (*seen.tracks, *seen[1:3]), strict=True):
        assert torch.equal(part, whole[:, :, cut:])
    for part, whole in zip((*earlier.tracks, *earlier[1:3]), (*seen.tracks, *seen[1:3]), strict=True):
        assert torch.equal(part, whole[:, :, :-cut])
    errors = [found[f"keypoints off, seed {seed}"].keypoints - seen.keypoints for seed in (0, 1)]
    there = seen.tracks.valid
    for error in errors:
        spread = error[there].std() / math.hypot(40, 100)
        assert float(spread) == pytest.approx(KEYPOINT_ERROR, rel=0.05)
        assert not error[~there].any()
    assert not torch.equal(*errors)
    torch.testing.assert_close(
        variants(seen, FPS)["keypoints off, seed 1"].keypoints - seen.keypoints, errors[1]
    )


def test_a_film_of_a_second_is_not_shortened(seen: Observed) -> None:
    assert len(variants(seen, FRAMES)) == 4


def test_means_over_variants() -> None:
    def verdict(right: bool, probability: float) -> dict[str, dict[str, object]]:
        return {"s": {"right": right, "right_probability": probability}}

    rows = [
        {"variants": {"a": verdict(True, 0.5), "b": verdict(False, 0.25)}},
        {"variants": {"a": verdict(True, 1.0), "b": verdict(False, 0.0)}},  # refused
    ]
    right, logarithm = over_variants(rows, "s")
    assert right == pytest.approx(1.0)
    assert logarithm == pytest.approx((math.log(0.5) + math.log(0.25) + math.log(1e-3)) / 4)
