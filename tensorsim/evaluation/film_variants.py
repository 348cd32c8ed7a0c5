"""Variants of a film that show the same activity: how much a label depends on small changes.

With few labelled films, a single one that is nearly tied between two labels can sway an overall score. The variants
of a film are its mirror image, the film without its first or last quarter of a second, and the film with slightly
displaced keypoints. They are made from the networks' results, so the networks run only once.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tensorsim.body.skeleton import MIRRORED
from tensorsim.types import Tracks

#: Seconds left out at the beginning or at the end.
CUT_S = 0.25
#: Standard deviation of the displacement of keypoints, as a share of the diagonal of the box.
KEYPOINT_ERROR = 0.007
#: Lower bound of the probability of the right label; also counts where the simulation refuses the film.
LEAST_PROBABILITY = 1e-3


class Observed(NamedTuple):
    """What the networks found in a film, at evenly spaced times.

    Attributes:
        tracks: tracks of one clip (B = 1).
        keypoints: (1, P, T, 17, 2) pixels.
        scores: (1, P, T, 17).
        size: (height, width) of the pictures.
        background_px_s: as in :class:`~tensorsim.streaming.Found`.
        camera_steps: (T, 4) of a moving camera, see :func:`~tensorsim.streaming.steps_of_camera`; None for a static
            one.
    """

    tracks: Tracks
    keypoints: Tensor
    scores: Tensor
    size: tuple[int, int]
    background_px_s: float | None = None
    camera_steps: Tensor | None = None


def variants(seen: Observed, fps: float) -> dict[str, Observed]:
    """The unchanged film first, then its variants, by name.

    Args:
        seen: results for the film; one no longer than a second is not shortened.
        fps: frames per second.
    """
    found = {"as it is": seen, "mirrored": mirrored(seen)}
    frames, cut = seen.tracks.valid.shape[2], round(CUT_S * fps)
    if frames > 4 * cut:
        found["begins later"] = _part(seen, slice(cut, None))
        found["ends earlier"] = _part(seen, slice(None, frames - cut))
    for seed in (0, 1):
        found[f"keypoints off, seed {seed}"] = _displaced(seen, seed)
    return found


def mirrored(seen: Observed) -> Observed:
    """What would be found in the mirror image: left and right are swapped, in the picture and on the people."""
    edge = seen.size[1] - 1
    left, top, right, bottom = seen.tracks.boxes.unbind(-1)
    boxes = torch.stack([edge - right, top, edge - left, bottom], -1)
    boxes = torch.where(seen.tracks.valid.unsqueeze(-1), boxes, seen.tracks.boxes)
    order = list(MIRRORED)
    u, v = seen.keypoints[..., order, :].unbind(-1)
    steps = seen.camera_steps
    if steps is not None:
        steps = steps * steps.new_tensor([-1.0, 1.0, -1.0, 1.0])
    return seen._replace(
        tracks=seen.tracks._replace(boxes=boxes),
        keypoints=torch.stack([edge - u, v], -1),
        scores=seen.scores[..., order],
        camera_steps=steps,
    )


def _part(seen: Observed, frames: slice) -> Observed:
    return seen._replace(
        tracks=Tracks(*(part[:, :, frames] for part in seen.tracks)),
        keypoints=seen.keypoints[:, :, frames],
        scores=seen.scores[:, :, frames],
        camera_steps=None if seen.camera_steps is None else seen.camera_steps[frames],
    )


def _displaced(seen: Observed, seed: int) -> Observed:
    boxes = seen.tracks.boxes
    diagonal = (boxes[..., 2:] - boxes[..., :2]).norm(dim=-1)
    noise = torch.randn(seen.keypoints.shape, generator=torch.Generator().manual_seed(seed))
    error = KEYPOINT_ERROR * diagonal[..., None, None] * noise.to(seen.keypoints)
    return seen._replace(keypoints=seen.keypoints + error)


def over_variants(rows: Iterable[Mapping[str, Any]], scene: str) -> tuple[float, float]:
    """Results over the variants of films in a scene.

    Args:
        rows: rows of films with their ``variants``, as in ``films.json``.
        scene: name of the scene.

    Returns:
        How many of the films are right, averaged over their variants, and the mean logarithm of the probability of
        the right labels.
    """
    right, logarithms = 0.0, []
    for row in rows:
        verdicts = [verdict[scene] for verdict in row["variants"].values()]
        right += sum(verdict["right"] for verdict in verdicts) / len(verdicts)
        logarithms += [math.log(max(verdict["right_probability"], LEAST_PROBABILITY)) for verdict in verdicts]
    return right, sum(logarithms) / len(logarithms)
