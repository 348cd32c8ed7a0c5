"""How well keypoints are found: object keypoint similarity and the share of correct keypoints.

Sources: the COCO keypoint evaluation (cocodataset.org, T.-Y. Lin et al., "Microsoft COCO", ECCV 2014) and Y. Yang
and D. Ramanan, "Articulated human detection with flexible mixtures of parts", TPAMI 2013.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from tensorsim.errors import TensorsimError
from tensorsim.training.pose_data import Person, Picture, cut_picture
from tensorsim.training.shards import Floats
from tensorsim.vision.pose2d.topdown import TopDownPose

_FACE = (0.026, 0.025, 0.025, 0.035, 0.035)
_ARMS = (0.079, 0.079, 0.072, 0.072, 0.062, 0.062)
_LEGS = (0.107, 0.107, 0.087, 0.087, 0.089, 0.089)
#: Standard deviation of human annotators per COCO keypoint, relative to the square root of the area.
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


def pck_either_way(found: Tensor, points: Tensor, known: Tensor, side: Tensor, share: float = 0.1) -> Tensor:
    """:func:`pck` of the pairs of left and right keypoints of the body, each pair swapped if that fits better.

    Sides confused in single frames are corrected over time by :class:`~tensorsim.vision.SteadySides`; two keypoints
    on the same leg are not. Only pairs with both keypoints labelled count.
    """
    left, right = found[:, 5::2], found[:, 6::2]
    near = share * side[:, None]

    def right_of(one: Tensor, other: Tensor) -> Tensor:
        straight = (one - points[:, 5::2]).norm(dim=-1) <= near
        return straight.int() + ((other - points[:, 6::2]).norm(dim=-1) <= near).int()

    both = known[:, 5::2] & known[:, 6::2]
    return (torch.maximum(right_of(left, right), right_of(right, left)) * both).sum() / (2 * both.sum())


def evaluate_pose(network: nn.Module, persons: Sequence[Person], quiet: bool = True) -> dict[str, float]:
    """Find the keypoints of people in their boxes, as the pipeline does, and compare them with the labels.

    Args:
        network: a :class:`~tensorsim.vision.TopDownPose`, or crops to heat maps, as
            :class:`~tensorsim.vision.HRNet`; in evaluation mode.
        persons: the people.
        quiet: no progress bar.

    Returns:
        ``oks``, the mean over people; ``pck``, PCK@0.1 over all keypoints; ``pck_body``, without the face;
        ``pck_pairs``, from :func:`pck_either_way`.

    Raises:
        TensorsimError: no people.
    """
    if not persons:
        raise TensorsimError("evaluate_pose: got no people, expected some with labelled keypoints")
    pose = _stage(network)
    bar = tqdm(persons, desc="whole", unit="person", disable=quiet)
    found = [_find(pose, person.sample.image(), person.box)[0] for person in bar]
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
        "pck_pairs": float(pck_either_way(places, points, known, side)),
    }


def evaluate_cut(
    network: nn.Module, persons: Sequence[Person], threshold: float = 0.3, seed: int = 0, quiet: bool = True
) -> dict[str, float]:
    """Cut pictures through the people and check whether the scores show which keypoints are out of sight.

    Args:
        network: as in :func:`evaluate_pose`.
        persons: people to cut (:func:`~tensorsim.training.pose_data.cut_picture`).
        threshold: score from which a keypoint counts as seen.
        seed: seed of the cuts.
        quiet: no progress bar.

    Returns:
        Shares of labelled keypoints with such a score: ``seen`` of those in the picture, ``ghosts`` of those beyond
        its edge. NaN where there are none.
    """
    pose = _stage(network)
    inside, beyond = [torch.zeros(0)], [torch.zeros(0)]
    for index, person in enumerate(tqdm(persons, desc="cut", unit="person", disable=quiet)):
        generator = np.random.default_rng((seed, index))
        image, box, keypoints = cut_picture(person.sample.image(), person.box, person.keypoints, generator)
        v = torch.from_numpy(keypoints[:17, 2])
        if (v >= 0).all():
            continue  # too few labels to cut
        _, scores = _find(pose, np.ascontiguousarray(image), box)
        inside.append((scores[v > 0] >= threshold).float())
        beyond.append((scores[v < 0] >= threshold).float())
    return {"seen": float(torch.cat(inside).mean()), "ghosts": float(torch.cat(beyond).mean())}


def _stage(network: nn.Module) -> TopDownPose:
    """The network as a stage of the pipeline, entirely on the device of its parameters."""
    device = next(iter(network.parameters()), torch.zeros(0)).device
    return (network if isinstance(network, TopDownPose) else TopDownPose(network)).to(device)


def _find(pose: TopDownPose, picture: Picture, box: Floats) -> tuple[Tensor, Tensor]:
    """Keypoints (17, 2) and scores (17,) of the person in a box of a picture, on the CPU."""
    device = next(iter(pose.parameters()), torch.zeros(0)).device
    image = torch.from_numpy(picture).permute(2, 0, 1)[None].to(device)
    boxes = torch.from_numpy(box)[None, None].to(device)
    with torch.no_grad():
        points, scores = pose(image, boxes, torch.ones(1, 1, dtype=torch.bool, device=device))
    return points[0, 0].cpu(), scores[0, 0].cpu()
