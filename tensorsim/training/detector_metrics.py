"""How good a person detector is: precision and recall on labelled pictures, how long it follows people on film."""

import contextlib
import io
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from tqdm import tqdm

from tensorsim.data.video import VideoReader
from tensorsim.errors import TensorsimError
from tensorsim.geometry.boxes import box_iou
from tensorsim.training.shards import Sample
from tensorsim.types import Detections, Tracks
from tensorsim.vision.detection.acf import AcfDetector
from tensorsim.vision.detection.rtmdet import RTMDet
from tensorsim.vision.tracking.tracker import GNNTracker

#: Largest rise of logits when weights are stored in half precision.
HALF_PRECISION = 0.01


def measure(
    detector: RTMDet | AcfDetector, samples: Sequence[Sample], score: float = 0.5
) -> dict[str, float]:
    """Scores of a detector on pictures in which everybody is labelled, alone or as part of a labelled crowd.

    Detections that lie in a crowd, by at least the overlap in question, are ignored.

    Returns:
        ``ap`` and ``ap50`` as defined by COCO (averaged over overlaps from 0.5 to 0.95, and at 0.5), and for
        detections scored above ``score``: ``recall`` and ``recall_large`` (share of the people, and of those
        taller than a fifth of their picture, that one detection overlaps by at least 0.5),
        ``false_per_picture`` (detections that overlap nobody by 0.5) and ``alarms_per_picture`` (detections per
        picture without people or crowds; NaN if there is none).

    Raises:
        TensorsimError: no people, or the libraries for average precision are missing.
    """
    found = large = found_large = people = wrong = alarms = empty = 0
    truths: list[Tensor] = []
    crowds: list[Tensor] = []
    found_boxes: list[Tensor] = []
    for sample in samples:
        image = sample.image()
        boxes, scores = people_in(detector, image)
        truth, crowd = torch.from_numpy(sample.boxes), torch.from_numpy(sample.crowds)
        truths.append(truth)
        crowds.append(crowd)
        found_boxes.append(torch.cat([boxes, scores[:, None]], dim=1))
        sure = boxes[scores > score]
        hit = _matches(sure, truth)
        tall = (truth[:, 3] - truth[:, 1]) > 0.2 * image.shape[0]
        people += len(truth)
        found += int(hit.any(dim=0).sum())
        large += int(tall.sum())
        found_large += int((hit.any(dim=0) & tall).sum())
        wrong += int((~hit.any(dim=1) & ~_in_crowd(sure, crowd)).sum())
        nobody = len(truth) + len(crowd) == 0
        alarms += len(hit) if nobody else 0
        empty += nobody
    if people == 0:
        raise TensorsimError(f"detector: got {len(samples)} pictures without people, expected some with")
    ap, ap50 = average_precision(truths, found_boxes, crowds)
    return {
        "ap": ap,
        "ap50": ap50,
        "recall": found / people,
        "recall_large": found_large / max(large, 1),
        "false_per_picture": wrong / len(samples),
        "alarms_per_picture": alarms / empty if empty else float("nan"),
        "people": float(people),
    }


def average_precision(
    truths: Sequence[Tensor], found: Sequence[Tensor], crowds: Sequence[Tensor] = ()
) -> tuple[float, float]:
    """COCO's average precision over overlaps from 0.5 to 0.95, and at 0.5, by its own evaluator.

    Args:
        truths: per picture (n, 4) ``xyxy``.
        found: per picture (m, 5) ``xyxy`` and score.
        crowds: per picture (k, 4) ``xyxy``; detections in them are ignored.
    """
    try:
        from pycocotools.coco import COCO
        from pycocotools.cocoeval import COCOeval
    except ImportError as error:
        raise TensorsimError(
            f"average precision: pycocotools cannot be imported ({error}); install it with: "
            'pip install "tensorsim[train]"'
        ) from error

    def rows(people: Sequence[Tensor], crowds: Sequence[Tensor] = ()) -> list[dict[str, Any]]:
        result: list[dict[str, Any]] = []
        for is_crowd, tables in enumerate((people, crowds)):
            for picture, table in enumerate(tables, start=1):
                for left, top, right, bottom, *score in table.tolist():
                    size = (right - left, bottom - top)
                    row: dict[str, Any] = {
                        "id": len(result) + 1,
                        "image_id": picture,
                        "category_id": 1,
                        "iscrowd": is_crowd,
                        "bbox": [left, top, *size],
                        "area": size[0] * size[1],
                        "score": score[0] if score else 1.0,
                    }
                    result.append(row)
        return result

    with contextlib.redirect_stdout(io.StringIO()):  # it prints its progress
        labels = COCO()
        images = [{"id": picture} for picture in range(1, len(truths) + 1)]
        labels.dataset = {
            "images": images, "categories": [{"id": 1, "name": "person"}], "annotations": rows(truths, crowds)
        }  # fmt: skip
        labels.createIndex()
        answers = COCO()
        answers.dataset = labels.dataset | {"annotations": rows(found)}
        answers.createIndex()
        evaluation = COCOeval(labels, answers, "bbox")
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    return float(evaluation.stats[0]), float(evaluation.stats[1])


def people_in(detector: RTMDet | AcfDetector, image: npt.NDArray[np.uint8]) -> tuple[Tensor, Tensor]:
    """Boxes (n, 4) and scores (n,) of people found by a detector in a picture (H, W, 3) RGB, on the CPU."""
    picture = torch.from_numpy(image).permute(2, 0, 1)[None]
    with torch.no_grad():
        seen: Detections = detector(picture.to(next(detector.buffers()).device))
    persons = seen.valid[0] & (seen.labels[0] == 0)
    return seen.boxes[0][persons].cpu(), seen.scores[0][persons].cpu()


def calibrate(
    detector: RTMDet, samples: Sequence[Sample], alarms_per_picture: float = 0.1, quiet: bool = False
) -> float:
    """Shift the scores of a one-class detector so that a score of 0.5 means the same as for other detectors.

    A network that is not fully trained gives low scores even to correct detections. A constant is added to its logits,
    in place, so that it makes this many detections above a score of 0.5 per picture without people. Only these
    pictures count: a badly placed box on a person is an error, but does not invent a person. The order of
    detections, and so average precision, is unchanged.

    Args:
        detector: the detector, changed in place.
        samples: pictures that it was not trained on; those with people are skipped.
        alarms_per_picture: detections per picture without people.
        quiet: no progress bar.

    Returns:
        The constant.

    Raises:
        TensorsimError: all pictures show people.
    """
    empty = [sample for sample in samples if len(sample.boxes) == 0 and sample.all_labelled]
    if not empty:
        raise TensorsimError(f"calibrate: got {len(samples)} pictures with people, expected some without")
    bar = tqdm(empty, desc="calibrate", unit="picture", disable=quiet)
    highest = (
        torch.cat([people_in(detector, sample.image())[1] for sample in bar]).sort(descending=True).values
    )
    allowed = int(alarms_per_picture * len(empty))
    if allowed >= len(highest):
        return 0.0
    shift = -float(torch.logit(highest[allowed].double())) - HALF_PRECISION
    with torch.no_grad():
        for name, parameter in detector.bbox_head.rtm_cls.named_parameters():
            if name.endswith("bias"):
                parameter.add_(shift)
    return shift


def _matches(boxes: Tensor, truth: Tensor) -> Tensor:
    """(n, m) bool: which detections overlap which people by at least one half."""
    return box_iou(boxes[:, None], truth[None]) >= 0.5


def _in_crowd(boxes: Tensor, crowds: Tensor) -> Tensor:
    """(n,) bool: which detections (n, 4) lie at least half inside one of the crowds (m, 4)."""
    low = torch.maximum(boxes[:, None, :2], crowds[None, :, :2])
    high = torch.minimum(boxes[:, None, 2:], crowds[None, :, 2:])
    shared = (high - low).clamp_min(0).prod(-1)
    return (shared >= 0.5 * (boxes[:, 2:] - boxes[:, :2]).prod(-1)[:, None]).any(1)


class Followed(NamedTuple):
    """How long two detectors follow the people of a film.

    Attributes:
        frames: person-frames of the detector's tracks.
        reference_frames: person-frames of the reference's tracks.
        shared: the reference's person-frames that a track of the detector overlaps by at least one half.
    """

    frames: int
    reference_frames: int
    shared: int


def tracks_of_film(detector: RTMDet | AcfDetector, path: str | os.PathLike[str], interval: int = 2) -> Tracks:
    """People of a film (one clip) by the default tracker, detected in every ``interval``-th frame and in the last."""
    reader = VideoReader(path)
    found: list[Detections] = []
    observed: list[bool] = []
    last, device = torch.empty(0), next(detector.buffers()).device
    with torch.no_grad():
        for frames in reader.chunks(interval):
            found.append(detector(frames[:1].to(device)))
            observed += [True] + [False] * (len(frames) - 1)
            last = frames[-1:].clone()
        if not observed[-1]:
            found.append(detector(last.to(device)))
            observed[-1] = True
    whole = Detections(*(torch.cat(parts) for parts in zip(*found, strict=True)))
    mask = torch.tensor(observed, device=device)
    # Detections of the last observed frame fill the frames between, where they do not count.
    place = mask.cumsum(0) - 1
    spread = Detections(*(part[place].unsqueeze(0) for part in whole))
    return GNNTracker()(spread, mask)


def compare_tracks(tracks: Tracks, reference: Tracks) -> Followed:
    """Two detectors' people of one film: ``tracks`` against ``reference``, clips of one film each (B = 1)."""
    overlap = box_iou(reference.boxes[0][:, None], tracks.boxes[0][None])  # (Q, P, T)
    both = reference.valid[0][:, None] & tracks.valid[0][None] & (overlap >= 0.5)
    shared = int(both.any(dim=1).sum()) if both.shape[1] else 0
    return Followed(int(tracks.valid.sum()), int(reference.valid.sum()), shared)
