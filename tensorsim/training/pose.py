"""The recipe of the pose network: HRNet on crops of labelled and rendered people.

From few pictures and without weights from elsewhere, plain mean squared error on heat maps leads to maps that are
zero everywhere. Here the foreground counts more, and the maps are compared as distributions over places as well,
whose gradient does not vanish where the answer is far off.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.training.loop import Batch, Recipe
from tensorsim.training.pose_data import Augmentation, Person, RenderedPeople, crop_person, lean_deg
from tensorsim.training.pose_metrics import evaluate_pose
from tensorsim.vision.pose2d.hrnet import HRNet
from tensorsim.vision.pose2d.topdown import MIRRORED

STRIDE = 4  # crop pixels per heat-map pixel
#: Share of the pictures of each source that are never trained on, see :func:`tensorsim.training.pose_data.split`.
HELD_OUT_PERCENT = {"coco_small": 15, "lspet": 3}


def gaussian_maps(points: Tensor, size: tuple[int, int], sigma: float) -> Tensor:
    """Heat maps (..., h, w) with a Gaussian of peak 1 and this sigma, in map pixels, at points (..., 2) of the maps.

    The peak is where the point is, between the pixels (as DARK has it, :mod:`tensorsim.vision.pose2d.heatmaps`).
    """
    v = torch.arange(size[0], dtype=points.dtype, device=points.device)
    u = torch.arange(size[1], dtype=points.dtype, device=points.device)
    across = torch.exp(-((u - points[..., 0:1]) ** 2) / (2 * sigma**2))
    down = torch.exp(-((v - points[..., 1:2]) ** 2) / (2 * sigma**2))
    return down.unsqueeze(-1) * across.unsqueeze(-2)


def heatmap_loss(
    maps: Tensor, targets: Tensor, foreground: float = 20.0, sharpness: float = 10.0, places: float = 0.1
) -> Tensor:
    """What heat maps (..., h, w) cost, per map (...); zero where they equal the targets.

    ``sum_x (1 + foreground t) (m - t)^2 / sum_x t^2`` and, weighted with ``places``, the Kullback-Leibler divergence
    of ``softmax(sharpness m)`` from ``softmax(sharpness t)`` over places x. Both have their minimum at m = t.
    """
    energy = (targets**2).sum((-2, -1)).clamp_min(1.0)
    squares = ((1 + foreground * targets) * (maps - targets) ** 2).sum((-2, -1)) / energy
    told = F.log_softmax(sharpness * maps.flatten(-2), -1)
    wanted = F.log_softmax(sharpness * targets.flatten(-2), -1)
    divergence = (wanted.exp() * (wanted - told)).sum(-1)
    return squares / (1 + foreground) + places * divergence


def person_loss(
    maps: Tensor, points: Tensor, known: Tensor, gone: Tensor, sided: Tensor, sigma: float
) -> Tensor:
    """Mean loss over the keypoints of each person that are known or gone (N,), zero where none is.

    The map of a keypoint that is gone should be zero: where the picture ends within a person, low peaks then tell
    which part of the body is out of sight.

    Where ``sided`` is false, left and right may have been confused by who labelled: then the loss against labels
    with sides exchanged is taken instead if it is less than half as large, which a network reaches only once it
    tells the sides by itself.

    Args:
        maps: (N, 17, h, w).
        points: (N, 17, 2) crop pixels.
        known: (N, 17) bool.
        gone: (N, 17) bool, none of them known.
        sided: (N,) bool.
        sigma: of the targets, map pixels.
    """
    size = (maps.shape[-2], maps.shape[-1])

    def mean_loss(points: Tensor, known: Tensor, gone: Tensor) -> Tensor:
        targets = gaussian_maps(points / STRIDE, size, sigma) * known[..., None, None]
        told = known | gone
        return (heatmap_loss(maps, targets) * told).sum(-1) / told.sum(-1).clamp_min(1)

    mirrored = list(MIRRORED)
    straight = mean_loss(points, known, gone)
    exchanged = mean_loss(points[:, mirrored], known[:, mirrored], gone[:, mirrored])
    return torch.where(~sided & (exchanged < 0.5 * straight), exchanged, straight)


class PoseRecipe(Recipe):
    """Train :class:`~tensorsim.vision.HRNet` on people from three sources.

    Args:
        net: the network, for crops of its ``input_size``.
        sided: people whose left and right labels hold.
        unsided: people whose left and right are sometimes confused.
        validation: held-out people by name; the mean of their OKS is the score.
        rendered: people with exact labels, face included; None leaves them out.
        seed: of the stream of samples.
        learning_rate: the highest.
        sigma: of the targets, in heat-map pixels.
        first_size: (H, W) of the crops of the first ``first_samples`` samples: smaller ones teach faster.
        first_samples: how many; 0 trains at the network's size from the start.
        shares: of ``sided``, ``unsided`` and ``rendered`` in the stream.
        augmentation: of the crops.

    Raises:
        TensorsimError: a source without people.
    """

    def __init__(
        self,
        net: HRNet,
        sided: Sequence[Person],
        unsided: Sequence[Person],
        validation: dict[str, list[Person]],
        rendered: RenderedPeople | None = None,
        seed: int = 0,
        learning_rate: float = 2e-3,
        sigma: float = 1.5,
        first_size: tuple[int, int] = (96, 64),
        first_samples: int = 0,
        shares: tuple[float, float, float] = (0.2, 0.55, 0.25),
        augmentation: Augmentation | None = None,
    ) -> None:
        self.augmentation = Augmentation() if augmentation is None else augmentation
        height, width = net.input_size
        settings = {
            "people": [len(sided), len(unsided), 0 if rendered is None else len(rendered)],
            "input_size": [height, width],
            "seed": seed,
            "learning_rate": learning_rate,
            "sigma": sigma,
            "first_size": list(first_size),
            "first_samples": first_samples,
            "shares": list(shares),
            "augmentation": asdict(self.augmentation),
        }
        super().__init__(net, settings, {"input_size": f"{height}x{width}"})
        self.input_size, self.first_size, self.first_samples = net.input_size, first_size, first_samples
        self.sided, self.unsided, self.rendered, self.validation = sided, unsided, rendered, validation
        self.seed, self.learning_rate, self.sigma = seed, learning_rate, sigma
        sizes = np.array(settings["people"])
        self.shares = np.where(sizes > 0, shares, 0.0)
        if not self.shares.sum() > 0:
            raise TensorsimError("PoseRecipe: got nobody to train on, expected people from some source")
        self.shares /= self.shares.sum()
        # People who stand count more: they are what is filmed.
        upright = np.array([1.0 + 2.0 * (abs(lean_deg(person.keypoints)) < 30) for person in unsided])
        self.upright = upright / upright.sum() if len(upright) else upright
        self.colours: nn.Module | None = None

    def sample(self, index: int) -> dict[str, Any]:
        """A crop (3, h, w) uint8, its points (17, 2), which are known and which gone (17,), whether sides hold."""
        generator = np.random.default_rng((self.seed, index))
        size = self.first_size if index < self.first_samples else self.input_size
        source = int(generator.choice(3, p=self.shares))
        if source == 2 and self.rendered is not None:
            number = int(generator.integers(len(self.rendered)))
            crop = self.rendered.crop(number, size, self.augmentation, generator)
        else:
            if source == 0:
                person = self.sided[int(generator.integers(len(self.sided)))]
            else:
                person = self.unsided[int(generator.choice(len(self.unsided), p=self.upright))]
            crop = crop_person(
                person.sample.image(),
                person.box,
                person.keypoints,
                size,
                self.augmentation,
                generator,
            )
        return {
            "crops": np.ascontiguousarray(crop.image.transpose(2, 0, 1)),
            "points": crop.points,
            "known": crop.known,
            "gone": crop.gone,
            "sided": source != 1,
        }

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Mean over the batch of :func:`person_loss`, on crops whose colours are changed and patches hidden."""
        if self.colours is None:
            self.colours = colour_changes()
        with torch.no_grad(), torch.autocast(batch["crops"].device.type, enabled=False):
            crops = self.colours(batch["crops"].float() / 255)
        maps = net(crops.contiguous(memory_format=torch.channels_last)).float()
        losses = person_loss(maps, batch["points"], batch["known"], batch["gone"], batch["sided"], self.sigma)
        return {"loss": losses.mean()}

    def optimiser(self) -> torch.optim.Optimizer:
        """AdamW; no decay of biases and normalisation."""
        parameters = list(self.net.parameters())
        return torch.optim.AdamW(
            [
                {"params": [p for p in parameters if p.ndim > 1], "weight_decay": 0.02},
                {"params": [p for p in parameters if p.ndim <= 1], "weight_decay": 0.0},
            ],
            lr=self.learning_rate,
        )

    def rate(self, step: int, steps: int) -> float:
        """Linear warm-up over a fiftieth, then a cosine down to a hundredth."""
        progress = step / steps
        return min(1.0, (step + 1) / (0.02 * steps)) * (0.505 + 0.495 * math.cos(math.pi * progress))

    def validate(self, net: nn.Module) -> dict[str, float]:
        """OKS and PCK of every held-out group."""
        figures = {name: evaluate_pose(net, persons) for name, persons in self.validation.items()}
        score = sum(figure["oks"] for figure in figures.values()) / max(len(figures), 1)
        return {f"{name}_{k}": v for name, figure in figures.items() for k, v in figure.items()} | {
            "score": score
        }


def colour_changes() -> nn.Module:
    """Random light, colour, focus and hidden patches of a batch of crops (N, 3, h, w) in [0, 1]."""
    import kornia.augmentation as augmentation

    return nn.Sequential(
        augmentation.ColorJitter(0.4, 0.4, 0.4, 0.0, p=0.9),
        augmentation.RandomPlanckianJitter("blackbody", p=0.4),
        augmentation.RandomGrayscale(p=0.1),
        augmentation.RandomGaussianBlur((5, 5), (0.3, 1.5), p=0.2),
        augmentation.RandomErasing((0.02, 0.12), (0.4, 2.5), value=0.4, p=0.4),
    )
