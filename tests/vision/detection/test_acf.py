import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import nn

from tensorsim.errors import TensorsimError
from tensorsim.geometry.boxes import box_iou
from tensorsim.training.acf import AcfSettings, boost, crop, upright_boxes, window_features
from tensorsim.training.shards import POINTS, Sample
from tensorsim.vision.detection.acf import COLUMNS, ROWS, AcfDetector, evaluate_trees, suppress
from tensorsim.vision.detection.acf_features import (
    aggregate_channels,
    gradients,
    luv,
    pyramid,
    rescaled,
    triangle_filter,
)
from tests.stage import StageTester, assert_same


def scenery(height: int = 160, width: int = 128, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, height // 8, width // 8, generator=generator)
    return F.interpolate(coarse, (height, width), mode="bilinear", align_corners=False)


def some_trees(count: int = 40) -> AcfDetector:
    """A detector with trees drawn at random, without a cascade."""
    generator = torch.Generator().manual_seed(3)
    detector = AcfDetector(count, cascade=-100.0)
    detector.feature = torch.randint(10 * ROWS * COLUMNS, (count, 3), generator=generator)
    detector.threshold = 0.5 * torch.rand(count, 3, generator=generator)
    detector.leaf = torch.randn(count, 4, generator=generator) / 4
    return detector.eval()


class TestAcfDetector(StageTester):
    batch_shapes = ((2,),)
    gradient_arguments = ()  # trees
    exports = False  # the number of windows that are left depends on the data
    float64 = False  # a feature at its threshold falls to another side

    def make(self) -> nn.Module:
        return some_trees()

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return (torch.cat([scenery(seed=k) for k in range(batch[0])]).to(dtype),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [
            ((torch.zeros(3, 160, 80),), r"expected \(B, 3, H, W\)"),
            ((torch.zeros(0, 3, 160, 80),), "got an empty tensor"),
            ((torch.zeros(1, 3, 160, 80, dtype=torch.int32),), "expected uint8 or floating point"),
            ((torch.full((1, 3, 160, 80), float("nan")),), r"expected RGB in \[0, 1\]"),
            (
                (torch.full((1, 3, 160, 80), 255.0),),
                r"values from 255\.0 to 255\.0, expected RGB in \[0, 1\]",
            ),
        ]


def test_colours_are_those_of_opencv() -> None:
    image = torch.rand(1, 3, 20, 30, generator=torch.Generator().manual_seed(0))
    reference = cv2.cvtColor(np.ascontiguousarray(image[0].permute(1, 2, 0).numpy()), cv2.COLOR_RGB2Luv)
    expected = (reference + np.array([0, 88, 134])) / 270
    assert_same(luv(image)[0], torch.from_numpy(expected).permute(2, 0, 1).float(), atol=2e-3)


def test_gradients_of_a_ramp() -> None:
    """Along u: orientation 0; along v: pi / 2; far from the edges the magnitude is its own mean."""
    ramp = torch.linspace(0, 1, 40).expand(1, 1, 40, 40)
    magnitude, orientation = gradients(ramp)
    assert_same(orientation[0, 10:30, 10:30], torch.zeros(20, 20), atol=1e-6)
    slope = 1 / 39
    assert_same(magnitude[0, 10:30, 10:30], torch.full((20, 20), slope / (slope + 0.005)), atol=1e-4)
    assert_same(
        gradients(ramp.transpose(2, 3))[1][0, 10:30, 10:30], torch.full((20, 20), torch.pi / 2), atol=1e-6
    )


def test_orientations_share_the_magnitude_and_cells_are_means() -> None:
    channels = aggregate_channels(scenery())
    assert channels.shape == (1, 10, 40, 32)
    assert_same(channels[:, 4:].sum(1), channels[:, 3], atol=1e-5)
    colour = F.avg_pool2d(triangle_filter(luv(scenery()), 1), 4)
    assert_same(channels[:, :3], triangle_filter(colour, 1), atol=1e-6)


def test_triangle_filter_is_that_of_opencv() -> None:
    x = torch.rand(30, 20, generator=torch.Generator().manual_seed(0))
    kernel = np.array([1, 2, 3, 2, 1], np.float32) / 9
    expected = cv2.sepFilter2D(x.numpy(), -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
    assert_same(triangle_filter(x[None, None], 2)[0, 0], torch.from_numpy(expected), atol=1e-6)


def test_approximated_channels_are_near_computed_ones() -> None:
    """The power law gives the mean of gradients that the smaller image has; without it there are too few."""
    image = scenery(320, 256)
    small = F.interpolate(image, (226, 181), mode="bilinear", align_corners=False, antialias=True)
    computed, whole = aggregate_channels(small), aggregate_channels(image)

    def edges(exponent: float) -> float:
        found = rescaled(whole, computed.shape[-2], computed.shape[-1], 2**-0.5, exponent)
        assert_same(found[:, :3].mean(), computed[:, :3].mean(), atol=0.01)
        return float(found[:, 3].mean() / computed[:, 3].mean())

    assert edges(0.11) == pytest.approx(1, abs=0.015)
    assert edges(0.0) < 0.98


def test_levels_of_the_pyramid() -> None:
    levels, scales = pyramid(scenery(256, 256), ROWS, COLUMNS)
    assert scales == pytest.approx([2 ** (-k / 8) for k in range(9)])
    assert [level.shape[-1] for level in levels][:3] == [64, 59, 54]
    assert levels[-1].shape[-2:] == (32, 32)
    for height, width in ((100, 256), (4 * ROWS - 2, 256), (256, 4 * COLUMNS - 2)):
        assert pyramid(torch.rand(1, 3, height, width), ROWS, COLUMNS) == ([], [])
    assert max(pyramid(scenery(100, 256), ROWS, COLUMNS, octaves_up=1)[1]) == 2.0


def test_trees_one_by_one() -> None:
    detector, level = some_trees(7), torch.rand(10, 36, 20, generator=torch.Generator().manual_seed(1))
    base = torch.tensor([0, 3, 2 * 20 + 1])
    place = torch.empty(7, 3, dtype=torch.int64)
    expected = torch.zeros(3, 7)
    for t in range(7):
        for k in range(3):
            c, rest = divmod(int(detector.feature[t, k]), ROWS * COLUMNS)
            place[t, k] = c * 36 * 20 + rest // COLUMNS * 20 + rest % COLUMNS
        for w, (row, column) in enumerate(((0, 0), (0, 3), (2, 1))):
            window = level[:, row : row + ROWS, column : column + COLUMNS].flatten()
            side = int(window[detector.feature[t, 0]] > detector.threshold[t, 0])
            end = int(window[detector.feature[t, 1 + side]] > detector.threshold[t, 1 + side])
            expected[w, t] = detector.leaf[t, 2 * side + end]
    found = evaluate_trees(level.flatten(), base, place, detector.threshold, detector.leaf, torch.ones(3))
    assert_same(found, 1 + expected.cumsum(1), atol=1e-5)


def test_cascade_leaves_early_and_keeps_the_sums_of_the_rest() -> None:
    detector, level = some_trees(), torch.rand(10, 40, 30, generator=torch.Generator().manual_seed(1))
    base = torch.arange(9)
    every, sums = detector.pass_cascade(level, base)
    assert every.tolist() == base.tolist()
    detector.cascade = float(sums.sort().values[3]) - 0.5
    some, left = detector.pass_cascade(level, base)
    assert 0 < len(some) <= 9
    assert torch.equal(left, sums[some])
    assert set(base.tolist()) - set(some.tolist()), "some are left early"


def test_suppression_by_the_smaller_box() -> None:
    boxes = torch.tensor([[0.0, 0, 10, 20], [1, 1, 9, 19], [8, 0, 18, 20], [0, 0, 100, 200]])
    scores = torch.tensor([0.5, 0.9, 0.8, 0.1])
    assert suppress(boxes, scores, 0.65, 10).tolist() == [1, 2]
    assert suppress(boxes, scores, 1.0, 3).tolist() == [1, 2, 0]


def figure(image: np.ndarray, left: int, top: int, height: int) -> None:
    """A dark person of a few strokes on a light ground."""
    width = height // 3
    cv2.ellipse(
        image,
        (left + width // 2, top + height // 10),
        (height // 14, height // 10),
        0,
        0,
        360,
        (40, 30, 30),
        -1,
    )
    cv2.rectangle(image, (left, top + height // 5), (left + width, top + height * 11 // 20), (60, 40, 90), -1)
    for foot in (left, left + 2 * width // 3):
        cv2.rectangle(image, (foot, top + height // 2), (foot + width // 3, top + height), (30, 30, 60), -1)


def sample_of(image: np.ndarray, box: list[float], tmp_path: Path) -> Sample:
    path = tmp_path / "picture.jpg"
    cv2.imwrite(str(path), image[..., ::-1])
    boxes = np.array([box], np.float32)
    points = np.zeros((1, len(POINTS), 3), np.float32)
    return Sample("0", boxes, points, np.ones(1, np.float32), True, path)


@pytest.mark.slow
def test_boosted_trees_find_what_they_were_shown(tmp_path: Path) -> None:
    """Trained on drawn figures and empty grounds, the detector finds a figure of another size in its place."""
    rng = np.random.default_rng(0)

    def ground(height: int, width: int) -> np.ndarray:
        coarse = rng.uniform(120, 255, (height // 16 + 1, width // 16 + 1, 3)).astype(np.float32)
        return cv2.resize(coarse, (width, height)).astype(np.uint8)

    people, empty = [], []
    for _ in range(60):
        image = ground(260, 200)
        height = int(rng.integers(90, 150))
        left, top = int(rng.integers(40, 100)), int(rng.integers(40, 90))
        empty.append(crop(ground(260, 200), np.array([60, 50, 110, 170], np.float32), False))
        figure(image, left, top, height)
        people.append(crop(image, np.array([left, top, left + height // 3, top + height], np.float32), False))
        for right, down, size in ((30, 40, 1.0), (0, -30, 1.0), (0, 0, 0.6), (0, 30, 0.6), (-20, -20, 1.6)):
            corner = np.array([left + right, top + down])
            box = np.array([*corner, *(corner + size * np.array([height // 3, height]))], np.float32)
            empty.append(crop(image, box, False))
    features = np.concatenate([window_features(people), window_features(empty)])
    labels = np.repeat([1, 0], [len(people), len(empty)])
    settings = AcfSettings(rounds=(16,))
    detector = boost(features, labels, 16, settings)
    inside = detector.pass_cascade(
        torch.from_numpy(features[0]).reshape(10, ROWS, COLUMNS), torch.zeros(1, dtype=torch.int64)
    )
    from sklearn.ensemble import GradientBoostingClassifier

    model = GradientBoostingClassifier(
        loss="exponential", n_estimators=16, learning_rate=0.5, max_depth=2, max_features=320, random_state=0
    ).fit(features, labels)
    assert float(inside[1]) == pytest.approx(float(model.decision_function(features[:1]).item()), abs=1e-4)

    image = ground(300, 300)
    figure(image, 120, 70, 180)
    found = detector(torch.from_numpy(image).permute(2, 0, 1)[None])
    assert bool(found.valid[0, 0])
    truth = torch.tensor([[150 - 0.5 * 0.41 * 180, 70, 150 + 0.5 * 0.41 * 180, 250]])
    assert float(box_iou(found.boxes[0, :1], truth)) > 0.5


def test_crop_has_the_person_in_the_middle() -> None:
    image = np.zeros((300, 400, 3), np.uint8)
    image[50:250, 160:220] = 255  # 200 high, its middle at (190, 150)
    window = crop(image, np.array([160, 50, 220, 250], np.float32), False)
    assert window.shape == (160, 96, 3)
    rows, columns = np.flatnonzero(window[:, 48, 0] > 127), np.flatnonzero(window[80, :, 0] > 127)
    assert abs(len(rows) - 100) <= 1
    assert abs(rows.mean() - 79.5) <= 1
    assert abs(columns.mean() - 47.5) <= 1
    assert np.array_equal(crop(image, np.array([160, 50, 220, 250], np.float32), True), window[:, ::-1])


def test_only_upright_people_are_taken(tmp_path: Path) -> None:
    image = np.zeros((200, 200, 3), np.uint8)
    assert len(upright_boxes(sample_of(image, [10, 10, 60, 140], tmp_path))) == 1
    assert len(upright_boxes(sample_of(image, [10, 10, 140, 60], tmp_path))) == 0
    assert len(upright_boxes(sample_of(image, [10, 10, 30, 50], tmp_path))) == 0
    cut = sample_of(image, [10, 10, 60, 140], tmp_path)
    cut.keypoints[0, POINTS.index("nose")] = [30, 15, 2]
    assert len(upright_boxes(cut)) == 0, "feet are not seen"
    cut.keypoints[0, POINTS.index("left_ankle")] = [30, 130, 2]
    assert len(upright_boxes(cut)) == 1


def test_weights_survive_a_file(tmp_path: Path) -> None:
    from tensorsim.weights import save_weights

    detector = some_trees()
    save_weights(detector, tmp_path / "acf.safetensors", {})
    loaded = AcfDetector.from_pretrained(tmp_path / "acf.safetensors")
    loaded.cascade = detector.cascade
    assert_same(loaded(scenery()), detector(scenery()))
    save_weights(nn.Linear(2, 2), tmp_path / "other.safetensors", {})
    with pytest.raises(TensorsimError, match="expected those of an AcfDetector"):
        AcfDetector.from_pretrained(tmp_path / "other.safetensors")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"trees": 0}, "trees: got 0"),
        ({"overlap": 1.5}, "overlap: got 1.5"),
        ({"octaves_up": -1}, "octaves_up: got -1"),
        ({"octaves_up": 0.5}, "octaves_up: got 0.5"),
        ({"max_detections": 2.5}, "max_detections: got 2.5"),
        ({"cascade": math.nan}, "cascade: got nan"),
    ],
)
def test_refuses_bad_settings(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        AcfDetector(**settings)
    with pytest.raises(TensorsimError, match="expected counts of at least 1"):
        AcfSettings(rounds=())
