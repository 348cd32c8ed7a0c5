"""Training of the ACF detector: windows of upright people, boosting, and hard negatives found by the detector itself.

The boosting is scikit-learn's gradient boosting with the exponential loss, which is AdaBoost with real leaves, on a
random sixteenth of the features at each split. Each stage starts afresh with more trees, and adds the false positives
of the stage before to the negatives.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from tqdm import tqdm

from tensorsim.errors import TensorsimError
from tensorsim.geometry.boxes import box_iou
from tensorsim.training.shards import POINTS, Floats, Sample, Shards, find_shards, read_coco_shards
from tensorsim.vision.detection.acf import COLUMNS, PERSON_HEIGHT, ROWS, AcfDetector
from tensorsim.vision.detection.acf_features import CELL, CHANNELS, aggregate_channels

#: Margin of cells around a window for computing its channels.
_MARGIN = 4
_SHAPE = (CELL * (ROWS + 2 * _MARGIN), CELL * (COLUMNS + 2 * _MARGIN))
#: Keypoints at the ends of a body; of an upright person, at least one of each group is labelled.
_UPPER, _LOWER = ("nose", "left_ear", "right_ear", "head_top"), ("left_ankle", "right_ankle")
#: Lowest and highest ratio of width to height of an upright person.
_SLIM = (0.2, 0.65)
_FEWEST_PIXELS = 48.0


@dataclass(frozen=True)
class AcfSettings:
    """How the detector is trained.

    Attributes:
        rounds: number of trees in each stage.
        positives: most windows with people.
        negatives: windows without people added by each stage.
        learning_rate: factor on each tree.
        false_per_picture: false detections per held-out picture at the score 0.5.
        seed: seed of draws and boosting.

    Raises:
        TensorsimError: counts below one, factors that are not positive.
    """

    rounds: tuple[int, ...] = (32, 64, 256)
    positives: int = 3000
    negatives: int = 3000
    learning_rate: float = 0.5
    false_per_picture: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.rounds or min(*self.rounds, self.positives, self.negatives) < 1:
            raise TensorsimError(f"AcfSettings: got {self}, expected counts of at least 1")
        if not (self.learning_rate > 0 and self.false_per_picture > 0):
            raise TensorsimError(f"AcfSettings: got {self}, expected positive numbers")


def upright_boxes(sample: Sample) -> Floats:
    """Boxes (n, 4) of people in a picture who are upright and visible from head to foot."""
    kept = []
    for box, points in zip(sample.boxes, sample.keypoints, strict=True):
        width, height = box[2] - box[0], box[3] - box[1]
        if height < _FEWEST_PIXELS or not _SLIM[0] <= width / height <= _SLIM[1]:
            continue
        if points[:, 2].any():
            ends = [points[[POINTS.index(name) for name in names]] for names in (_UPPER, _LOWER)]
            heads, feet = (end[end[:, 2] > 0, 1] for end in ends)
            if len(heads) == 0 or len(feet) == 0 or feet.max() - heads.min() < 0.6 * height:
                continue
        kept.append(box)
    return np.array(kept, np.float32).reshape(-1, 4)


def crop(image: npt.NDArray[np.uint8], box: Floats, mirrored: bool) -> npt.NDArray[np.uint8]:
    """A window with its margin, with the person of a box scaled to 100 pixels in height and centred."""
    import cv2

    scale = PERSON_HEIGHT / float(box[3] - box[1])
    source: npt.NDArray[Any] = image
    # Area averages first: bilinear interpolation alone would alias.
    if scale < 0.5:
        source = cv2.resize(image, None, fx=2 * scale, fy=2 * scale, interpolation=cv2.INTER_AREA)
    now = source.shape[0] / image.shape[0]
    middle = (box[:2] + box[2:]) / 2 * now
    scale = scale / now
    height, width = _SHAPE
    matrix = np.array(
        [
            [scale, 0, width / 2 - 0.5 - scale * (middle[0] - 0.5)],
            [0, scale, height / 2 - 0.5 - scale * (middle[1] - 0.5)],
        ]
    )
    window = cv2.warpAffine(source, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return np.ascontiguousarray(window[:, ::-1] if mirrored else window).astype(np.uint8, copy=False)


def window_features(crops: Sequence[npt.NDArray[np.uint8]]) -> npt.NDArray[np.float32]:
    """Features (n, 5120) of windows given with their margin, in the order of the detector."""
    inner = slice(_MARGIN, -_MARGIN)
    found = []
    for first in range(0, len(crops), 64):
        images = torch.from_numpy(np.stack(crops[first : first + 64])).permute(0, 3, 1, 2).float() / 255
        found.append(aggregate_channels(images)[..., inner, inner].flatten(1).numpy())
    return np.concatenate(found) if found else np.zeros((0, CHANNELS * ROWS * COLUMNS), np.float32)


def boost(
    features: npt.NDArray[np.float32],
    labels: npt.NDArray[np.int64],
    rounds: int,
    settings: AcfSettings,
    quiet: bool = True,
) -> AcfDetector:
    """A detector of ``rounds`` trees that distinguishes windows with people (label 1) from others (0).

    Raises:
        TensorsimError: scikit-learn missing.
    """
    try:
        from sklearn.ensemble import GradientBoostingClassifier
    except ImportError as error:
        raise TensorsimError(
            f'ACF: scikit-learn cannot be imported ({error}); install it with: pip install "tensorsim[train]"'
        ) from error
    model = GradientBoostingClassifier(
        loss="exponential",
        n_estimators=rounds,
        learning_rate=settings.learning_rate,
        max_depth=2,
        max_features=max(1, features.shape[1] // 16),
        random_state=settings.seed,
    )
    with tqdm(total=rounds, desc="trees", unit="tree", disable=quiet) as bar:

        def count(*_: Any) -> bool:
            bar.update()
            return False  # continue

        model.fit(features, labels, monitor=count)
    detector = AcfDetector(rounds)
    share = float(labels.mean())
    for k, tree in enumerate(model.estimators_[:, 0]):
        _copy_tree(tree.tree_, detector, k, settings.learning_rate)
    detector.leaf[0] += 0.5 * float(np.log(share / (1 - share)))  # initial value of the boosting
    return detector.eval()


def _copy_tree(tree: Any, detector: AcfDetector, k: int, learning_rate: float) -> None:
    """Write a tree of scikit-learn into row k; a branch that ends early gets equal leaves."""

    def child(node: int, side: int) -> int:
        below = int((tree.children_left, tree.children_right)[side][node])
        return node if below < 0 else below

    nodes = (0, child(0, 0), child(0, 1))
    for place, node in enumerate(nodes):
        if tree.children_left[node] >= 0:
            detector.feature[k, place] = int(tree.feature[node])
            detector.threshold[k, place] = float(tree.threshold[node])
    ends = [child(node, side) for node in nodes[1:] for side in (0, 1)]
    detector.leaf[k] = torch.tensor([learning_rate * float(tree.value[node].item()) for node in ends])


class AcfTrainer:
    """Collects windows and trains stage by stage.

    Args:
        data: folder of the shards of ``tensorsim train detector``.
        settings: settings of the training.
        quiet: no progress bars.

    Raises:
        TensorsimError: shards are missing.
    """

    def __init__(self, data: Path, settings: AcfSettings, quiet: bool = False) -> None:
        training, self.held_out = read_coco_shards(data)
        self.settings, self.quiet = settings, quiet
        streets = list(Shards(find_shards(data, "pedestrian")))
        self.people = [s for s in (*training, *streets) if len(upright_boxes(s))]
        empty = [s for s in training if s.all_labelled and len(s.boxes) == 0]
        for name in ("backgrounds", "coco_hardneg"):
            empty += Shards(find_shards(data, name))
        self.empty = empty
        if not self.people or not self.empty:
            raise TensorsimError(f"{data}: got no upright people or no pictures without any, expected both")

    def train(self) -> AcfDetector:
        """The detector of the last stage, its scores calibrated on held-out pictures."""
        rng = np.random.default_rng(self.settings.seed)
        positive = window_features(list(self._positives(rng)))
        negative = window_features(list(self._random_negatives(rng)))
        detector = None
        for rounds in self.settings.rounds:
            if detector is not None:
                found = window_features(list(self._hard_negatives(detector, rng)))
                negative = np.concatenate([negative, found])
            features = np.concatenate([positive, negative])
            labels = np.repeat(np.array([1, 0]), [len(positive), len(negative)])
            detector = boost(features, labels, rounds, self.settings, self.quiet)
        assert detector is not None
        self.calibrate(detector)
        return detector

    def _positives(self, rng: np.random.Generator) -> Iterator[npt.NDArray[np.uint8]]:
        boxes = [(sample, box) for sample in self.people for box in upright_boxes(sample)]
        order = rng.permutation(len(boxes))[: max(1, self.settings.positives // 2)]
        for k in tqdm(order, desc="people", unit="person", disable=self.quiet):
            image = boxes[k][0].image()
            for mirrored in (False, True):
                yield crop(image, boxes[k][1], mirrored)

    def _random_negatives(self, rng: np.random.Generator) -> Iterator[npt.NDArray[np.uint8]]:
        each = -(-self.settings.negatives // len(self.empty))
        for sample in tqdm(self.empty, desc="grounds", unit="picture", disable=self.quiet):
            image = sample.image()
            height, width = image.shape[:2]
            for _ in range(each):
                size = float(np.exp(rng.uniform(np.log(40), np.log(max(41, 0.9 * height)))))
                corner = rng.uniform([0, 0], [max(1, width - size / 2), max(1, height - size)])
                yield crop(
                    image, np.array([*corner, *(corner + np.array([size / 2, size]))], np.float32), False
                )

    def _hard_negatives(
        self, detector: AcfDetector, rng: np.random.Generator
    ) -> Iterator[npt.NDArray[np.uint8]]:
        """Windows of pictures without people that the detector takes for people, a few from each picture."""
        most, total = max(4, 3 * self.settings.negatives // len(self.empty)), 0
        for k in tqdm(rng.permutation(len(self.empty)), desc="mistakes", unit="picture", disable=self.quiet):
            image = self.empty[k].image()
            found = detect(detector, image)
            for box in found[:most, :4]:
                total += 1
                # The detection's box is narrower than its window, so crop by the height.
                yield crop(image, box, False)
            if total >= self.settings.negatives:
                return

    def calibrate(self, detector: AcfDetector) -> None:
        """Set the offset so that, at score 0.5, held-out pictures have ``false_per_picture`` false detections each."""
        pictures = [sample for sample in self.held_out if sample.all_labelled]
        wrong: list[float] = []
        for sample in tqdm(pictures, desc="held out", unit="picture", disable=self.quiet):
            found = detect(detector, sample.image())
            truth = torch.from_numpy(sample.boxes)
            for row in torch.from_numpy(found):
                if len(truth) == 0 or float(box_iou(row[None, :4], truth).max()) < 0.5:
                    wrong.append(float(row[4]))
        allowed = round(self.settings.false_per_picture * len(pictures))
        wrong.sort(reverse=True)
        level = wrong[allowed] if allowed < len(wrong) else 0.5
        detector.offset += float(torch.logit(torch.tensor(level), eps=1e-6))


@torch.inference_mode()
def detect(detector: AcfDetector, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Boxes and scores (n, 5) of people in a picture (H, W, 3), best first."""
    found = detector(torch.from_numpy(image).permute(2, 0, 1)[None])
    rows: Tensor = torch.cat([found.boxes[0], found.scores[0, :, None]], dim=1)[found.valid[0]]
    return rows.numpy()
