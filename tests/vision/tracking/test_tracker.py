"""The tracker on films of boxes whose truth is known, and on detections of real clips."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from tensorsim.errors import TensorsimError
from tensorsim.geometry.boxes import box_iou, center_to_xyxy, xyxy_to_center
from tensorsim.types import Detections, Tracks
from tensorsim.vision.tracking.tracker import GNNTracker
from tests.stage import StageTester


def walker(u0: float, u1: float, frames: int, height: float = 200.0, v: float = 300.0) -> Tensor:
    """Boxes (T, 4) of a person going from ``u0`` to ``u1``."""
    u = torch.linspace(u0, u1, frames, dtype=torch.float64)
    middle = torch.full_like(u, v)
    return center_to_xyxy(torch.stack([u, middle, 0.4 * height + 0 * u, height + 0 * u], dim=-1))


def film(
    people: list[Tensor],
    jitter: float = 1.0,
    seed: int = 0,
    score: float = 0.8,
    shuffle: bool = True,
) -> Detections:
    """One clip in which every box (T, 4) that is not NaN is detected, in random order, with some noise."""
    generator = torch.Generator().manual_seed(seed)
    boxes = torch.stack(people, dim=1)
    boxes = boxes + jitter * torch.randn(boxes.shape, generator=generator, dtype=torch.float64)
    valid = torch.isfinite(boxes).all(-1)
    scores = score + 0.1 * torch.rand(valid.shape, generator=generator, dtype=torch.float64)
    if shuffle:
        order = torch.rand(valid.shape, generator=generator).argsort(-1)
        boxes = boxes.gather(1, order.unsqueeze(-1).expand_as(boxes))
        valid, scores = valid.gather(1, order), scores.gather(1, order)
    boxes, scores = torch.where(valid.unsqueeze(-1), boxes, 0.0), torch.where(valid, scores, 0.0)
    return Detections(
        boxes[None], scores[None], torch.zeros(scores[None].shape, dtype=torch.int64), valid[None]
    )


def hidden(boxes: Tensor, frames: slice) -> Tensor:
    boxes = boxes.clone()
    boxes[frames] = torch.nan
    return boxes


def overlap(tracks: Tracks, person: int, truth: Tensor) -> Tensor:
    """IoU (T,) of one person's boxes with the truth, zero where not valid."""
    return box_iou(tracks.boxes[0, person].double(), truth) * tracks.valid[0, person]


class TestGNNTracker(StageTester):
    gradient_arguments = ()  # assignment is not differentiable
    batch_shapes = ((3,),)  # exactly one batch dimension
    exports = False  # the number of people depends on the detections

    def make(self) -> nn.Module:
        return GNNTracker()

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        frames = 24
        clips = [
            film(
                [
                    walker(100, 500, frames),
                    walker(520, 90, frames),
                    hidden(walker(700, 710, frames), slice(8, 13)),
                ],
                seed=i,
            )
            for i in range(batch[0])
        ]
        boxes, scores, labels, valid = (torch.cat(field) for field in zip(*clips, strict=True))
        observed = torch.arange(frames) % 2 == 0
        return Detections(boxes.to(dtype), scores.to(dtype), labels, valid), observed

    def test_batch_equals_loop(self) -> None:
        """Here the batched argument is a NamedTuple, and the number of people differs from clip to clip."""
        frames = 20
        empty = film([walker(0, 0, frames) * torch.nan] * 3)
        one = film([walker(100, 300, frames)] + [walker(0, 0, frames) * torch.nan] * 2)
        three = film([walker(100, 300, frames), walker(600, 300, frames), walker(800, 800, frames)])
        observed = torch.ones(3, frames, dtype=torch.bool)
        observed[1, ::2] = False
        batch = Detections(*(torch.cat(field) for field in zip(empty, one, three, strict=True)))
        whole = GNNTracker()(batch, observed)
        assert whole.valid.any(-1).sum(-1).tolist() == [0, 1, 3]
        for b, clip in enumerate((empty, one, three)):
            alone = GNNTracker()(clip, observed[b])
            count = alone.boxes.shape[1]
            for field, part in zip(whole, alone, strict=True):
                assert torch.equal(field[b, :count], part[0])
                assert not field[b, count:].any()

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        detections, observed = self.inputs((2,), torch.float32)
        boxes, scores, labels, valid = detections
        broken = boxes.clone()
        broken[valid] = torch.nan
        return [
            ((Detections(boxes[0], scores[0], labels[0], valid[0]), observed), r"\(B, T, K, 4\)"),
            ((Detections(boxes[..., :3], scores, labels, valid), observed), r"\(B, T, K, 4\)"),
            ((Detections(boxes.long(), scores, labels, valid), observed), "boxes: got dtype"),
            (
                (Detections(boxes[:, :0], scores[:, :0], labels[:, :0], valid[:, :0]), None),
                "at least one clip and",
            ),
            ((Detections(boxes, scores[:1], labels, valid), observed), "scores"),
            ((Detections(boxes, scores, labels, valid.long()), observed), "valid: got"),
            ((Detections(broken, scores, labels, valid), observed), "boxes where valid: got NaN"),
            ((Detections(boxes, scores / 0, labels, valid), observed), "scores where valid: got NaN"),
            ((detections, observed[:-1]), "observed: got"),
            ((detections, observed.float()), "observed: got"),
        ]


def test_two_people_cross_without_swapping() -> None:
    left, right = walker(100, 700, 60), walker(720, 60, 60, height=210)
    for step in (1, 2):
        observed = torch.arange(60) % step == 0
        tracks = GNNTracker()(film([left, right]), observed)
        assert tracks.boxes.shape == (1, 2, 60, 4)
        # Both are there from the first frame: the larger comes first.
        assert (overlap(tracks, 0, right) > 0.85).all()
        assert (overlap(tracks, 1, left) > 0.85).all()


def test_occluded_person_keeps_the_id_and_the_gap_is_bridged() -> None:
    behind, front = walker(100, 700, 80), walker(400, 400, 80, height=260)
    tracks = GNNTracker()(film([hidden(behind, slice(32, 48)), front]))
    assert tracks.boxes.shape[1] == 2
    assert tracks.valid[0, 1].all()
    assert not tracks.matched[0, 1, 32:48].any()
    assert (overlap(tracks, 1, behind) > 0.8).all()


def test_coasting_ends_after_the_misses_of_the_panel() -> None:
    person = walker(300, 300, 90)
    assert GNNTracker()(film([hidden(person, slice(30, 52))])).boxes.shape[1] == 1
    tracks = GNNTracker()(film([hidden(person, slice(30, 53))]))
    assert tracks.boxes.shape[1] == 2
    assert tracks.valid[0].sum(-1).tolist() == [30, 37]
    # Frames without detection are no misses.
    observed = torch.ones(90, dtype=torch.bool)
    observed[30:53] = False
    tracks = GNNTracker()(film([person]), observed)
    assert tracks.boxes.shape[1] == 1
    assert tracks.valid.all()
    assert tracks.matched[0, 0].sum() == 67


def test_valid_from_first_to_last_detection_and_not_beyond() -> None:
    tracks = GNNTracker()(film([hidden(hidden(walker(100, 400, 50), slice(0, 8)), slice(40, 50))]))
    assert torch.nonzero(tracks.valid[0, 0]).squeeze(-1).tolist() == list(range(8, 40))
    assert (tracks.boxes[0, 0][~tracks.valid[0, 0]] == 0).all()


def test_unobserved_frames_at_the_ends_belong_to_the_person_next_to_them() -> None:
    observed = torch.arange(30) % 4 == 2
    person = walker(100, 300, 30)
    tracks = GNNTracker()(film([person]), observed)
    assert tracks.valid.all()
    assert (overlap(tracks, 0, person) > 0.8).all()
    gone = GNNTracker()(film([hidden(person, slice(20, 30))]), observed)  # seen in 18, looked in vain in 22
    assert torch.nonzero(gone.valid[0, 0]).squeeze(-1).tolist() == list(range(22))


def test_unobserved_frames_are_not_read() -> None:
    observed = torch.arange(40) % 2 == 0
    detections = film([walker(100, 300, 40)])
    spoilt = Detections(*(field.clone() for field in detections))
    spoilt.boxes[:, 1::2] += 500.0
    for a, b in zip(GNNTracker()(detections, observed), GNNTracker()(spoilt, observed), strict=True):
        assert torch.equal(a, b)


def test_fast_small_person_whose_boxes_do_not_overlap() -> None:
    runner = walker(50, 950, 40, height=50)  # 23 px a frame, the box is 20 px wide
    assert box_iou(runner[0], runner[1]) == 0
    tracks = GNNTracker()(film([runner], jitter=0.5))
    assert tracks.boxes.shape[1] == 1
    assert tracks.valid.all()


def test_someone_new_far_away_is_not_the_one_who_left() -> None:
    leaves, enters = hidden(walker(100, 160, 60), slice(20, 60)), hidden(walker(900, 800, 60), slice(0, 28))
    tracks = GNNTracker()(film([leaves, enters]))
    assert tracks.valid[0].sum(-1).tolist() == [20, 32]


def test_flicker_and_weak_detections_are_not_people() -> None:
    person = walker(300, 500, 60)
    flash = hidden(hidden(walker(900, 900, 60), slice(0, 20)), slice(23, 60))
    weak = film([walker(50, 50, 60, height=80)], score=0.32)
    both = film([person, flash])
    detections = Detections(*(torch.cat([a, b], dim=2) for a, b in zip(both, weak, strict=True)))
    tracks = GNNTracker()(detections)
    assert tracks.boxes.shape[1] == 1
    assert (overlap(tracks, 0, person) > 0.9).all()
    assert GNNTracker(min_hits=3)(detections).boxes.shape[1] == 2
    assert GNNTracker(start_score=0.3)(detections).boxes.shape[1] == 2


def test_what_is_doubted_most_of_the_time_is_nobody() -> None:
    person, chair = walker(300, 500, 60), walker(900, 900, 60)
    seen, doubted = film([person], seed=1), film([chair], score=0.35)
    doubted.scores[0, :4] += 0.3  # four times, it is taken for a person
    detections = Detections(*(torch.cat([a, b], dim=2) for a, b in zip(seen, doubted, strict=True)))
    tracks = GNNTracker()(detections)
    assert tracks.boxes.shape[1] == 1
    assert (overlap(tracks, 0, person) > 0.9).all()
    # A person is found that often in a second or less, and then followed however weakly.
    doubted.scores[0, :5] = 0.65
    detections = Detections(*(torch.cat([a, b], dim=2) for a, b in zip(seen, doubted, strict=True)))
    tracks = GNNTracker()(detections)
    assert tracks.boxes.shape[1] == 2
    assert bool(tracks.valid.all())


@pytest.mark.parametrize(("apart", "people"), [(0.35, 1), (0.6, 2)])
def test_boxes_that_overlap_much_start_one_track(apart: float, people: int) -> None:
    """Moved sideways by this part of their width, they overlap by (1 - apart) / (1 + apart): 0.48 and 0.25."""
    one = walker(300, 300, 30)
    other = one + torch.tensor([1.0, 0, 1, 0]) * apart * (one[:, 2:3] - one[:, :1])
    best, second = film([one]), film([other], score=0.6)
    detections = Detections(*(torch.cat([a, b], dim=2) for a, b in zip(best, second, strict=True)))
    assert GNNTracker()(detections).boxes.shape[1] == people


def test_lost_person_is_not_found_in_furniture() -> None:
    person = walker(300, 300, 50)
    chair = film([hidden(walker(360, 360, 50, height=130), slice(0, 20))], score=0.35)
    seen = film([hidden(person, slice(20, 30))])
    detections = Detections(*(torch.cat([a, b], dim=2) for a, b in zip(seen, chair, strict=True)))
    tracks = GNNTracker()(detections)
    assert tracks.boxes.shape[1] == 1
    assert (overlap(tracks, 0, person) > 0.85).all()
    assert not tracks.matched[0, 0, 20:30].any()


def test_weak_detections_continue_a_track() -> None:
    person = walker(300, 500, 40)
    detections = film([person])
    detections.scores[:, 10:] = 0.35
    assert GNNTracker()(detections).matched.all()


def test_a_detection_of_just_the_faint_score_continues_a_track() -> None:
    detections = film([walker(300, 500, 40)])
    detections.scores[:, 10:] = 0.25
    assert GNNTracker(faint_score=0.25)(detections).matched.all()
    assert not GNNTracker(faint_score=0.26)(detections).matched[..., 10:].any()


@pytest.mark.parametrize(("gone", "people"), [(4, 1), (5, 2)])
def test_a_faint_detection_does_not_continue_a_track_that_was_lost(gone: int, people: int) -> None:
    """A person leaves, a mark on the wall is once taken for a person, and later another person stands there."""
    person, mark = walker(300, 300, 60), walker(300, 300, 60, height=380)
    seen = film([hidden(person, slice(20, 60))])
    faint = film([hidden(hidden(mark, slice(0, 20 + gone)), slice(21 + gone, 60))], score=0.2)
    other = film([hidden(walker(330, 330, 60), slice(0, 47))])
    parts = zip(seen, faint, other, strict=True)
    tracks = GNNTracker()(Detections(*(torch.cat(part, dim=2) for part in parts)))
    assert bool(tracks.matched[0, :, 20 + gone].any()) == (people == 1)
    assert tracks.boxes.shape[1] == people


def test_one_person_detected_twice_is_one_person() -> None:
    person = walker(200, 500, 40)
    upper = person.clone()
    upper[:, 3] = person[:, 1] + 110.0  # head and trunk
    wide = xyxy_to_center(person) * torch.tensor([1.0, 1.0, 1.2, 1.05], dtype=torch.float64)
    twice = film([person, upper, center_to_xyxy(wide)], shuffle=False)
    twice.scores[..., 1:] -= 0.2
    tracks = GNNTracker()(twice)
    assert tracks.boxes.shape[1] == 1
    assert tracks.matched.all()
    assert (overlap(tracks, 0, person) > 0.9).all()


def test_confirmation_is_m_of_n_observed_frames() -> None:
    person = walker(300, 300, 30)
    sparse = person.clone() * torch.nan
    for t in (3, 8, 13, 18, 23):
        sparse[t] = person[t]
    settings = {"min_hits": 1, "confirm_hits": 2}
    assert GNNTracker(confirm_window=5, **settings)(film([sparse])).boxes.shape[1] == 0
    assert GNNTracker(confirm_window=6, **settings)(film([sparse])).boxes.shape[1] == 1


def test_at_most_so_many_people_at_a_time_the_best_ones() -> None:
    crowd = [walker(100.0 + 150 * i, 110.0 + 150 * i, 40) for i in range(5)]
    crowd[1], crowd[3] = hidden(crowd[1], slice(15, 40)), hidden(crowd[3], slice(0, 25))
    assert GNNTracker()(film(crowd)).boxes.shape[1] == 5
    tracks = GNNTracker(max_tracks=3)(film(crowd))
    assert tracks.valid[0].sum(0).max() == 3
    assert tracks.valid[0].all(-1).sum() == 3
    # The two short ones fit one after the other where there is room for four.
    assert GNNTracker(max_tracks=4)(film(crowd)).valid[0].sum(-1).tolist().count(15) == 2


def test_order_is_first_frame_then_size() -> None:
    small, large = walker(200, 220, 30, height=150), walker(600, 620, 30, height=250)
    late = hidden(walker(900, 900, 30, height=400), slice(0, 4))
    for seed in range(4):
        tracks = GNNTracker()(film([small, late, large], seed=seed))
        for person, truth in enumerate((large, small, walker(900, 900, 30, height=400))):
            assert (overlap(tracks, person, truth)[4:] > 0.9).all()


def test_only_people_of_some_size_and_score_count() -> None:
    detections = film([walker(200, 220, 30)])
    other = detections._replace(labels=torch.ones_like(detections.labels))
    assert GNNTracker()(other).boxes.shape == (1, 0, 30, 4)
    assert GNNTracker(min_box_px=90.0)(detections).boxes.shape[1] == 0  # 80 px wide
    assert GNNTracker(detection_threshold=0.95)(detections).boxes.shape[1] == 0


def test_short_clips_and_no_detections() -> None:
    assert GNNTracker()(film([walker(100, 120, 3)])).valid.tolist() == [[[True, True, True]]]
    nothing = Detections(
        torch.zeros(2, 4, 0, 4),
        torch.zeros(2, 4, 0),
        torch.zeros(2, 4, 0, dtype=torch.int64),
        torch.zeros(2, 4, 0) > 0,
    )
    tracks = GNNTracker()(nothing)
    assert tracks.boxes.shape == (2, 0, 4, 4)
    assert tracks.valid.shape == tracks.matched.shape == (2, 0, 4)


def test_pixels_do_not_matter() -> None:
    detections = film([walker(100, 500, 40), walker(520, 90, 40)])
    double = detections._replace(boxes=detections.boxes * 2)
    once, twice = GNNTracker()(detections), GNNTracker()(double)
    assert torch.equal(once.matched, twice.matched)
    torch.testing.assert_close(twice.boxes, once.boxes * 2, rtol=1e-9, atol=1e-6)


def test_smoothed_boxes_are_nearer_the_truth_than_the_detections() -> None:
    truth = walker(100, 500, 80)
    detections = film([truth], jitter=4.0)
    tracks = GNNTracker()(detections)
    raw = (detections.boxes[0, :, 0] - truth).square().mean()
    assert (tracks.boxes[0, 0] - truth).square().mean() < 0.8 * raw


class Largest(TorchDispatchMode):
    """Notes the largest number of elements of what operations give."""

    elements = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        if isinstance(out, Tensor):
            self.elements = max(self.elements, out.numel())
        return out


def test_memory_is_that_of_people_not_of_all_that_was_taken_for_one() -> None:
    """A detection that is not seen again is forgotten: rows for all would make memory grow with the square of time."""
    frames, flickers = 200, 10
    generator = torch.Generator().manual_seed(0)
    middle = 1e5 * torch.rand(frames, flickers, 2, generator=generator, dtype=torch.float64)
    short = [center_to_xyxy(torch.cat([at, 0 * at + 100.0], dim=-1)) for at in middle.unbind(1)]
    detections = film([walker(100, 500, frames), *short])
    with Largest() as largest:
        tracks = GNNTracker()(detections)
    assert tracks.boxes.shape[1] == 1
    assert largest.elements < 20 * frames * (flickers + 1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_tracks": 0}, "max_tracks"),
        ({"min_hits": 0}, "min_hits"),
        ({"confirm_hits": 6}, "confirm_hits: got 6 of 5"),
        ({"confirm_hits": 0}, "confirm_hits: got 0"),
        ({"confirm_window": 5.5}, "confirm_window: got 5.5"),
        ({"delete_misses": 24}, "delete_misses: got 24 of 23"),
        ({"assignment_threshold": 0.0}, "assignment_threshold"),
        ({"detection_threshold": 1.5}, "detection_threshold"),
        ({"min_box_px": -1.0}, "min_box_px"),
        ({"process_noise": float("nan")}, "process_noise"),
        ({"reach": 0.0}, "reach"),
    ],
)
def test_refuses_settings(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        GNNTracker(**settings)


@pytest.mark.parametrize("hits", [1, 2, 9])
@pytest.mark.parametrize("lost", [0, 3])
def test_the_gate_is_that_of_a_kalman_filter_in_numpy(hits: int, lost: int) -> None:
    """A detection is the person's up to d^2 = 150 of the innovation, whose variance is that of 2 x 2 matrices."""
    q, r, f = 2e-3, 5e-4, np.array([[1.0, 1.0], [0.0, 1.0]])
    noise = q * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])  # white acceleration, a step of one frame
    state, covariance = np.array([300.0, 0.0]), np.diag([r, 0.04**2])
    for t in range(1, hits + lost):
        state, covariance = f @ state, f @ covariance @ f.T + noise
        if t < hits:
            gain = covariance[:, 0] / (covariance[0, 0] + r)
            state = state + gain * (300.0 + 6 * t - state[0])
            covariance = covariance - np.outer(gain, covariance[0])
    state, covariance = f @ state, f @ covariance @ f.T + noise
    reach = 400.0 * math.sqrt(20.0 * (covariance[0, 0] + r))  # the box is 400 px high
    settings: dict[str, Any] = {
        "process_noise": q, "measurement_noise": r, "initial_speed": 0.04, "assignment_threshold": 20.0,
        "confirm_hits": 1, "min_hits": 1, "weak_iou": 1.0, "reach": 9.0,
    }  # fmt: skip
    frames = hits + lost + 1
    for share, people in ((0.99, 1), (1.01, 2)):
        u = torch.arange(frames, dtype=torch.float64) * 6 + 300.0
        u[-1] = state[0] + share * reach
        boxes = center_to_xyxy(torch.stack([u, 0 * u + 300, 0 * u + 20.0, 0 * u + 400.0], dim=-1))
        boxes[hits : hits + lost] = torch.nan
        tracks = GNNTracker(**settings)(film([boxes], jitter=0.0))
        assert tracks.boxes.shape[1] == people, (share, reach)


def test_a_second_box_of_one_person_starts_no_track() -> None:
    """Boxes that share more than 0.4 of their union, or 0.9 of the worse one, show one person."""
    best = torch.tensor([100.0, 100.0, 200.0, 300.0], dtype=torch.float64).repeat(8, 1)

    def people(second: list[float]) -> int:
        worse = torch.tensor(second, dtype=torch.float64).repeat(8, 1)
        one, two = film([best], jitter=0.0), film([worse], jitter=0.0, score=0.6)
        detections = Detections(*(torch.cat([a, b], dim=2) for a, b in zip(one, two, strict=True)))
        return int(GNNTracker()(detections).boxes.shape[1])

    # Moved along by s of 200 px they share (200 - s) / (200 + s): 0.4 at 85.7.
    assert people([100.0, 184.0, 200.0, 384.0]) == 1
    assert people([100.0, 187.0, 200.0, 387.0]) == 2
    # 60 px wide and 60 high, partly outside: the share inside is what it is of its own area, not of the better one's.
    assert people([145.0, 150.0, 205.0, 210.0]) == 1
    assert people([147.0, 150.0, 207.0, 210.0]) == 2


# ---- real clips ------------------------------------------------------------------------------------------


def detect(clip: Path, network: Path) -> tuple[Detections, Tensor]:
    """People in every 2nd frame of a clip by RTMDet-nano through ONNX Runtime, and which frames these are."""
    import cv2
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(network), options, providers=["CPUExecutionProvider"])
    mean, std, side = np.array([103.53, 116.28, 123.675]), np.array([57.375, 57.12, 58.395]), 320
    capture, found = cv2.VideoCapture(str(clip)), []
    while True:
        more, image = capture.read()
        if not more:
            break
        found.append(np.zeros((100, 5), np.float32))
        if len(found) % 2 == 0:
            continue
        scale = min(side / image.shape[0], side / image.shape[1])
        height, width = (int(length * scale + 0.5) for length in image.shape[:2])
        padded = np.full((side, side, 3), 114, np.uint8)
        padded[:height, :width] = cv2.resize(image, (width, height))
        planes = ((padded - mean) / std).transpose(2, 0, 1)[None].astype(np.float32)
        boxes = session.run(["dets"], {"input": planes})[0][0][:100]
        boxes[:, :4] /= np.tile([width / image.shape[1], height / image.shape[0]], 2)
        found[-1][: len(boxes)] = boxes
    table = torch.from_numpy(np.stack(found))[None]
    scores = table[..., 4]
    labels = torch.zeros(scores.shape, dtype=torch.int64)
    return Detections(table[..., :4], scores, labels, scores > 0), torch.arange(len(found)) % 2 == 0


@pytest.mark.parametrize(
    ("name", "frames", "visible"),
    [
        ("drink_standing_1person_30fps.avi", 103, 103),
        ("juggle_kick_1person_24fps.mp4", 247, 247),
        ("walk_across_1person_30fps.mp4", 145, 141),  # then the last foot has left the picture
        ("walk_away_1person_16fps.gif", 71, 71),
    ],
)
def test_one_person_is_one_track(shared_data: Path, name: str, frames: int, visible: int) -> None:
    detections, observed = detect(
        shared_data / "video" / name, shared_data / "weights" / "rtmdet_nano_person.onnx"
    )
    tracks = GNNTracker()(detections, observed)
    assert tracks.valid.shape == (1, 1, frames)
    assert tracks.valid[0, 0, :visible].float().mean() >= 0.95
    assert tracks.valid[0, 0, visible:].sum() == 0


def test_two_people_who_hug_keep_their_ids(shared_data: Path) -> None:
    network = shared_data / "weights" / "rtmdet_nano_person.onnx"
    detections, observed = detect(shared_data / "video" / "hug_2people_28fps.mp4", network)
    tracks = GNNTracker()(detections, observed)
    assert tracks.valid.shape == (1, 2, 72)
    assert tracks.valid.all()
    # Grey shirt stays left, black jacket stays right; nobody jumps, however closely they hold each other.
    center = xyxy_to_center(tracks.boxes[0])[..., 0]
    assert (center[0] < center[1]).all()
    assert center.diff(dim=-1).abs().max() < 40.0

    # Hide either of them for 20 frames, from any moment on: the ids stay.
    for person in (0, 1):
        for start in range(4, 48, 8):
            cut = detections.valid.clone()
            for t in range(start, start + 20):
                iou = box_iou(tracks.boxes[0, :, None, t], detections.boxes[0, t])
                cut[0, t] &= (iou.argmax(0) != person) | (iou.amax(0) < 0.3)
            again = GNNTracker()(detections._replace(valid=cut), observed)
            assert again.boxes.shape[1] == 2
            u = xyxy_to_center(again.boxes[0, :, [0, 71]])[..., 0]
            assert (u[0] < u[1]).all() or (u[0] > u[1]).all()
