from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.vision.pose2d.crops import BoxCrop, OpenCVBoxCrop, crop_to_image, crop_transform
from tests.stage import StageTester


def random_boxes(count: int, width: int, height: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Boxes that may hang over the border of an image."""
    generator = torch.Generator().manual_seed(7)
    corner = torch.rand(count, 2, generator=generator, dtype=torch.float64) - 0.2
    size = 0.1 + 0.8 * torch.rand(count, 2, generator=generator, dtype=torch.float64)
    scale = torch.tensor([width, height], dtype=torch.float64)
    return torch.cat([corner * scale, (corner + size) * scale], -1).to(dtype)


class TestBoxCrop(StageTester):
    batched_arguments = (1, 2)
    gradient_arguments = (0, 1)
    batch_shapes = ((3,),)

    def make(self) -> nn.Module:
        return BoxCrop((16, 12))

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(0)
        # float32 and float64 sample positions differ by 1e-6 pixels: a smooth picture keeps that small.
        images = torch.rand(2, 3, 20, 30, generator=generator, dtype=torch.float64).cumsum(-1) / 30
        return images.to(dtype), random_boxes(batch[0], 30, 20, dtype), torch.arange(batch[0]) % 2

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        images, boxes, index = self.inputs((3,), torch.float32)
        return [
            ((images[0], boxes, index), "images: got shape"),
            ((images[..., :0], boxes, index), "some pixels"),
            ((images.int(), boxes, index), "floats or uint8"),
            ((images, boxes[:, :3], index), "xyxy"),
            ((images, boxes[None], index), "expected"),
            ((images, boxes, index[:2]), r"of shape \(3,\), one per box"),
            ((images, boxes, index + 1), "expected 0 to 1"),
            ((images, boxes, index.float()), "index: got torch.float32"),
            ((images, boxes.long(), index), "boxes: got dtype torch.int64"),
            ((images, boxes * float("nan"), index), "finite"),
            ((images, boxes[:, [2, 3, 0, 1]], index), "without area"),
        ]


class TestOpenCVBoxCrop(TestBoxCrop):
    gradient_arguments = ()  # 8-bit images
    scripts = exports = False  # it calls OpenCV

    def make(self) -> nn.Module:
        return OpenCVBoxCrop((16, 12))

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        images, boxes, index = super().inputs(batch, dtype)
        return (255 * images / images.amax()).to(torch.uint8), boxes, index


@pytest.mark.parametrize("size", [(256, 192), (192, 256), (9, 31)])
def test_opencv_makes_the_same_crops(size: tuple[int, int]) -> None:
    """Of boxes inside of the picture, beyond its border, outside of it, smaller and larger than the crop."""
    rng = np.random.default_rng(0)
    images = torch.from_numpy(rng.integers(0, 256, (3, 120, 160, 3), dtype=np.uint8)).permute(0, 3, 1, 2)
    generator = torch.Generator().manual_seed(0)
    middle = torch.rand(200, 2, generator=generator) * torch.tensor([320.0, 240.0]) - torch.tensor(
        [80.0, 60.0]
    )
    half = 0.5 + 60 * torch.rand(200, 2, generator=generator).square()
    boxes, index = torch.cat([middle - half, middle + half], dim=-1), torch.arange(200) % 3
    expected, crops = (crop(size)(images, boxes, index) for crop in (BoxCrop, OpenCVBoxCrop))
    assert crops.stride() == expected.stride()
    torch.testing.assert_close(crops, expected, rtol=0, atol=0.02 / 255)
    large = torch.tensor([[-1e4, -1e4, 1e4, 1e4]])
    assert torch.equal(*(crop(size)(images, large, index[:1]) for crop in (BoxCrop, OpenCVBoxCrop)))
    floats = images / 255
    assert torch.equal(OpenCVBoxCrop(size)(floats, boxes, index), BoxCrop(size)(floats, boxes, index))


def reference_crop(image: np.ndarray, box: np.ndarray, size: tuple[int, int], padding: float) -> np.ndarray:
    """Centre and size as pose code computes them, then OpenCV's warp of the forward transform."""
    height, width = size
    centre, (w, h) = (box[:2] + box[2:]) / 2, (box[2:] - box[:2]) * padding
    if w / h > width / height:
        h = w * height / width
    else:
        w = h * width / height
    matrix = np.array(
        [
            [width / w, 0, width / 2 - centre[0] * width / w],
            [0, height / h, height / 2 - centre[1] * height / h],
        ]
    )
    return cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_LINEAR, borderValue=0)


@pytest.mark.parametrize(("size", "padding"), [((256, 192), 1.25), ((64, 96), 1.0)])
@pytest.mark.parametrize("kind", ["uint8", "float32"])
def test_equals_opencv(size: tuple[int, int], padding: float, kind: str) -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (120, 160, 3), dtype=np.uint8)
    check_against_opencv(image, random_boxes(12, 160, 120), size, padding, kind)


@pytest.mark.parametrize("kind", ["uint8", "float32"])
def test_equals_opencv_on_photographs(shared_data: Path, kind: str) -> None:
    for path in sorted((shared_data / "coco" / "images").glob("*.jpg")):
        image = cv2.imread(str(path))
        boxes = random_boxes(4, image.shape[1], image.shape[0])
        check_against_opencv(image, boxes, (256, 192), 1.25, kind)


def check_against_opencv(
    image: np.ndarray, boxes: Tensor, size: tuple[int, int], padding: float, kind: str
) -> None:
    source = image if kind == "uint8" else image.astype(np.float32) / 255
    images = torch.from_numpy(source).permute(2, 0, 1).unsqueeze(0)
    crops = BoxCrop(size, padding)(images, boxes, torch.zeros(len(boxes), dtype=torch.long))
    assert crops.dtype == torch.float32
    # OpenCV 5 rounds 8-bit results to whole levels; OpenCV 4 also rounds positions to 1/32 of a pixel.
    fixed_point = int(cv2.__version__.split(".")[0]) < 5
    levels = (8.0 if fixed_point else 0.51) if kind == "uint8" else (8.0 if fixed_point else 0.05)
    for crop, box in zip(crops, boxes, strict=True):
        expected = reference_crop(source, box.double().numpy(), size, padding)
        expected = expected.astype(np.float64) * (1 if kind == "uint8" else 255)
        difference = np.abs(crop.permute(1, 2, 0).double().numpy() * 255 - expected)
        assert difference.max() < levels
        assert difference.mean() < (1.0 if fixed_point else 0.26)


def test_pixel_centres_are_at_integers() -> None:
    # A crop as large as its box shows the pixels themselves, moved by whole pixels.
    images = torch.rand(1, 3, 30, 40)
    crops = BoxCrop((8, 6), padding=1.0)(images, torch.tensor([[11.0, 5, 17, 13]]), torch.tensor([0]))
    torch.testing.assert_close(crops[0], images[0, :, 5:13, 11:17])


def test_u_points_right_and_v_down_and_the_short_side_grows() -> None:
    boxes = torch.tensor([[10.0, 20, 110, 60]])  # 100 x 40 about (60, 40): width decides, 125 x 166.7
    scale, offset = crop_transform(boxes, 256, 192, 1.25)
    torch.testing.assert_close(scale, torch.tensor([[125 / 192]]))
    torch.testing.assert_close(offset, torch.tensor([[60 - 62.5, 40 - 125 * 256 / 192 / 2]]))
    corners = torch.tensor([[[0.0, 0], [192, 0], [0, 256], [96, 128]]])
    # kp_in / (W, H) * (sw, sh) + centre - size / 2, as mmpose returns to the image
    size = torch.tensor([125.0, 125 * 256 / 192])
    expected = corners / torch.tensor([192.0, 256]) * size + torch.tensor([60.0, 40]) - size / 2
    torch.testing.assert_close(crop_to_image(corners, boxes, 256, 192, 1.25), expected)


def test_outside_is_black_and_fades_within_a_pixel() -> None:
    crops = BoxCrop((8, 8), padding=1.0)(
        torch.ones(1, 1, 4, 4), torch.tensor([[-2.5, -2.0, 5.5, 6.0]]), torch.tensor([0])
    )
    # Positions -2.5, -1.5, -0.5, ... along u and -2, -1, 0, ... along v.
    torch.testing.assert_close(crops[0, 0, 3], torch.tensor([0, 0, 0.5, 1, 1, 1, 0.5, 0]))
    torch.testing.assert_close(crops[0, 0, :, 4], torch.tensor([0.0, 0, 1, 1, 1, 1, 0, 0]))


def test_each_box_reads_its_image_and_images_are_not_copied() -> None:
    # 20 terabytes if anything copied, converted or replicated the images.
    levels = torch.tensor([0, 255, 51], dtype=torch.uint8).view(3, 1, 1, 1).repeat(1, 3, 1, 1)
    images = levels.expand(3, 3, 2**20, 2**20)
    boxes = torch.tensor([[1e5, 1e5, 1.1e5, 1.2e5]]).repeat(4, 1)
    crops = BoxCrop()(images, boxes, torch.tensor([2, 0, 1, 2]))
    torch.testing.assert_close(crops[:, 0, 10, 10], torch.tensor([0.2, 0, 1, 0.2]))
    assert crops.shape == (4, 3, 256, 192)


def test_no_boxes_give_no_crops() -> None:
    crops = BoxCrop()(torch.rand(2, 3, 8, 8), torch.zeros(0, 4), torch.zeros(0, dtype=torch.long))
    assert crops.shape == (0, 3, 256, 192)


def test_constructor_refuses() -> None:
    for arguments in (((0, 192), 1.25), ((256, 192), 0.0), ((256, 192), float("nan")), ((256,), 1.25)):
        with pytest.raises(TensorsimError, match="BoxCrop"):
            BoxCrop(*arguments)  # type: ignore[arg-type]


def test_crops_equal_kornia() -> None:
    import kornia.geometry

    images = torch.rand(2, 3, 60, 80, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    boxes, index = random_boxes(5, 80, 60, torch.float64), torch.arange(5) % 2
    scale, offset = crop_transform(boxes, 32, 24, 1.25)
    warp = torch.zeros(5, 2, 3, dtype=torch.float64)
    warp[:, 0, 0], warp[:, 1, 1], warp[:, :, 2] = 1 / scale[:, 0], 1 / scale[:, 0], -offset / scale
    expected = kornia.geometry.warp_affine(images[index], warp, (32, 24), align_corners=True)
    torch.testing.assert_close(BoxCrop((32, 24))(images, boxes, index), expected, rtol=0, atol=1e-9)
