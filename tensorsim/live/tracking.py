"""Tracking frame by frame: the association of :class:`~tensorsim.vision.GNNTracker` without look-ahead."""

from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.geometry.boxes import center_to_xyxy, xyxy_to_center
from tensorsim.types import Detections
from tensorsim.vision.smoothing.kalman import constant_velocity_predict
from tensorsim.vision.tracking.tracker import GNNTracker, Living, joined


class OnlineTracks(NamedTuple):
    """The n tracks that may still be matched.

    Attributes:
        living: their boxes and hits.
        confirmed: (n,) bool.
        strong_hits: (n,) number of detections so far with at least the start score.
        born: number of tracks ever started; ``living.rows`` are their numbers.
    """

    living: Living
    confirmed: Tensor
    strong_hits: Tensor
    born: int


class OnlineTracker(GNNTracker):
    """A :class:`~tensorsim.vision.GNNTracker` that takes one frame at a time.

    Detections are assigned to the same tracks as for the whole clip. Boxes are filtered, not smoothed. A track is a
    person as soon as it is confirmed and has ``min_hits``; of more than ``max_tracks``, the oldest are kept. The
    caller holds the state.
    """

    def begin(self) -> OnlineTracks:
        """The state before the first frame."""
        nothing = torch.zeros(0, dtype=torch.int64)
        living = self._start(nothing, torch.zeros(0, 4, dtype=torch.float64))
        return OnlineTracks(living, torch.zeros(0, dtype=torch.bool), nothing, 0)

    def step(self, state: OnlineTracks, detections: Detections | None) -> OnlineTracks:
        """The state after a frame: its detections (K, ...), or None where the detector was not run."""
        predicted = constant_velocity_predict(state.living.box, self._process_noise(), 1.0)
        living = state.living._replace(box=predicted)
        if detections is None:
            return state._replace(living=living)
        box, score = self._usable(detections)
        strong = score >= self.start_score
        column = self._assign(living, box, score, state.confirmed)
        hit = column >= 0
        strong_hits = state.strong_hits + (hit & _taken(strong, column)).to(torch.int64)
        living = self._correct(living, xyxy_to_center(box), column)
        confirmed = state.confirmed | (living.history[:, : self.confirm_window].sum(-1) >= self.confirm_hits)
        alive = self._alive(living, confirmed)

        new = self._newcomers(box, strong, column[hit])
        numbers = torch.arange(new.shape[0]) + state.born
        start = self._start(numbers, xyxy_to_center(box[new]))
        return OnlineTracks(
            joined(living, alive, start),
            torch.cat([confirmed[alive], torch.full((new.shape[0],), self.confirm_hits == 1)]),
            torch.cat([strong_hits[alive], torch.ones_like(numbers)]),
            state.born + new.shape[0],
        )

    def people(self, state: OnlineTracks) -> tuple[list[int], Tensor]:
        """Numbers of the tracks that are people, oldest first, and their boxes (P, 4) ``xyxy`` float64."""
        is_person = state.confirmed & (state.strong_hits >= self.min_hits)
        chosen = torch.nonzero(is_person).flatten()[: self.max_tracks]
        place = state.living.box.position[chosen]
        place = torch.cat([place[:, :2], place[:, 2:].clamp(min=self.min_box_px)], dim=-1)
        return state.living.rows[chosen].tolist(), center_to_xyxy(place)

    def _usable(self, detections: Detections) -> tuple[Tensor, Tensor]:
        """Boxes (k, 4) of the usable detections, best first, and their scores (k,)."""
        boxes, scores = detections.boxes.detach().cpu().double(), detections.scores.detach().cpu().double()
        usable = (
            detections.valid.cpu()
            & (detections.labels == 0).cpu()
            & (scores >= self.faint_score)
            & (boxes[..., 2:] - boxes[..., :2] >= self.min_box_px).all(-1)
        )
        best_first = scores.argsort(descending=True, stable=True)
        index = best_first[usable[best_first]]
        return boxes[index], scores[index]


def _taken(strong: Tensor, column: Tensor) -> Tensor:
    """For each track, whether its detection (n,), -1 for none, is a strong one."""
    return torch.cat([strong, strong.new_zeros(1)])[column]
