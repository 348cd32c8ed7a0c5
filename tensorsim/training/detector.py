"""The recipe of the person detector: RTMDet on labelled pictures, frames of films and, if wanted, rendered people."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.geometry.boxes import distances_to_boxes
from tensorsim.training.assign import detection_losses, distillation_loss
from tensorsim.training.detector_data import PictureMaker, Sources
from tensorsim.training.loop import Batch, Recipe, decay_groups
from tensorsim.training.pose_data import lean_deg
from tensorsim.training.shards import Sample, Shards, find_shards, read_coco_shards
from tensorsim.vision.detection.rtmdet import RTMDet

#: Pictures without people that look as if they had some are shown this many times as often as other empty ones.
HARD = 3
#: In the street pictures, heads extend above the boxes by about this share of their height.
PEDESTRIAN_HEAD = 0.18
#: Picture sides, drawn anew for each step; the probabilities give each side about the same total time.
SIDES = (224, 256, 320, 384, 416)
#: Side at which the network is used.
USED_SIDE = 320
#: Overlap above which two boxes are one person: they lie farther apart than those of a network trained for longer.
USED_IOU = 0.5


class TrainedRTMDet(RTMDet):
    """RTMDet whose ``forward`` is the bare network, for training."""

    def forward(self, x: Tensor) -> tuple[list[Tensor], list[Tensor]]:  # type: ignore[override]
        """As :meth:`RTMDet.dense`."""
        return self.dense(x)


def read_sources(data: Path) -> tuple[Sources, list[Sample]]:
    """Training sources, except rendered people, and held-out pictures from a folder of shards.

    Raises:
        TensorsimError: shards are missing, or there are no held-out pictures with people, or none without.
    """
    coco, held_out = read_coco_shards(data)
    held_out = [sample for sample in held_out if sample.all_labelled]
    peopled = sum(len(sample.boxes) > 0 for sample in held_out)
    if not 0 < peopled < len(held_out):
        raise TensorsimError(
            f"{data}: got {len(held_out)} held-out pictures, {peopled} with people, expected some with and some without"
        )
    lspet = list(Shards(find_shards(data, "lspet")))
    street = list(Shards(find_shards(data, "pedestrian")))
    for sample in street:
        sample.boxes[:, 1] -= PEDESTRIAN_HEAD * (sample.boxes[:, 3] - sample.boxes[:, 1])
        np.maximum(sample.boxes, 0, out=sample.boxes)
    standing = [s for s in lspet if len(s.boxes) and abs(lean_deg(s.keypoints[0])) < 35]
    films = Shards(find_shards(data, "films_teacher"))
    empty = [sample for sample in coco if len(sample.boxes) == 0 and sample.all_labelled]
    return Sources(
        complete=[sample for sample in coco if len(sample.boxes) and sample.all_labelled],
        empty=[
            *empty,
            *Shards(find_shards(data, "backgrounds")),
            *HARD * list(Shards(find_shards(data, "coco_hardneg"))),
        ],
        partial=[[s for s in coco if len(s.boxes) and not s.all_labelled], lspet, street],
        films=[sample for sample in films if len(sample.boxes) and sample.all_labelled],
        outlined=standing,
    ), held_out


class DetectorRecipe(Recipe):
    """Train RTMDet for people.

    Args:
        net: the network.
        sources: pictures to train on.
        held_out: pictures to validate on.
        seed: seed of the pictures.
        learning_rate: peak learning rate.
        warm_up: steps until it is reached.
        teacher: a better detector whose outputs in every cell are learnt in addition to the labels; None learns from
            labels only.
    """

    def __init__(
        self,
        net: TrainedRTMDet,
        sources: Sources,
        held_out: list[Sample],
        seed: int = 0,
        learning_rate: float = 1.5e-3,
        warm_up: int = 50,
        teacher: RTMDet | None = None,
    ) -> None:
        settings = {
            "variant": net.variant,
            "seed": seed,
            "learning_rate": learning_rate,
            "people": [len(sources.complete), len(sources.films), len(sources.cutouts)],
            "teacher": None if teacher is None else teacher.variant,
        }
        metadata = {"model": "RTMDet", "variant": net.variant}
        metadata |= {"input_size": str(USED_SIDE), "nms_iou": str(USED_IOU)}
        super().__init__(net, settings, metadata)
        self.detector = net
        self.teacher = None if teacher is None else teacher.to(memory_format=torch.channels_last)
        self.held_out, self.seed, self.learning_rate, self.warm_up = held_out, seed, learning_rate, warm_up
        self.maker = PictureMaker(sources, SIDES[-1])

    def sample(self, index: int) -> dict[str, Any]:
        """A picture: image (3, s, s) uint8 RGB, boxes (n, 4), known (m, m)."""
        import cv2

        cv2.setNumThreads(0)  # the loader's processes already run in parallel
        picture = self.maker(np.random.default_rng([self.seed, index]))
        return {
            "index": index,
            "image": torch.from_numpy(picture.image).permute(2, 0, 1),
            "boxes": torch.from_numpy(picture.boxes),
            "known": torch.from_numpy(picture.known),
        }

    def collate(self, samples: list[dict[str, Any]]) -> Batch:
        """Pictures of the same side: image (B, 3, s, s) in [0, 255], boxes (B, G, 4), valid (B, G), known (B, m, m)."""
        most = max(len(sample["boxes"]) for sample in samples)
        boxes = torch.zeros(len(samples), most, 4)
        valid = torch.zeros(len(samples), most, dtype=torch.bool)
        for i, sample in enumerate(samples):
            boxes[i, : len(sample["boxes"])] = sample["boxes"]
            valid[i, : len(sample["boxes"])] = True
        image = torch.stack([sample["image"] for sample in samples]).float()
        sides = [side for side in SIDES if side < image.shape[-1]] + [image.shape[-1]]
        shares = np.array(sides, float) ** -2
        side = int(
            np.random.default_rng([self.seed, samples[0]["index"], 1]).choice(sides, p=shares / shares.sum())
        )
        if side < image.shape[-1]:
            boxes = boxes * (side / image.shape[-1])
            image = F.interpolate(image, (side, side), mode="bilinear", antialias=True)
        return {
            "image": image,
            "boxes": boxes,
            "valid": valid,
            "known": torch.stack([sample["known"] for sample in samples]),
        }

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Quality focal loss and twice the GIoU loss, plus the distillation loss if there is a teacher."""
        x = ((batch["image"] - self.detector.mean) / self.detector.std).flip(1)
        x = x.contiguous(memory_format=torch.channels_last)
        logits, distances = net(x)
        strides = self.detector.strides
        with torch.autocast(x.device.type, enabled=False):
            boxes = _decoded(distances, strides)
            losses = detection_losses(logits, boxes, strides, batch["boxes"], batch["valid"], batch["known"])
            if self.teacher is not None:
                with torch.no_grad():
                    taught_logits, taught = self.teacher.to(x.device).dense(x.float())
                difference = distillation_loss(
                    _flat(logits), boxes, _flat(taught_logits), _decoded(taught, strides)
                )
                losses |= {"loss": losses["loss"] + difference, "distillation": difference.detach()}
            return losses

    def optimiser(self) -> torch.optim.Optimizer:
        """AdamW; norms and biases do not decay."""
        return torch.optim.AdamW(decay_groups(self.net, 0.05), lr=self.learning_rate)

    def rate(self, step: int, steps: int) -> float:
        """Linear warm-up, constant until half of the steps, then a cosine down to a twentieth."""
        warm = min(1.0, (step + 1) / self.warm_up)
        late = max(0.0, 2 * step / steps - 1)
        return warm * (0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * late)))

    def validate(self, net: nn.Module) -> dict[str, float]:
        """Average precision and recall on the held-out pictures."""
        from tensorsim.training.detector_metrics import measure

        detector = RTMDet(self.detector.variant, input_size=USED_SIDE, nms_iou=USED_IOU).eval()
        detector.load_state_dict(net.state_dict())
        device = next(net.parameters()).device
        figures = measure(detector.to(device), self.held_out)
        return figures | {"score": figures["ap"]}


def _flat(logits: list[Tensor]) -> Tensor:
    """Logits of the first class, people, from the levels (B, classes, h, w) as (B, N)."""
    return torch.cat([level[:, 0].flatten(1) for level in logits], dim=1).float()


def _decoded(distances: list[Tensor], strides: list[int]) -> Tensor:
    """Boxes (B, N, 4) ``xyxy`` of the distances (B, 4, h, w) of the levels."""
    return torch.cat(
        [distances_to_boxes(d.float(), s) for d, s in zip(distances, strides, strict=True)], dim=1
    )
