"""The recipe of the pose networks: HRNet or CPM on crops of labelled people and, optionally, rendered ones.

With few pictures and no pretrained weights, plain mean squared error on heat maps leads to maps that are zero
everywhere. Here the foreground has more weight, and the maps are also compared as distributions over places, whose
gradient does not vanish where the peak is far off.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.body.skeleton import MIRRORED
from tensorsim.errors import TensorsimError
from tensorsim.files import sha256_of
from tensorsim.training.colours import Picture, recoloured
from tensorsim.training.loop import Batch, Recipe, decay_groups
from tensorsim.training.pose_data import (
    Augmentation,
    Person,
    RenderedPeople,
    crop_person,
    cut_by_the_picture,
    large,
    lean_deg,
    people,
    upright,
)
from tensorsim.training.pose_metrics import evaluate_pose
from tensorsim.training.second_labels import put_right, read_results
from tensorsim.training.shards import Shards, find_shards, read_coco_shards, split
from tensorsim.vision.pose2d.cpm import CPM
from tensorsim.vision.pose2d.hrnet import HRNet
from tensorsim.vision.pose2d.onnx_heatmaps import OnnxHeatmaps

#: Percentage of the LSPE pictures that is never trained on, see :func:`tensorsim.training.shards.split`.
LSPET_HELD_OUT_PERCENT = 3
#: Shares in the stream of samples: groups of :class:`PosePeople` in its order, then rendered people.
SHARES = (0.5, 0.15, 0.3, 0.12)
#: The same if most people of LSPE are confirmed by second labels, and so belong to the first group.
SHARES_CONFIRMED = (0.75, 0.12, 0.05, 0.1)
#: Largest distance of a teacher's peak from a label that it agrees with, relative to the height of the map.
AGREED = 0.0625
#: Share of a person's labels that must agree with the teacher before it is trusted for other keypoints.
CONFIRMED = 0.6


class PosePeople(NamedTuple):
    """People to train on.

    Attributes:
        sided: people with reliable left and right labels.
        films: people in frames of films, labelled by another network.
        unsided: people whose left and right labels are sometimes confused.
    """

    sided: Sequence[Person]
    films: Sequence[Person]
    unsided: Sequence[Person]


def read_people(data: Path, second_labels: Path | None = None) -> PosePeople:
    """The people to train on from a folder of shards.

    Args:
        data: the folder.
        second_labels: keypoints of the people of LSPE by another network (:mod:`tensorsim.training.second_labels`);
            people whom it confirms join those with reliable left and right labels.

    Raises:
        TensorsimError: shards are missing; the file does not hold keypoints, or none of people in the shards.
    """
    results = None if second_labels is None else read_results(second_labels)
    sided = people(read_coco_shards(data)[0])
    films = people(Shards(find_shards(data, "films_teacher")))
    for person in films:
        # The labelling network omits only keypoints beyond the edge of the picture.
        body = person.keypoints[:17]
        body[body[:, 2] == 0, 2] = -1
    unsided = people(split(Shards(find_shards(data, "lspet")), LSPET_HELD_OUT_PERCENT)[0])
    if results is not None:
        confirmed, unsided = put_right(unsided, results)
        if not confirmed:
            raise TensorsimError(
                f"{second_labels}: confirms nobody, expected image_id and bbox of the people of lspet-*.tar"
            )
        sided = sided + confirmed
    return PosePeople(sided, films, unsided)


def held_out_people(data: Path) -> dict[str, list[Person]]:
    """The people from a folder of shards who are never trained on, by the name of their group.

    Raises:
        TensorsimError: shards are missing.
    """
    coco = people(read_coco_shards(data)[1])
    lspet = people(split(Shards(find_shards(data, "lspet")), LSPET_HELD_OUT_PERCENT)[1])
    return {"COCO": coco, "COCO, large": large(coco), "LSPE": lspet, "LSPE, upright": upright(lspet)}


def gaussian_maps(points: Tensor, size: tuple[int, int], sigma: float) -> Tensor:
    """Heat maps (..., h, w) with a Gaussian of peak 1 and this sigma, in map pixels, at points (..., 2) of the maps.

    The peak is exactly at the point, not rounded to a pixel (as in DARK, :mod:`tensorsim.vision.pose2d.heatmaps`).
    """
    v = torch.arange(size[0], dtype=points.dtype, device=points.device)
    u = torch.arange(size[1], dtype=points.dtype, device=points.device)
    across = torch.exp(-((u - points[..., 0:1]) ** 2) / (2 * sigma**2))
    down = torch.exp(-((v - points[..., 1:2]) ** 2) / (2 * sigma**2))
    return down.unsqueeze(-1) * across.unsqueeze(-2)


def heatmap_loss(
    maps: Tensor,
    targets: Tensor,
    emphasis: Tensor | None = None,
    foreground: float = 20.0,
    sharpness: float = 10.0,
    places: float = 0.1,
) -> Tensor:
    """Loss of heat maps (..., h, w), per map (...); zero where they equal the targets.

    ``sum_x (1 + foreground e) (m - t)^2 / ((1 + foreground) max(sum_x t^2, 1))`` and, weighted with ``places``, the
    Kullback-Leibler divergence of ``softmax(sharpness m)`` from ``softmax(sharpness t)`` over places x. Both have their
    minimum at m = t. The emphasis e, in [0, 1], is t itself unless given.
    """
    emphasis = targets if emphasis is None else emphasis
    energy = (targets**2).sum((-2, -1)).clamp_min(1.0)
    squares = ((1 + foreground * emphasis) * (maps - targets) ** 2).sum((-2, -1)) / energy
    told = F.log_softmax(sharpness * maps.flatten(-2), -1)
    wanted = F.log_softmax(sharpness * targets.flatten(-2), -1)
    divergence = (wanted.exp() * (wanted - told)).sum(-1)
    return squares / (1 + foreground) + places * divergence


def person_loss(
    maps: Tensor,
    points: Tensor,
    known: Tensor,
    gone: Tensor,
    rivals: Tensor,
    sided: Tensor,
    sigma: float,
    stride: int = 4,
) -> Tensor:
    """Mean loss over the keypoints of each person that are known or gone (N,), zero where none is.

    The map of a keypoint that is gone should be zero: where a person is cut off by the picture, low peaks then show
    which part of the body is out of sight. At the same keypoint of another person, zeros have as much weight as the
    peak.

    Where ``sided`` is false, annotators may have confused left and right: the loss against labels with the sides
    swapped is used instead if it is less than half as large, which happens only once the network itself can
    distinguish the sides.

    Args:
        maps: (N, 17, h, w).
        points: (N, 17, 2) crop pixels.
        known: (N, 17) bool.
        gone: (N, 17) bool, none of them known.
        rivals: (N, M, 17, 2) crop pixels, keypoints of M others; far outside where there are none.
        sided: (N,) bool.
        sigma: sigma of the targets, map pixels.
        stride: crop pixels per map pixel.
    """
    size = (maps.shape[-2], maps.shape[-1])
    others = (
        gaussian_maps(rivals / stride, size, sigma).amax(1) if rivals.shape[1] else torch.zeros_like(maps)
    )

    def mean_loss(points: Tensor, known: Tensor, gone: Tensor) -> Tensor:
        targets = gaussian_maps(points / stride, size, sigma) * known[..., None, None]
        told = known | gone
        losses = heatmap_loss(maps, targets, torch.maximum(targets, others))
        return (losses * told).sum(-1) / told.sum(-1).clamp_min(1)

    straight = mean_loss(points, known, gone)
    if bool(sided.all()):
        return straight
    mirrored = list(MIRRORED)
    exchanged = mean_loss(points[:, mirrored], known[:, mirrored], gone[:, mirrored])
    return torch.where(~sided & (exchanged < 0.5 * straight), exchanged, straight)


def sharpened(maps: Tensor, sigma: float, of_teacher: float = 2.0) -> Tensor:
    """Heat maps (..., h, w) with their Gaussian peaks narrowed to ``sigma`` map pixels, at the same height.

    ``h (m / h)^((s / sigma)^2)``, where h is the height of the map m and s is ``of_teacher``, its present sigma: by
    default that of B. Xiao et al., "Simple baselines for human pose estimation and tracking", ECCV 2018.
    """
    maps = maps.clamp(0, 1)
    heights = maps.amax((-2, -1), keepdim=True).clamp_min(1e-6)
    return heights * (maps / heights) ** ((of_teacher / sigma) ** 2)


def distillation_loss(maps: Tensor, taught: Tensor, points: Tensor, known: Tensor, gone: Tensor) -> Tensor:
    """Distance of maps from a teacher's (N,): mean :func:`heatmap_loss` over the keypoints for which it is trusted.

    These are the known keypoints with a label within :data:`AGREED` of the peak of the teacher's map, which is then
    scaled to a height of 1; and for people with at least :data:`CONFIRMED` of their known keypoints among these, also
    the keypoints that are neither known nor gone.

    Args:
        maps: (N, 17, h, w).
        taught: (N, 17, h, w), the teacher's.
        points: (N, 17, 2) map pixels.
        known: (N, 17) bool.
        gone: (N, 17) bool, none of them known.
    """
    height, width = maps.shape[-2:]
    peaks = taught.flatten(-2).argmax(-1)
    places = torch.stack([peaks % width, peaks // width], -1).to(points.dtype)
    agreed = known & ((places - points).norm(dim=-1) <= AGREED * height)
    confirmed = agreed.sum(-1) >= CONFIRMED * known.sum(-1).clamp_min(1)
    told = agreed | (confirmed[:, None] & ~known & ~gone)
    heights = torch.where(agreed, taught.amax((-2, -1)), 1.0).clamp_min(1e-3)
    taught = taught / heights[..., None, None]
    return (heatmap_loss(maps, taught) * told).sum(-1) / told.sum(-1).clamp_min(1)


class TrainedCPM(CPM):
    """CPM that returns the maps of all stages in training, (S, N, 17, h, w), because every stage is supervised."""

    def forward(self, crops: Tensor) -> Tensor:
        """Maps of all stages in training, else those of the last stage."""
        stages = self.stages(crops)
        return torch.stack(stages) if self.training else stages[-1]


class PoseRecipe(Recipe):
    """Train :class:`~tensorsim.vision.HRNet` or :class:`~tensorsim.vision.CPM` on people from four sources.

    Args:
        net: the network, for crops of its ``input_size``.
        persons: people to train on.
        validation: groups of held-out people by name; the mean of their OKS is the score.
        rendered: people with exact labels, face included; None leaves them out.
        seed: seed of the stream of samples.
        learning_rate: peak learning rate.
        sigma: sigma of the targets, in heat-map pixels.
        first_size: (H, W) of the crops of the first ``first_samples`` samples: smaller ones train faster.
        first_samples: number of these samples; 0 trains at the network's size from the start.
        shares: relative shares of ``sided``, ``films``, ``unsided`` and ``rendered`` in the stream.
        augmentation: augmentation of the crops.
        teacher: a better network, crops to heat maps of the same size, whose outputs HRNet learns in addition to the
            labels; None learns from labels only.

    Raises:
        TensorsimError: a source without people.
    """

    def __init__(
        self,
        net: HRNet | TrainedCPM,
        persons: PosePeople,
        validation: dict[str, list[Person]],
        rendered: RenderedPeople | None = None,
        seed: int = 0,
        learning_rate: float = 2e-3,
        sigma: float = 1.5,
        first_size: tuple[int, int] = (96, 64),
        first_samples: int = 0,
        shares: tuple[float, float, float, float] = SHARES,
        augmentation: Augmentation | None = None,
        teacher: OnnxHeatmaps | None = None,
    ) -> None:
        self.augmentation = Augmentation() if augmentation is None else augmentation
        height, width = net.input_size
        self.groups: list[Sequence[Person]] = [persons.sided, persons.films, persons.unsided]
        sizes = [*(len(group) for group in self.groups), 0 if rendered is None else len(rendered)]
        settings = {
            "people": [*sizes],
            "input_size": [height, width],
            "seed": seed,
            "learning_rate": learning_rate,
            "sigma": sigma,
            "first_size": list(first_size),
            "first_samples": first_samples,
            "shares": list(shares),
            "augmentation": asdict(self.augmentation),
            "teacher": None if teacher is None else sha256_of(teacher.path),
        }
        network = "CPM" if isinstance(net, CPM) else "HRNet"
        super().__init__(net, settings, {"network": network, "input_size": f"{height}x{width}"})
        self.teacher = teacher
        self.stride = getattr(net, "stride", 4)
        self.input_size, self.first_size, self.first_samples = net.input_size, first_size, first_samples
        self.rendered, self.validation = rendered, validation
        self.seed, self.learning_rate, self.sigma = seed, learning_rate, sigma
        self.shares = np.where(np.array(sizes) > 0, shares, 0.0)
        if not self.shares.sum() > 0:
            raise TensorsimError(
                "PoseRecipe: got no people to train on, expected some from at least one source"
            )
        self.shares /= self.shares.sum()
        self.weights = [_weights(group) for group in self.groups]

    def sample(self, index: int) -> dict[str, Any]:
        """A crop (3, h, w) uint8, its points and rivals, which are known and which gone, whether sides are reliable.

        With a teacher, also its maps (17, h/4, w/4), computed here by the processes that prepare samples.
        """
        import cv2

        cv2.setNumThreads(0)  # the loader's processes already run in parallel
        generator = np.random.default_rng((self.seed, index))
        size = self.first_size if index < self.first_samples else self.input_size
        source = int(generator.choice(len(self.shares), p=self.shares))
        if source == 3 and self.rendered is not None:
            number = int(generator.integers(len(self.rendered)))
            crop = self.rendered.crop(number, size, self.augmentation, generator)
        else:
            group = self.groups[source]
            person = group[int(generator.choice(len(group), p=self.weights[source]))]
            image = person.sample.image()
            keypoints = person.keypoints
            if source == 0:
                keypoints = cut_by_the_picture(image, person.box, keypoints)
            crop = crop_person(
                image, person.box, keypoints, size, self.augmentation, generator, person.others
            )
        image = covered(recoloured(crop.image, generator), generator)
        pixels = np.ascontiguousarray(image.transpose(2, 0, 1))
        taught = {}
        if self.teacher is not None:
            with torch.inference_mode():
                found = self.teacher(torch.from_numpy(pixels)[None].float() / 255)[0]
            taught = {"taught": sharpened(found, self.sigma).half().numpy()}
        return taught | {
            "crops": pixels,
            "points": crop.points,
            "known": crop.known,
            "gone": crop.gone,
            "rivals": crop.rivals,
            "sided": source != 2,
        }

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Mean of :func:`person_loss` over the batch and the stages of CPM; with a teacher, plus
        :func:`distillation_loss`."""
        crops = batch["crops"].float() / 255
        maps = net(crops.contiguous(memory_format=torch.channels_last)).float()
        labels = {name: batch[name] for name in ("points", "known", "gone", "rivals", "sided")}
        stages = maps if maps.dim() == 5 else maps[None]
        losses = [
            person_loss(of_stage, **labels, sigma=self.sigma, stride=self.stride) for of_stage in stages
        ]
        loss = torch.stack(losses).mean()
        if self.teacher is None:
            return {"loss": loss}
        told = (batch["taught"].float(), batch["points"] / self.stride, batch["known"], batch["gone"])
        difference = distillation_loss(maps, *told).mean()
        return {"loss": loss + difference, "distillation": difference.detach()}

    def optimiser(self) -> torch.optim.Optimizer:
        """AdamW; no decay of biases and normalisation."""
        return torch.optim.AdamW(decay_groups(self.net, 0.02), lr=self.learning_rate)

    def rate(self, step: int, steps: int) -> float:
        """Linear warm-up over a fiftieth, then a cosine down to a hundredth."""
        progress = step / steps
        return min(1.0, (step + 1) / (0.02 * steps)) * (0.505 + 0.495 * math.cos(math.pi * progress))

    def validate(self, net: nn.Module) -> dict[str, float]:
        """OKS and PCK of every held-out group."""
        figures = {name: evaluate_pose(net, persons) for name, persons in self.validation.items()}
        score = sum(figure["oks"] for figure in figures.values()) / max(len(figures), 1)
        return by_group(figures) | {"score": score}


def by_group(figures: dict[str, dict[str, float]]) -> dict[str, float]:
    """The scores of groups of people in one table."""
    return {f"{name}_{k}": v for name, figure in figures.items() for k, v in figure.items()}


def _weights(persons: Sequence[Person]) -> npt.NDArray[np.float64]:
    """Probability of drawing each person: higher for upright people, as in films, and for those next to others."""
    standing = np.array([abs(lean_deg(person.keypoints)) < 30 for person in persons], float)
    beside = np.array([(person.others[..., 2] > 0).any() for person in persons], float)
    weights = 1 + standing + beside
    return weights / max(weights.sum(), 1)


def covered(image: Picture, generator: np.random.Generator) -> Picture:
    """A crop (h, w, 3), sometimes with a rectangle of one colour over a part of it, in place."""
    if generator.random() < 0.35:
        size = np.array(image.shape[:2])
        extent = (size * np.exp(generator.uniform(np.log(0.12), np.log(0.45), 2))).astype(int) + 1
        top, left = (generator.random(2) * (size - extent)).astype(int)
        image[top : top + extent[0], left : left + extent[1]] = generator.integers(0, 256, 3)
    return image
