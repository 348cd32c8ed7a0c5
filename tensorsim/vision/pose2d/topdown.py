"""Top-down pose estimation: boxes of people in images to COCO-17 keypoints, through crops and heat maps."""

import torch
from torch import Tensor, nn

from tensorsim.config import COCO_KEYPOINTS
from tensorsim.errors import TensorsimError, check_finite, check_rank, check_size
from tensorsim.vision.pose2d.crops import BoxCrop, check_boxes, crop_to_image
from tensorsim.vision.pose2d.heatmaps import HeatmapDecoder

#: For each COCO keypoint, the one that takes its place in a mirror image.
MIRRORED = tuple(
    COCO_KEYPOINTS.index(
        name.replace("left", "right") if name.startswith("left") else name.replace("right", "left")
    )
    for name in COCO_KEYPOINTS
)


class FlipTest(nn.Module):
    """Flip test: a heat-map network runs on the crop and on its mirror image, and the maps are averaged.

    The maps of the mirror image are flipped back, left and right keypoints are exchanged, and the maps are shifted
    right by one pixel: crop pixel 4u is at W - 1 - 4u in the mirror image, whose map flipped back has it at u - 3/4.

    Args:
        network: (N, 3, H, W) -> (N, 17, h, w), as :class:`HRNet`.
    """

    mirrored: Tensor

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("mirrored", torch.tensor(MIRRORED), persistent=False)

    def forward(self, crops: Tensor) -> Tensor:
        """(N, 3, H, W) RGB in [0, 1] -> (N, 17, h, w)."""
        maps = self.network(crops)
        turned = self.network(crops.flip(-1)).flip(-1).index_select(1, self.mirrored)
        turned = torch.cat([turned[..., :1], turned[..., :-1]], -1)
        return (maps + turned) / 2


class TopDownPose(nn.Module):
    """Keypoints of the people in boxes: crop, heat maps, decode, back to the image.

    The network sees valid boxes only, a few at a time, so memory does not grow with the clip.

    Args:
        network: :class:`HRNet`, :class:`OnnxHeatmaps` or any module that maps crops (N, 3, H, W), RGB in [0,
            1], to heat maps (N, 17, H/4, W/4), or H/s and W/s if it has a ``stride`` s, as :class:`CPM`.
        decode: ``"dark"`` or ``"quarter"``, see :class:`HeatmapDecoder`; or a module of its own, what the network gives
            -> (points (N, 17, 2) in pixels of the crop, scores (N, 17)).
        flip_test: average with the mirror image, see :class:`FlipTest`: more accurate, at twice the cost.
        padding: boxes are enlarged by this factor.
        crop_size: (H, W) of the crops; None takes the ``input_size`` of the network, or (256, 192) if it has
            none.
        crops_per_batch: how many crops the network gets at once.

    Raises:
        TensorsimError: arguments out of range; ranks or batch sizes that do not fit; integer boxes; valid boxes that
            are not finite or have no area; NaN in the images of valid boxes.
    """

    def __init__(
        self,
        network: nn.Module,
        decode: str | nn.Module = "dark",
        flip_test: bool = False,
        padding: float = 1.25,
        crop_size: tuple[int, int] | None = None,
        crops_per_batch: int = 32,
    ) -> None:
        super().__init__()
        if crops_per_batch < 1:
            raise TensorsimError(f"TopDownPose: got crops_per_batch {crops_per_batch}, expected at least 1")
        if crop_size is None:
            crop_size = getattr(network, "input_size", (256, 192))
        self.crop = BoxCrop(crop_size, padding)
        self.network = FlipTest(network) if flip_test else network
        if isinstance(decode, str):
            decode = HeatmapDecoder(decode, stride=getattr(network, "stride", 4))
        self.decoder = decode
        self.crops_per_batch = crops_per_batch
        self.keypoints = len(COCO_KEYPOINTS)

    def forward(self, images: Tensor, boxes: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Find the keypoints of each valid box.

        Args:
            images: (B, 3, H, W) RGB, floats in [0, 1] or ``uint8``.
            boxes: (B, P, 4) ``xyxy`` pixels.
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
                f"TopDownPose: got boxes for {boxes.shape[0]} images, expected for {images.shape[0]}"
            )
        if valid.dtype != torch.bool or valid.shape != boxes.shape[:2]:
            raise TensorsimError(
                f"TopDownPose valid: got {valid.dtype} of shape {list(valid.shape)}, "
                f"expected bool of shape {list(boxes.shape[:2])}, one per box"
            )
        people = boxes[valid]
        check_boxes(people, "TopDownPose boxes")
        image_of = valid.nonzero()[:, 0]

        found = [boxes.new_zeros(0, self.keypoints, 2)]
        heights = [boxes.new_zeros(0, self.keypoints)]
        for start in range(0, people.shape[0], self.crops_per_batch):
            some = people[start : start + self.crops_per_batch]
            crops = self.crop(images, some, image_of[start : start + self.crops_per_batch])
            points, scores = self.decoder(self.network(crops))
            found.append(
                crop_to_image(points, some, self.crop.height, self.crop.width, self.crop.padding).to(
                    boxes.dtype
                )
            )
            heights.append(scores.to(boxes.dtype))
        person_scores = torch.cat(heights)
        check_finite(person_scores, "TopDownPose heat maps")

        keypoints = boxes.new_zeros(boxes.shape[0], boxes.shape[1], self.keypoints, 2)
        keypoint_scores = boxes.new_zeros(boxes.shape[0], boxes.shape[1], self.keypoints)
        keypoints[valid] = torch.cat(found)
        keypoint_scores[valid] = person_scores
        return keypoints, keypoint_scores
