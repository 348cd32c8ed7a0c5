"""Top-down pose estimation: boxes of people in images to COCO-17 keypoints, through crops and heat maps."""

import math

import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import MIRRORED
from tensorsim.config import COCO_KEYPOINTS
from tensorsim.errors import (
    TensorsimError,
    check_count,
    check_finite,
    check_mask,
    check_rank,
    check_size,
    is_exporting,
)
from tensorsim.vision.pose2d.crops import BoxCrop, check_boxes, crop_to_image
from tensorsim.vision.pose2d.heatmaps import HeatmapDecoder

#: Left and right shoulders, elbows, wrists, hips, knees and ankles.
SIDES = tuple((left, left + 1) for left in range(5, 17, 2))


class FlipTest(nn.Module):
    """Flip test: a heat-map network runs on the crop and on its mirror image, and the maps are averaged.

    The maps of the mirror image are flipped back, left and right keypoints are exchanged, and the maps are shifted
    right by 1 - 1/s pixels, linearly interpolated, where maps are s times smaller than crops: crop pixel su is at
    W - 1 - su in the mirror image, whose map flipped back has it at u - 1 + 1/s.

    Args:
        network: (N, 3, H, W) -> (N, 17, H/s, W/s), as :class:`HRNet`.
    """

    mirrored: Tensor

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("mirrored", torch.tensor(MIRRORED), persistent=False)

    def forward(self, crops: Tensor) -> Tensor:
        """(N, 3, H, W) RGB in [0, 1] -> (N, 17, H/s, W/s)."""
        maps = self.network(crops)
        turned = self.network(crops.flip(-1)).flip(-1).index_select(1, self.mirrored)
        shifted = torch.cat([turned[..., :1], turned[..., :-1]], -1)
        shift = 1 - maps.shape[-1] / crops.shape[-1]
        return (maps + (1 - shift) * turned + shift * shifted) / 2


def quarter_turns(keypoints: Tensor) -> Tensor:
    """Quarter turns counter-clockwise, 0 to 3, that bring the trunk of COCO keypoints (..., 17, 2) nearest to upright.

    Returns:
        (...) int64.
    """
    up = keypoints[..., 5:7, :].mean(-2) - keypoints[..., 11:13, :].mean(-2)  # from the hips to the shoulders
    return torch.atan2(up[..., 0], -up[..., 1]).div(math.pi / 2).round().long().remainder(4)


def turn_back(points: Tensor, turns: int, height: int, width: int) -> Tensor:
    """Points (..., 2) of ``rot90(crop, turns)`` to points of the crop, which is of this height and width."""
    u, v = points[..., 0], points[..., 1]
    if turns == 1:
        return torch.stack([width - 1 - v, u], -1)
    if turns == 2:
        return torch.stack([width - 1 - u, height - 1 - v], -1)
    if turns == 3:
        return torch.stack([v, height - 1 - u], -1)
    return points


class TopDownPose(nn.Module):
    """Keypoints of the people in boxes: crop, heat maps, decode, back to the image.

    The network sees valid boxes only, a few at a time, so memory does not grow with the clip.

    Args:
        network: :class:`HRNet`, :class:`OnnxHeatmaps` or any module that maps crops (N, 3, H, W), RGB in [0,
            1], to heat maps (N, 17, H/4, W/4), or H/s and W/s if it has a ``stride`` s, as :class:`CPM`.
        decode: ``"expected"``, ``"dark"`` or ``"quarter"``, see :class:`HeatmapDecoder`; or a module of its own, what
            the network gives -> (points (N, 17, 2) in pixels of the crop, scores (N, 17)).
        flip_test: average with the mirror image, see :class:`FlipTest`: more accurate, at twice the cost.
        padding: boxes are enlarged by this factor.
        crop_size: (H, W) of the crops; None takes the ``input_size`` of the network, or (256, 192) if it has
            none.
        crops_per_batch: how many crops the network gets at once.
        stand_up: crops of people who lean by more than 45 degrees are evaluated again, turned upright by quarter turns,
            and the keypoints with the higher mean score are kept: networks have seen few people lying down. A shoulder
            and a hip must be seen: a person whose hips are outside the picture seems to lean at random.

    Raises:
        TensorsimError: arguments out of range; ranks or batch sizes that do not fit; integer boxes; valid boxes that
            are not finite or have no area; NaN in the images of valid boxes.
    """

    def __init__(
        self,
        network: nn.Module,
        decode: str | nn.Module = "expected",
        flip_test: bool = False,
        padding: float = 1.25,
        crop_size: tuple[int, int] | None = None,
        crops_per_batch: int = 32,
        stand_up: bool = False,
    ) -> None:
        super().__init__()
        check_count(crops_per_batch, "TopDownPose.crops_per_batch")
        if crop_size is None:
            crop_size = getattr(network, "input_size", (256, 192))
        self.crop = BoxCrop(crop_size, padding)
        self.wide_crop = BoxCrop(
            (crop_size[1], crop_size[0]), padding
        )  # to be turned by one quarter or three
        self.network = FlipTest(network) if flip_test else network
        if isinstance(decode, str):
            decode = HeatmapDecoder(decode, stride=getattr(network, "stride", 4), pairs=SIDES)
        self.decoder = decode
        self.crops_per_batch = crops_per_batch
        self.stand_up = stand_up
        self.least_trunk_score = 0.3  # of a shoulder and a hip, for a lean to be trusted
        self.keypoints = len(COCO_KEYPOINTS)

    def forward(self, images: Tensor, boxes: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Find the keypoints of each valid box.

        Args:
            images: (B, 3, H, W) RGB, floats in [0, 1] of any precision or ``uint8``.
            boxes: (B, P, 4) ``xyxy`` pixels, in the precision of the network.
            valid: (B, P) bool.

        Returns:
            Keypoints (B, P, 17, 2), ``uv`` pixels of the image, and scores (B, P, 17), the heights of the
            heat-map peaks; both zero where not valid.
        """
        check_rank(images, 4, "TopDownPose images", "(B, 3, H, W)")
        check_size(images, 1, 3, "TopDownPose images", "(B, 3, H, W)")
        check_rank(boxes, 3, "TopDownPose boxes", "(B, P, 4) xyxy")
        if boxes.shape[0] != images.shape[0]:
            raise TensorsimError(
                f"TopDownPose: got boxes for {boxes.shape[0]} images, expected boxes for {images.shape[0]}"
            )
        check_mask(valid, list(boxes.shape[:2]), "TopDownPose valid")
        people = boxes[valid]
        check_boxes(people, "TopDownPose boxes")
        image_of = valid.nonzero()[:, 0]

        found = [boxes.new_zeros(0, self.keypoints, 2)]
        heights = [boxes.new_zeros(0, self.keypoints)]
        for start in range(0, people.shape[0], self.crops_per_batch):
            some = people[start : start + self.crops_per_batch]
            index = image_of[start : start + self.crops_per_batch]
            points, scores = self.look(images, some, index, 0)
            if self.stand_up and not is_exporting():
                points, scores = self.look_again(images, some, index, points, scores)
            found.append(points)
            heights.append(scores)
        person_scores = torch.cat(heights)
        check_finite(person_scores, "TopDownPose heat maps")

        keypoints = boxes.new_zeros(boxes.shape[0], boxes.shape[1], self.keypoints, 2)
        keypoint_scores = boxes.new_zeros(boxes.shape[0], boxes.shape[1], self.keypoints)
        keypoints[valid] = torch.cat(found)
        keypoint_scores[valid] = person_scores
        return keypoints, keypoint_scores

    def look(self, images: Tensor, boxes: Tensor, index: Tensor, turns: int) -> tuple[Tensor, Tensor]:
        """Keypoints (N, 17, 2) in image pixels and scores (N, 17) of boxes (N, 4), from crops after quarter turns."""
        if turns % 2 == 1:
            crops, height, width = self.wide_crop(images, boxes, index), self.crop.width, self.crop.height
        else:
            crops, height, width = self.crop(images, boxes, index), self.crop.height, self.crop.width
        crops = torch.rot90(crops.to(boxes.dtype), turns, [2, 3])
        points, scores = self.decoder(self.network(crops))
        points = turn_back(points, turns, height, width)
        points = crop_to_image(points, boxes, height, width, self.crop.padding)
        return points.to(boxes.dtype), scores.to(boxes.dtype)

    def look_again(
        self, images: Tensor, boxes: Tensor, index: Tensor, points: Tensor, scores: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Keypoints and scores of boxes, after a second look at those who lean."""
        turns = quarter_turns(points)
        trunk = torch.minimum(scores[:, 5:7].amax(-1), scores[:, 11:13].amax(-1)) >= self.least_trunk_score
        for turn in range(1, 4):
            lean = (trunk & (turns == turn)).nonzero()[:, 0]
            if lean.shape[0] > 0:
                turned, heights = self.look(images, boxes[lean], index[lean], turn)
                better = heights[:, 5:].mean(-1) > scores[lean, 5:].mean(-1)
                rows = lean[better]
                points = points.index_copy(0, rows, turned[better])
                scores = scores.index_copy(0, rows, heights[better])
        return points, scores

    def extra_repr(self) -> str:
        """What print shows besides the submodules."""
        return f"crops_per_batch={self.crops_per_batch}, stand_up={self.stand_up}"
