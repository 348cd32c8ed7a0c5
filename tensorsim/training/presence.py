"""The recipe of HRNet's presence head, which predicts which keypoints are in the picture; the rest is frozen."""

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.training.loop import Batch
from tensorsim.training.pose import PosePeople, PoseRecipe, by_group
from tensorsim.training.pose_data import CUT_AUGMENTATION, Person
from tensorsim.training.pose_metrics import evaluate_cut
from tensorsim.vision.pose2d.hrnet import HRNet, PresenceHead

#: Shares of people in pictures, in films, with confused sides, and rendered: most where hidden points are best known.
SHARES_PRESENCE = (0.8, 0.2, 0.0, 0.0)
#: Score at which a keypoint is in the picture with even odds; averaging with the mirror image lowers it to 0.3.
EVEN_ODDS = 0.34


def presence_loss(scores: Tensor, known: Tensor, gone: Tensor, sharpness: float = 4.0) -> Tensor:
    """Cross-entropy of classifying keypoints by score as in the picture or beyond its edge.

    The probability of being in the picture is a logistic function of the logarithm of the score, one half at
    :data:`EVEN_ODDS`; keypoints that are neither known nor gone do not count.

    Args:
        scores: (N, 17) heights of the peaks.
        known: (N, 17) bool, in the picture.
        gone: (N, 17) bool, beyond.
        sharpness: slope of the logistic function.
    """
    told = (known | gone).to(scores.dtype)
    logits = sharpness * (scores.clamp_min(1e-3) / EVEN_ODDS).log()
    loss = F.binary_cross_entropy_with_logits(logits, known.to(scores.dtype), told, reduction="sum")
    return loss / told.sum().clamp_min(1)


def with_presence_head(net: HRNet, hidden: int = 128) -> HRNet:
    """The same network with an untrained presence head, which has no effect yet, unless it already has one."""
    if isinstance(net.presence, PresenceHead):
        return net
    other = HRNet(replace(net.config, presence=hidden), net.input_size)
    other.load_state_dict(other.state_dict() | net.state_dict())
    return other


class PresenceRecipe(PoseRecipe):
    """Train only the :class:`~tensorsim.vision.pose2d.hrnet.PresenceHead` of an HRNet.

    Args:
        net: trained network with such a head.
        persons, seed, learning_rate: as for :class:`~tensorsim.training.pose.PoseRecipe`.
        validation: held-out people; the score is the share of seen keypoints in the picture minus the share of seen
            keypoints beyond its edge.

    Raises:
        TensorsimError: a network without such a head, a source without people.
    """

    def __init__(
        self,
        net: HRNet,
        persons: PosePeople,
        validation: dict[str, list[Person]],
        seed: int = 0,
        learning_rate: float = 2e-3,
    ) -> None:
        super().__init__(
            net,
            persons,
            validation,
            None,
            seed,
            learning_rate,
            shares=SHARES_PRESENCE,
            augmentation=CUT_AUGMENTATION,
        )
        if not isinstance(net.presence, PresenceHead):
            raise TensorsimError("PresenceRecipe: got an HRNet without a presence head, expected one with it")
        self.head: nn.Module = net.presence
        for parameter in net.parameters():
            parameter.requires_grad_(False)
        for parameter in self.head.parameters():
            parameter.requires_grad_(True)

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """:func:`presence_loss` of the batch."""
        net.eval()  # the rest of the network, including its statistics, is frozen
        maps = net(batch["crops"].float() / 255).float()
        return {"loss": presence_loss(maps.amax((-2, -1)), batch["known"], batch["gone"])}

    def optimiser(self) -> torch.optim.Optimizer:
        """AdamW for the head."""
        return torch.optim.AdamW(self.head.parameters(), lr=self.learning_rate, weight_decay=0.02)

    def validate(self, net: nn.Module) -> dict[str, float]:
        """Shares of keypoints seen in the picture and beyond its edge, of every held-out group."""
        figures = {name: evaluate_cut(net, persons, EVEN_ODDS) for name, persons in self.validation.items()}
        score = sum(figure["seen"] - figure["ghosts"] for figure in figures.values()) / max(len(figures), 1)
        return by_group(figures) | {"score": score}
