"""How well keypoints are found: object keypoint similarity and the share of correct keypoints.

Sources: the COCO keypoint evaluation (cocodataset.org, T.-Y. Lin et al., "Microsoft COCO", ECCV 2014) and Y. Yang
and D. Ramanan, "Articulated human detection with flexible mixtures of parts", TPAMI 2013.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.training.pose_data import Person
from tensorsim.vision.topdown import TopDownPose

_FACE = (0.026, 0.025, 0.025, 0.035, 0.035)
_ARMS = (0.079, 0.079, 0.072, 0.072, 0.062, 0.062)
_LEGS = (0.107, 0.107, 0.087, 0.087, 0.089, 0.089)
#: Standard deviation of human annotators per COCO keypoint, in roots of the area.
SIGMAS = (*_FACE, *_ARMS, *_LEGS)


def oks(found: Tensor, points: Tensor, known: Tensor, area: Tensor) -> Tensor:
    """Object keypoint similarity: mean over labelled keypoints i of ``exp(-d_i^2 / (2 area (2 sigma_i)^2))``.

    Args:
        found: (..., 17, 2) pixels.
        points: (..., 17, 2) labelled ones.
        known: (..., 17) bool.
        area: (...) pixels that show the person.

    Returns:
        (...), NaN for people without a labelled keypoint.
    """
    variance = (2 * torch.tensor(SIGMAS, dtype=found.dtype, device=found.device)) ** 2
    similarity = torch.exp(-((found - points) ** 2).sum(-1) / (2 * area.unsqueeze(-1) * variance))
    return (similarity * known).sum(-1) / known.sum(-1)


def pck(found: Tensor, points: Tensor, known: Tensor, side: Tensor, share: float = 0.1) -> Tensor:
    """Share of labelled keypoints found within ``share`` of the longer side of the box.

    Args:
        found: (N, 17, 2) pixels.
        points: (N, 17, 2) labelled ones.
        known: (N, 17) bool.
        side: (N,) longer sides of the boxes.
        share: the tolerance.

    Returns:
        A scalar over all keypoints of all people, NaN where none is labelled.
    """
    right = (found - points).norm(dim=-1) <= share * side.unsqueeze(-1)
    return (right & known).sum() / known.sum()


def evaluate_pose(network: nn.Module, persons: Sequence[Person]) -> dict[str, float]:
    """Find the keypoints of people in their boxes, as the pipeline does, and compare with the labels.

    Args:
        network: a :class:`~tensorsim.vision.topdown.TopDownPose`, or crops to heat maps, as
            :class:`~tensorsim.vision.hrnet.HRNet`; in evaluation mode.
        persons: whom to look for.

    Returns:
        ``oks``, the mean over people; ``pck``, PCK@0.1 over all keypoints; ``pck_body``, without the face.

    Raises:
        TensorsimError: nobody to look for.
    """
    if not persons:
        raise TensorsimError("evaluate_pose: got no people, expected some with labelled keypoints")
    device = next(iter(network.parameters()), torch.zeros(0)).device
    pose = (network if isinstance(network, TopDownPose) else TopDownPose(network)).to(device)
    found = []
    with torch.no_grad():
        for person in persons:
            image = torch.from_numpy(person.sample.image()).permute(2, 0, 1)[None].to(device)
            box = torch.from_numpy(person.box)[None, None].to(device)
            found.append(pose(image, box, torch.ones(1, 1, dtype=torch.bool, device=device))[0][0, 0].cpu())
    labels = torch.from_numpy(np.stack([person.keypoints[:17] for person in persons]))
    points, known = labels[..., :2], labels[..., 2] > 0
    boxes = torch.from_numpy(np.stack([person.box for person in persons]))
    side = (boxes[:, 2:] - boxes[:, :2]).amax(-1)
    area = torch.tensor([person.area for person in persons])
    places = torch.stack(found)
    return {
        "oks": float(oks(places, points, known, area).mean()),
        "pck": float(pck(places, points, known, side)),
        "pck_body": float(pck(places[:, 5:], points[:, 5:], known[:, 5:], side)),
    }
