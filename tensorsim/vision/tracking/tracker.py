"""Global nearest neighbour (GNN) tracking of people through whole clips.

The state of a track is its box (centre u, centre v, width, height) and their velocities, 8 numbers, moving
with constant velocity. Noise is stated in sizes of the box (its longer side), so that pixels do not matter,
and is the same for the four coordinates, so that they share one 2 x 2 covariance. Frame by frame: Kalman prediction,
Hungarian assignment of detections to tracks, Kalman update, confirmation (M of N), deletion. As the whole clip is
known, the boxes returned are then smoothed in both directions.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.errors import (
    TensorsimError,
    check_count,
    check_finite,
    check_floating,
    check_positive,
    check_rank,
    check_size,
)
from tensorsim.geometry.boxes import box_area, box_intersection, box_iou, center_to_xyxy, xyxy_to_center
from tensorsim.types import Detections, Tracks
from tensorsim.vision.smoothing.kalman import (
    KalmanState,
    constant_velocity_predict,
    kalman_update,
    smooth_constant_velocity,
)
from tensorsim.vision.tracking.assignment import assign
from tensorsim.vision.tracking.joining import contained, join_tracks


class Living(NamedTuple):
    """The n tracks that may still be matched.

    Attributes:
        rows: (n,) number of each among all tracks.
        box: (n, 4) centre and sides, and their velocities per frame; variances (n, 1).
        history: (n, window) bool, hit or not in the observed frames, newest first.
        age: (n,) observed frames since the start.
    """

    rows: Tensor
    box: KalmanState
    history: Tensor
    age: Tensor


def joined(living: Living, alive: Tensor, start: Living) -> Living:
    """The tracks that are still ``alive`` (n,), bool, and those that begin."""
    return Living(
        torch.cat([living.rows[alive], start.rows]),
        KalmanState(
            torch.cat([living.box.position[alive], start.box.position]),
            torch.cat([living.box.velocity[alive], start.box.velocity]),
            torch.cat([living.box.p00[alive], start.box.p00]),
            torch.cat([living.box.p01[alive], start.box.p01]),
            torch.cat([living.box.p11[alive], start.box.p11]),
        ),
        torch.cat([living.history[alive], start.history]),
        torch.cat([living.age[alive], start.age]),
    )


class GNNTracker(nn.Module):
    """Tracks people through clips: which detection belongs to whom, and a box for every frame in between.

    Input: :class:`Detections` with ``boxes`` (B, T, K, 4), the rest (B, T, K), and ``observed`` (T,) or (B,
    T) bool, false in frames in which the detector was not run: there tracks are predicted and no miss is counted
    (None: it was run in every frame). Output: :class:`Tracks`, P the largest number of people in a clip,
    possibly 0; in each clip ordered by first frame, then larger first. Association runs on the CPU in float64
    whatever the device; the stage is not differentiable.

    1. Detections are used that are people (label 0), score at least ``detection_threshold`` and measure at least
       ``min_box_px`` in width and height.
    2. Hungarian assignment in two passes (as in ByteTrack, Zhang et al., ECCV 2022), first of detections of at least
       ``start_score``, then of the others to the tracks that are left. The cost of a pair is ``(1 - IoU) + d^2 /
       assignment_threshold``, d the Mahalanobis distance of the detection to the predicted box, so that the distance
       decides where boxes do not overlap, plus the time since the last match as a share of ``delete_window``, as the
       covariance of a lost track allows almost anything, plus ``1 - score``. A pair needs ``d^2 <=
       assignment_threshold``, centres within ``reach`` sizes and areas within a factor of 4; in the second pass also
       an IoU of at least ``weak_iou``, so that a lost person is not found in a piece of furniture, and a detection
       that does not duplicate a matched one. In that pass a confirmed track with a match in the last
       ``confirm_window`` observed frames may take a detection of at least ``faint_score`` with any d, also if instead
       of the IoU one box covers half of the other, unless the detection and a matched one overlap by more than a
       fifth of the smaller box: somebody who lies down is detected poorly, in a box of another shape. Any such pair is
       better than none.
    3. An unmatched detection of at least ``start_score`` starts a track, unless it overlaps a better or
       matched one by an IoU above ``duplicate_iou``, or with more than ``duplicate_part`` of its own area:
       one person detected twice.
    4. A track is confirmed by ``confirm_hits`` within ``confirm_window`` observed frames (else dropped) and
       ends after ``delete_misses`` within ``delete_window``.
    5. Confirmed tracks that follow one person, at the same time or one after the other, are joined:
       :func:`~tensorsim.vision.tracking.joining.join_tracks`.
    6. People are the tracks with at least ``min_hits`` detections of ``start_score`` or more (in a clip with fewer
       observed frames: one in each), as tracks of low scores are mostly false. If there are more than ``max_tracks``
       at a time, the best by sum of scores are kept.
    7. A person is valid from first to last detection, gaps included, and in unobserved frames next to these.
       The boxes are Rauch-Tung-Striebel smoothed; they may reach beyond the image a little.

    Args:
        max_tracks: people at a time.
        confirm_hits: M of the M-of-N confirmation.
        confirm_window: N of it, observed frames; also how recent the last match must be for ``faint_score``.
        delete_misses: P of the P-of-R deletion.
        delete_window: R of it, observed frames.
        assignment_threshold: largest squared Mahalanobis distance of a pair.
        detection_threshold: smallest score of a detection that counts.
        min_box_px: smallest width and height of a detection that counts.
        start_score: score from which a detection starts a track, and is matched without overlap.
        weak_iou: IoU with the predicted box that a detection below ``start_score`` needs.
        faint_score: smallest score of a detection that continues a confirmed, recently matched track; below
            ``detection_threshold`` it counts for nothing else.
        min_hits: detections of at least ``start_score`` from which a confirmed track is a person.
        process_noise: density of the acceleration noise, size^2 / frame^3.
        measurement_noise: variance of a detected coordinate, size^2.
        initial_speed: prior standard deviation of the velocities, sizes / frame.
        reach: largest distance of a detection from the predicted centre, in sizes of the box.
        duplicate_iou: IoU with a better detection above which a detection starts no track.
        duplicate_part: share of its area inside a better detection above which a detection starts no track.

    Raises:
        TensorsimError: settings out of range; shapes that do not fit; boxes or scores not finite where valid.
    """

    def __init__(
        self,
        max_tracks: int = 5,
        confirm_hits: int = 2,
        confirm_window: int = 5,
        delete_misses: int = 23,
        delete_window: int = 23,
        assignment_threshold: float = 150.0,
        detection_threshold: float = 0.3,
        min_box_px: float = 5.0,
        start_score: float = 0.5,
        weak_iou: float = 0.3,
        faint_score: float = 0.2,
        min_hits: int = 5,
        process_noise: float = 1e-3,
        measurement_noise: float = 4e-4,
        initial_speed: float = 0.05,
        reach: float = 1.0,
        duplicate_iou: float = 0.4,
        duplicate_part: float = 0.9,
    ) -> None:
        super().__init__()
        for name, count in (
            ("max_tracks", max_tracks),
            ("min_hits", min_hits),
            ("confirm_hits", confirm_hits),
            ("confirm_window", confirm_window),
            ("delete_misses", delete_misses),
            ("delete_window", delete_window),
        ):
            check_count(count, f"GNNTracker.{name}")
        _check_window("confirm_hits", confirm_hits, confirm_window)
        _check_window("delete_misses", delete_misses, delete_window)
        check_positive(assignment_threshold, "GNNTracker.assignment_threshold")
        check_positive(min_box_px, "GNNTracker.min_box_px")
        check_positive(process_noise, "GNNTracker.process_noise")
        check_positive(measurement_noise, "GNNTracker.measurement_noise")
        check_positive(initial_speed, "GNNTracker.initial_speed")
        check_positive(reach, "GNNTracker.reach")
        for name, share in (
            ("detection_threshold", detection_threshold),
            ("start_score", start_score),
            ("weak_iou", weak_iou),
            ("faint_score", faint_score),
            ("duplicate_iou", duplicate_iou),
            ("duplicate_part", duplicate_part),
        ):
            if not 0.0 <= share <= 1.0:
                raise TensorsimError(f"GNNTracker.{name}: got {share}, expected between 0 and 1")
        self.max_tracks = max_tracks
        self.confirm_hits = confirm_hits
        self.confirm_window = confirm_window
        self.delete_misses = delete_misses
        self.delete_window = delete_window
        self.assignment_threshold = float(assignment_threshold)
        self.detection_threshold = float(detection_threshold)
        self.min_box_px = float(min_box_px)
        self.start_score = max(float(start_score), float(detection_threshold))
        self.weak_iou = float(weak_iou)
        # A detection that counts never has a lower score than one that only continues a track.
        self.faint_score = min(float(faint_score), float(detection_threshold))
        self.min_hits = min_hits
        self.process_noise = float(process_noise)
        self.measurement_noise = float(measurement_noise)
        self.initial_speed = float(initial_speed)
        self.reach = float(reach)
        self.duplicate_iou = float(duplicate_iou)
        self.duplicate_part = float(duplicate_part)

    def forward(self, detections: Detections, observed: Tensor | None = None) -> Tracks:
        """People of each clip, padded to one count: see the class."""
        _check(detections, observed)
        device, cpu = detections.boxes.device, torch.device("cpu")
        clips, frames = detections.boxes.shape[0], detections.boxes.shape[1]
        if observed is None:
            observed = torch.ones(frames, dtype=torch.bool)
        looked = observed.to(cpu).expand(clips, frames)
        real = detections.valid.to(cpu)
        boxes = torch.where(real.unsqueeze(-1), detections.boxes.detach().to(cpu, torch.float64), 0.0)
        scores = torch.where(real, detections.scores.detach().to(cpu, torch.float64), 0.0)
        usable = (
            real
            & (detections.labels == 0).to(cpu)
            & (scores >= self.faint_score)
            & (boxes[..., 2:] - boxes[..., :2] >= self.min_box_px).all(-1)
            & looked.unsqueeze(-1)
        )
        tables: list[Tensor] = []
        for b in range(clips):
            table = self._associate(boxes[b], scores[b], usable[b], looked[b])
            table = join_tracks(table, boxes[b], scores[b], looked[b], self.start_score, self.delete_window)
            tables.append(self._people(table, boxes[b], scores[b], int(looked[b].sum())))
        people = max([table.shape[0] for table in tables])
        which = torch.full((clips, people, frames), -1, dtype=torch.int64)
        for b, table in enumerate(tables):
            which[b, : table.shape[0]] = table

        matched = which >= 0
        index = which.clamp(min=0).transpose(1, 2).unsqueeze(-1).expand(clips, frames, people, 4)
        measured = xyxy_to_center(boxes.gather(2, index).transpose(1, 2))
        smooth = smooth_constant_velocity(
            measured, matched, self._process_noise(), self._measurement_noise(), self.initial_speed, 1.0
        )
        smooth = torch.cat([smooth[..., :2], smooth[..., 2:].clamp(min=self.min_box_px)], dim=-1)
        valid = _presence(matched, looked)
        tracked = center_to_xyxy(smooth) * valid.unsqueeze(-1)
        return Tracks(tracked.to(device, detections.boxes.dtype), valid.to(device), matched.to(device))

    def _associate(self, boxes: Tensor, scores: Tensor, usable: Tensor, looked: Tensor) -> Tensor:
        """Which detection each confirmed track of one clip has in every frame (I, T), -1 for none."""
        frames = boxes.shape[0]
        confirmed = torch.zeros(0, dtype=torch.bool)
        living = self._start(torch.zeros(0, dtype=torch.int64), boxes.new_zeros(0, 4))
        # Which track was matched to which detection in which frame, over all frames.
        rows, times, found = [living.rows], [living.rows], [living.rows]
        for t in range(frames):
            predicted = constant_velocity_predict(living.box, self._process_noise(), 1.0)
            living = Living(living.rows, predicted, living.history, living.age)
            if not bool(looked[t]):
                continue
            best_first = scores[t].argsort(descending=True, stable=True)
            index = best_first[usable[t][best_first]]
            box, strong = boxes[t][index], scores[t][index] >= self.start_score
            column = self._assign(living, box, scores[t][index], confirmed[living.rows])
            hit = column >= 0
            matched = living.rows[hit]
            living = self._correct(living, xyxy_to_center(box), column)

            recent_hits = living.history[:, : self.confirm_window].sum(-1)
            steady = confirmed[living.rows] | (recent_hits >= self.confirm_hits)
            confirmed[living.rows] = steady
            alive = self._alive(living, steady)

            new = self._newcomers(box, strong, column[hit])
            born = torch.arange(new.shape[0]) + confirmed.shape[0]
            at_once = torch.full((new.shape[0],), self.confirm_hits == 1, dtype=torch.bool)
            confirmed = torch.cat([confirmed, at_once])
            rows.append(torch.cat([matched, born]))
            times.append(torch.full_like(rows[-1], t))
            found.append(index[torch.cat([column[hit], new])])
            start = self._start(born, xyxy_to_center(box[new]))
            living = joined(living, alive, start)
        row = torch.cat(rows)
        kept = confirmed[row]
        table = torch.full((int(confirmed.sum()), frames), -1, dtype=torch.int64)
        table[(confirmed.cumsum(0) - 1)[row[kept]], torch.cat(times)[kept]] = torch.cat(found)[kept]
        return table

    def _alive(self, living: Living, confirmed: Tensor) -> Tensor:
        """(n,) bool, which tracks continue."""
        misses = living.age.clamp(max=self.delete_window) - living.history[:, : self.delete_window].sum(-1)
        return torch.where(confirmed, misses < self.delete_misses, living.age < self.confirm_window)

    def _process_noise(self) -> Tensor:
        return torch.full([1], self.process_noise, dtype=torch.float64)

    def _measurement_noise(self) -> Tensor:
        return torch.full([1], self.measurement_noise, dtype=torch.float64)

    def _start(self, rows: Tensor, z: Tensor) -> Living:
        """Tracks that begin with boxes ``z``."""
        p00 = torch.full_like(z[:, :1], self.measurement_noise)
        p11 = torch.full_like(z[:, :1], self.initial_speed**2)
        history = torch.zeros(z.shape[0], max(self.confirm_window, self.delete_window), dtype=torch.bool)
        history[:, 0] = True
        state = KalmanState(z, torch.zeros_like(z), p00, torch.zeros_like(p00), p11)
        return Living(rows, state, history, torch.ones_like(rows))

    def _correct(self, s: Living, z: Tensor, column: Tensor) -> Living:
        """The Kalman update of matched tracks, and one more hit or miss for all."""
        hit = column >= 0
        measured = torch.zeros_like(s.box.position)
        measured[hit] = z[column[hit]]
        return Living(
            s.rows,
            kalman_update(s.box, measured, self._measurement_noise(), hit.unsqueeze(-1)),
            torch.cat([hit.unsqueeze(-1), s.history[:, :-1]], dim=-1),
            s.age + 1,
        )

    def _assign(self, s: Living, box: Tensor, score: Tensor, confirmed: Tensor) -> Tensor:
        """Detection of each living track among the boxes of a frame (n,), -1 for none."""
        x = s.box.position
        size = x[:, 2:].amax(-1).clamp(min=self.min_box_px)
        offset = (xyxy_to_center(box).unsqueeze(0) - x.unsqueeze(1)) / size[:, None, None]
        distance = offset.square().sum(-1) / (s.box.p00 + self.measurement_noise)
        x = torch.cat([x[:, :2], x[:, 2:].clamp(min=self.min_box_px)], dim=-1)
        predicted = center_to_xyxy(x)[:, None]
        iou = box_iou(predicted, box[None])
        ratio = box_area(box)[None] / box_area(predicted)
        near = torch.linalg.vector_norm(offset[..., :2], dim=-1) <= self.reach
        near = near & (ratio >= 0.25) & (ratio <= 4.0)
        lost = s.history.to(torch.uint8).argmax(-1).to(iou.dtype) / self.delete_window
        cost = 1.0 - iou + distance / self.assignment_threshold + lost[:, None] + (1.0 - score)
        column = assign(
            cost, near & (distance <= self.assignment_threshold) & (score >= self.start_score), 5.0
        )
        # Second association: the remaining tracks and detections, without those that show a person already matched.
        left, taken = column < 0, column[column >= 0]
        free = ~self._double(box)[taken].any(0)
        free[taken] = False
        fair = (score >= self.detection_threshold) & (distance <= self.assignment_threshold)
        overlap = iou >= self.weak_iou
        alone = ~(contained(box[taken][:, None], box[None]) > 0.2).any(0)
        recent = s.history[:, : self.confirm_window].any(-1)
        alike = (confirmed & recent)[:, None] & alone & (overlap | (contained(predicted, box[None]) >= 0.5))
        second = assign(cost, left[:, None] & free & near & ((fair & overlap) | alike), 5.0)
        return torch.where(left, second, column)

    def _double(self, box: Tensor) -> Tensor:
        """Whether box j (n,) shows what box i (n,) does: (n, n)."""
        part = box_intersection(box[:, None], box[None]) / box_area(box)
        return (box_iou(box[:, None], box[None]) > self.duplicate_iou) | (part > self.duplicate_part)

    def _newcomers(self, box: Tensor, strong: Tensor, taken: Tensor) -> Tensor:
        """Which detections of a frame, best first, start tracks."""
        double = self._double(box)
        blocked = ~strong | double[taken].any(0)
        new: list[int] = []
        for j in range(box.shape[0]):
            if not bool(blocked[j]):
                new.append(j)
                blocked = blocked | double[j]
        return torch.tensor(new, dtype=torch.int64)

    def _people(self, table: Tensor, boxes: Tensor, scores: Tensor, looks: int) -> Tensor:
        """The rows of confirmed tracks that are people, in order of appearance."""
        hit = table >= 0
        detection = table.clamp(min=0).t()
        found = scores.gather(1, detection).t() * hit
        score, strong = found.sum(-1), (found >= self.start_score) & hit
        area = (boxes[..., 2:] - boxes[..., :2]).prod(-1)
        mean_area = (area.gather(1, detection).t() * hit).sum(-1) / hit.sum(-1)
        crowd = torch.zeros(table.shape[1], dtype=torch.int64)
        kept: list[int] = []
        best_first: list[int] = score.argsort(descending=True, stable=True).tolist()
        for i in best_first:
            seen: list[int] = torch.nonzero(hit[i]).squeeze(-1).tolist()
            if int(strong[i].sum()) >= min(self.min_hits, looks):
                span = crowd[seen[0] : seen[-1] + 1]
                if int(span.max()) < self.max_tracks:
                    span += 1
                    kept.append(i)
        rows = torch.tensor(kept, dtype=torch.int64)
        rows = rows[mean_area[rows].argsort(descending=True, stable=True)]
        return table[rows[hit[rows].to(torch.uint8).argmax(-1).argsort(stable=True)]]


def _presence(matched: Tensor, looked: Tensor) -> Tensor:
    """Frames (B, P, T) of presence: from the first match to the last, and unobserved frames next to these."""
    looks = looked.to(torch.int64).unsqueeze(1).expand_as(matched)
    until = looks.cumsum(-1)
    before = until - looks
    hits = matched.to(torch.int64)
    first, last = hits.argmax(-1, keepdim=True), hits.cumsum(-1).argmax(-1, keepdim=True)
    present = (before >= before.gather(-1, first)) & (until <= until.gather(-1, last))
    return present & matched.any(-1, keepdim=True)


def _check_window(name: str, count: int, window: int) -> None:
    if count > window:
        raise TensorsimError(f"GNNTracker.{name}: got {count} of {window}, expected M of N with M <= N")


def _check(detections: Detections, observed: Tensor | None) -> None:
    """Refuse detections that do not fit together."""
    boxes, layout = detections.boxes, "(B, T, K, 4)"
    check_floating(boxes, "detections.boxes")
    check_rank(boxes, 4, "detections.boxes", layout)
    check_size(boxes, 3, 4, "detections.boxes", layout)
    if boxes.shape[0] == 0 or boxes.shape[1] == 0:
        raise TensorsimError(
            f"detections.boxes: got shape {list(boxes.shape)}, expected at least one clip and frame"
        )
    shape, scores, labels = boxes.shape[:3], detections.scores, detections.labels
    check_floating(scores, "detections.scores")
    if scores.shape != shape or labels.shape != shape or detections.valid.shape != shape:
        raise TensorsimError(
            f"detections: got scores {list(scores.shape)}, labels {list(labels.shape)}, "
            f"valid {list(detections.valid.shape)}, expected {list(shape)} like the boxes"
        )
    if detections.valid.dtype != torch.bool:
        raise TensorsimError(f"detections.valid: got {detections.valid.dtype}, expected bool")
    check_finite(torch.where(detections.valid.unsqueeze(-1), boxes, 0.0), "detections.boxes where valid")
    check_finite(torch.where(detections.valid, scores, 0.0), "detections.scores where valid")
    if observed is not None:
        fits = observed.shape == shape[:2] or observed.shape == shape[1:2]
        if observed.dtype != torch.bool or not fits:
            raise TensorsimError(
                f"observed: got {observed.dtype} of shape {list(observed.shape)}, "
                f"expected bool of {list(shape[1:2])} or {list(shape[:2])}"
            )
