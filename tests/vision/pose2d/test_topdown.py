import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.vision.pose2d.heatmaps import METHODS
from tensorsim.vision.pose2d.hrnet import HRNet, HRNetConfig
from tensorsim.vision.pose2d.onnx_heatmaps import OnnxHeatmaps
from tensorsim.vision.pose2d.topdown import FlipTest, TopDownPose, quarter_turns
from tests.stage import StageTester, assert_same

#: COCO's constants of the object keypoint similarity: twice the annotators' standard deviation, nose first.
OKS_KAPPA = 2 * np.array(
    [26, 25, 25, 35, 35, 79, 79, 72, 72, 62, 62, 107, 107, 87, 87, 89, 89], dtype=np.float64
)
OKS_KAPPA /= 1000
SWAPS = [(1, 2), (3, 4), (5, 6), (7, 8), (9, 10), (11, 12), (13, 14), (15, 16)]


class Brightness(nn.Module):
    """Heat map pixel (u, v) is the brightness of crop pixel (su, sv), times a gain for each keypoint."""

    def __init__(self, stride: int = 4) -> None:
        super().__init__()
        self.stride = stride

    def forward(self, crops: Tensor) -> Tensor:
        gain = torch.linspace(0.5, 1, 17, dtype=crops.dtype, device=crops.device)
        return crops.mean(1, keepdim=True)[..., :: self.stride, :: self.stride] * gain.view(17, 1, 1)


class Counter(nn.Module):
    """Notes how many crops come at once."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: list[int] = []

    def forward(self, crops: Tensor) -> Tensor:
        self.counts.append(len(crops))
        return crops.new_ones(len(crops), 17, 64, 48)


def blob(points: Tensor, width: int = 320, height: int = 240, sigma: float = 9.0) -> Tensor:
    """Grey images (B, 3, H, W) with a bright spot at ``uv`` (B, 2) each."""
    u = torch.arange(width, dtype=points.dtype) - points[:, 0, None]
    v = torch.arange(height, dtype=points.dtype) - points[:, 1, None]
    spot = torch.exp(-(v[:, :, None] ** 2 + u[:, None, :] ** 2) / (2 * sigma**2))
    return spot.unsqueeze(1).repeat(1, 3, 1, 1)


class TestTopDownPose(StageTester):
    batched_arguments = (0, 1, 2)
    gradient_arguments = (0, 1)
    batch_shapes = ((3,),)
    exports = False  # how many boxes are valid is known at run time only

    def make(self) -> nn.Module:
        return TopDownPose(Brightness(), crop_size=(64, 48), crops_per_batch=2)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        points = torch.tensor([[40.0, 31.0], [61.0, 45.0], [70.0, 25.0]], dtype=dtype)[: batch[0]]
        images = blob(points, 110, 80)
        low = torch.tensor([-17.3, -21.4], dtype=dtype)
        boxes = torch.stack(
            [torch.cat([points + low * s, points - 1.1 * low * s], -1) for s in (1, 1.3, 2)], 1
        )
        valid = torch.tensor([[True, False, True], [False, True, False], [True, True, True]])[: batch[0]]
        return images, boxes, valid

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        images, boxes, valid = self.inputs((3,), torch.float32)
        return [
            ((images[0], boxes, valid), "images: got shape"),
            ((images[:, :1], boxes, valid), "images: got shape"),
            ((images * float("nan"), boxes, valid), "NaN"),
            ((images, boxes[0], valid), "boxes: got shape"),
            ((images, boxes[..., :3], valid), "boxes: got shape"),
            ((images[:2], boxes, valid), "boxes for 3 images, expected boxes for 2"),
            ((images, boxes * float("inf"), valid), "finite"),
            ((images, boxes * 0, valid), "without area"),
            ((images, boxes.long(), valid), "boxes: got dtype torch.int64"),
            ((images, boxes, valid.float()), "expected bool of shape"),
            ((images, boxes, valid[:, :2]), r"expected bool of shape \[3, 3\]"),
        ]


class TestFlipTest(StageTester):
    batch_shapes = ((3,),)

    def make(self) -> nn.Module:
        return FlipTest(Brightness())

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return (torch.rand(*batch, 3, 32, 64, dtype=dtype, generator=torch.Generator().manual_seed(0)),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return []  # its network refuses


class TestWithHRNet(TestTopDownPose):
    """The whole of it, the flip test too, as it goes into a scripted graph."""

    def make(self) -> nn.Module:
        torch.manual_seed(0)
        network = HRNet(HRNetConfig(width=4, blocks=1, modules=(1, 1, 1), bottlenecks=1, planes=4), (64, 32))
        return TopDownPose(network, decode="quarter", flip_test=True).eval()


class TestStandUp(TestTopDownPose):
    """With a second look at those who lean; an untrained network finds trunks in all directions."""

    def make(self) -> nn.Module:
        torch.manual_seed(0)
        network = HRNet(HRNetConfig(width=4, blocks=1, modules=(1, 1, 1), bottlenecks=1, planes=4), (64, 32))
        stage = TopDownPose(network, decode="quarter", stand_up=True).eval()
        stage.least_trunk_score = -1.0  # its peaks are low
        return stage


class Upright(nn.Module):
    """Shoulders are red, hips blue, all else green; heat maps are high only where red is above blue in the crop."""

    def forward(self, crops: Tensor) -> Tensor:
        maps = crops[:, :, ::4, ::4]
        rows = torch.arange(maps.shape[2], dtype=crops.dtype).view(1, 1, -1, 1)
        red, _, blue = ((maps * rows).sum((2, 3)) / maps.sum((2, 3))).unbind(1)
        gain = torch.where(blue - red > 5, 1.0, 0.5).view(-1, 1, 1, 1)
        colours = [1] * 5 + [0, 0] + [1] * 4 + [2, 2] + [1] * 4
        return maps[:, colours] * gain


@pytest.mark.parametrize("lean", range(4))
def test_who_leans_is_looked_at_again_upright(lean: int) -> None:
    upright = torch.stack(
        [blob(torch.tensor([[90.0, 30 + 40 * row]]), 180, 150, 5)[0, 0] for row in range(3)]
    )
    image = upright.rot90(-lean, [1, 2])[None]  # clockwise as seen
    height, width = image.shape[2:]
    box = torch.tensor([20.0, 15, width - 21, height - 11]).view(1, 1, 4)
    known = torch.tensor([[90.0, 70], [90, 30], [90, 110]])  # of the face, the shoulders, the hips
    for turn in range(lean):
        known = torch.stack([(149, 179)[turn % 2] - known[:, 1], known[:, 0]], -1)
    valid = torch.ones(1, 1, dtype=torch.bool)
    first, low = TopDownPose(Upright(), "dark", crop_size=(128, 96))(image, box, valid)
    second, high = TopDownPose(Upright(), "dark", crop_size=(128, 96), stand_up=True)(image, box, valid)
    assert quarter_turns(first).item() == lean
    for found in (first, second):
        torch.testing.assert_close(found[0, 0, [0, 5, 11]], known, atol=0.4, rtol=0)
    # Pixels of the maps are up to two pixels of the crop away from the brightest one.
    assert (0.3 if lean else 0.7) < float(low.mean()) < (0.55 if lean else 1.05)
    assert 0.7 < float(high.mean()) < 1.05


def test_half_a_person_is_not_turned() -> None:
    """Hips beyond the picture say nothing of how the trunk leans."""
    image = blob(torch.tensor([[90.0, 70.0], [90.0, 30.0]]), 180, 150, 5)[:, 0]
    image = torch.stack([image[1], image[0], 0.2 * image[0].roll(40, 0)]).rot90(2, [1, 2])[None]
    box, valid = torch.tensor([[[20.0, 15, 129, 168]]]), torch.ones(1, 1, dtype=torch.bool)
    first = TopDownPose(Upright(), "dark", crop_size=(128, 96))(image, box, valid)
    assert quarter_turns(first[0]).item() == 2
    assert float(first[1][..., 11].max()) < 0.3
    second = TopDownPose(Upright(), "dark", crop_size=(128, 96), stand_up=True)(image, box, valid)
    torch.testing.assert_close(second, first, atol=0.0, rtol=0.0)


@pytest.mark.parametrize("decode", ["expected", "dark", "quarter"])
@pytest.mark.parametrize("flip_test", [False, True])
@pytest.mark.parametrize("image_type", ["float", "uint8"])
def test_points_come_back_to_their_image_pixels(decode: str, flip_test: bool, image_type: str) -> None:
    points = torch.tensor([[150.3, 101.2], [97.0, 140.6]])
    images = blob(points)
    if image_type == "uint8":
        images = (images * 255).round().to(torch.uint8)
    boxes = torch.tensor([[100.0, 20, 220, 200], [50, 100, 210, 190]])
    boxes = torch.stack([boxes, boxes.flip(0)], 1)
    valid = torch.tensor([[True, True], [True, False]])
    keypoints, scores = TopDownPose(Brightness(), decode, flip_test)(images, boxes, valid)
    # Quarter steps leave up to 1/4 heat-map pixel of up to 4.2 image pixels.
    tolerance = {"expected": 0.3, "dark": 0.1, "quarter": 1.3}[decode]
    for frame, person in valid.nonzero().tolist():
        error = keypoints[frame, person] - points[frame]
        assert float(error.abs().max()) < tolerance
        assert float(scores[frame, person, -1]) == pytest.approx(1, abs=0.1)
    assert not keypoints[1, 1].any()
    assert not scores[1, 1].any()


@pytest.mark.parametrize("stride", [4, 8])
def test_flip_test_turns_back_swaps_sides_and_moves_to_the_same_pixels(stride: int) -> None:
    crops = torch.rand(2, 3, 32, 64)
    grey, gain = crops.mean(1, keepdim=True), torch.linspace(0.5, 1, 17).view(17, 1, 1)
    swapped = gain.clone()
    for left, right in SWAPS:
        swapped[left], swapped[right] = gain[right], gain[left]
    turned = grey[..., ::stride, stride - 1 :: stride]  # pixel su + s - 1 at u
    before = torch.cat([turned[..., :1], turned[..., :-1]], -1)  # pixel su - 1
    moved = (turned + (stride - 1) * before) / stride
    expected = (grey[..., ::stride, ::stride] * gain + moved * swapped) / 2
    torch.testing.assert_close(FlipTest(Brightness(stride))(crops), expected)


def test_network_sees_valid_boxes_only_and_a_few_at_once() -> None:
    network = Counter()
    valid = torch.rand(6, 4) < 0.6
    boxes = torch.where(valid.unsqueeze(-1), torch.tensor([10.0, 10, 50, 90]), torch.tensor(float("nan")))
    keypoints, _ = TopDownPose(network, crops_per_batch=5)(torch.rand(6, 3, 100, 100), boxes, valid)
    count = int(valid.sum())
    assert network.counts == [5] * (count // 5) + [count % 5] * (count % 5 > 0)
    assert bool(keypoints.isfinite().all())


def test_nobody() -> None:
    pose = TopDownPose(Brightness())
    for module in (pose, torch.jit.script(pose)):
        images = torch.rand(2, 3, 50, 60)
        for people in (0, 3):
            keypoints, scores = module(
                images, torch.zeros(2, people, 4), torch.zeros(2, people, dtype=torch.bool)
            )
            assert keypoints.shape == (2, people, 17, 2)
            assert scores.shape == (2, people, 17)
            assert not keypoints.any()
            assert not scores.any()


def test_scripted_takes_other_clips() -> None:
    tester = TestWithHRNet()
    pose = tester.make()
    scripted = torch.jit.script(pose)
    boxes = torch.tensor([10.0, 20, 60, 90]) + 5 * torch.rand(7, 5, 4)
    valid = torch.rand(7, 5) < 0.5
    images = torch.randint(256, (7, 3, 90, 150), dtype=torch.uint8)
    with torch.no_grad():
        assert_same(scripted(images, boxes, valid), pose(images, boxes, valid), atol=1e-6)


@pytest.mark.parametrize("image_type", [torch.float16, torch.float64])
def test_images_may_have_another_type_than_the_network(image_type: torch.dtype) -> None:
    tester = TestWithHRNet()
    images, boxes, valid = tester.inputs((2,), torch.float32)
    pose = tester.make()
    with torch.no_grad():
        assert_same(pose(images.to(image_type), boxes, valid), pose(images, boxes, valid), atol=1e-2)


def test_crop_size_comes_from_the_network() -> None:
    assert TopDownPose(HRNet(HRNetConfig(4, 1, (1, 1, 1), 1, 4), (128, 96))).crop.height == 128
    assert TopDownPose(Brightness()).crop.width == 192
    assert TopDownPose(Brightness(), crop_size=(64, 32)).crop.width == 32


def test_constructor_refuses() -> None:
    with pytest.raises(TensorsimError, match="crops_per_batch"):
        TopDownPose(Brightness(), crops_per_batch=0)
    with pytest.raises(TensorsimError, match="expected one of"):
        TopDownPose(Brightness(), decode="udp")
    with pytest.raises(TensorsimError, match="padding"):
        TopDownPose(Brightness(), padding=-1.0)


def mean_oks(data: Path, **options: Any) -> float:
    """Mean object keypoint similarity over the people of the pictures that are annotated well."""
    annotations = json.loads((data / "coco" / "test_coco.json").read_text())
    pose = TopDownPose(OnnxHeatmaps(data / "weights" / "simplepose_coco17_256x192.onnx"), **options)
    similarities = []
    for image in annotations["images"]:
        bgr = cv2.imread(str(data / "coco" / "images" / image["file_name"]))
        rgb = torch.from_numpy(bgr[..., ::-1].copy()).permute(2, 0, 1).unsqueeze(0)
        people = [
            p for p in annotations["annotations"] if p["image_id"] == image["id"] and p["num_keypoints"]
        ]
        x, y, w, h = torch.tensor([p["bbox"] for p in people]).unbind(-1)
        boxes = torch.stack([x, y, x + w, y + h], -1).unsqueeze(0)
        keypoints, _ = pose(rgb, boxes, torch.ones(1, len(people), dtype=torch.bool))
        for person, found in zip(people, keypoints[0].double().numpy(), strict=True):
            truth = np.array(person["keypoints"], dtype=np.float64).reshape(17, 3)
            distance2 = ((found - truth[:, :2]) ** 2).sum(-1)
            similarity = np.exp(-distance2 / (2 * person["area"] * OKS_KAPPA**2))
            similarities.append(similarity[truth[:, 2] > 0].mean())
    assert len(similarities) == 12
    return float(np.mean(similarities))


def test_real_people(shared_data: Path) -> None:
    expected, dark, quarter = (mean_oks(shared_data, decode=decode) for decode in METHODS)
    assert expected > 0.79
    assert dark > 0.79
    assert quarter > 0.77
    assert dark > quarter
    assert mean_oks(shared_data, flip_test=True) > expected
