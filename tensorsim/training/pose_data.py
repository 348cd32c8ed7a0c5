"""Crops of people to train a pose network on: labelled pictures and rendered people, rotated, scaled and mirrored.

Crops follow :mod:`tensorsim.vision.pose2d.crops`: pixel centres are at integers, and without augmentation a crop is
that of :class:`~tensorsim.vision.pose2d.crops.BoxCrop` for the person's box.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tensorsim.body.skeleton import MIRRORED
from tensorsim.config import COCO_KEYPOINTS
from tensorsim.errors import TensorsimError
from tensorsim.training.colours import Picture, over, premultiplied
from tensorsim.training.cutouts import Cutouts
from tensorsim.training.shards import Floats, Sample

Doubles = npt.NDArray[np.float64]

PADDING = 1.25  # of the boxes, as in TopDownPose
_SHOULDERS, _HIPS = (5, 6), (11, 12)
_UPPER, _LOWER, _LEGS = tuple(range(13)), tuple(range(11, 17)), tuple(range(13, 17))
#: Number of neighbours whose keypoints the network is to keep apart from those of a person.
NEIGHBOURS = 2
_FAR = -1e4


class Person(NamedTuple):
    """A labelled person in a picture.

    Attributes:
        sample: the picture.
        box: (4,) ``xyxy`` pixels.
        keypoints: (17 or 19, 3): x, y and v; neck and top of the head, if given, help to find the box of a rotated
            person.
        area: pixels that show the person.
        others: (NEIGHBOURS, 17, 3): keypoints of the people who overlap most; zero where there are none.
    """

    sample: Sample
    box: Floats
    keypoints: Floats
    area: float
    others: Floats = np.zeros((0, 17, 3), np.float32)


class Crop(NamedTuple):
    """The input of the network and its targets.

    Attributes:
        image: (h, w, 3) uint8 RGB.
        points: (17, 2) float32, crop pixels.
        known: (17,) bool, labelled and inside the crop.
        gone: (17,) bool, labelled but cut off: they are not visible in the crop.
        rivals: (NEIGHBOURS, 17, 2) float32, crop pixels: the keypoints of others, far outside where not labelled.
    """

    image: Picture
    points: Floats
    known: npt.NDArray[np.bool_]
    gone: npt.NDArray[np.bool_]
    rivals: Floats


@dataclass(frozen=True)
class Augmentation:
    """How far crops may deviate from upright, well-centred ones.

    Attributes:
        scale: standard deviation of the log of the box's scale factor; limited to a factor of 1.5.
        turn_deg: standard deviation of the rotation; limited to twice as much.
        shift: standard deviation of the shift of the centre, relative to the size of the box.
        edge: standard deviation of the independent shift of each edge of the box, relative to the size of the box.
        upright: probability that a lying or leaning person is rotated upright before that rotation.
        lay: probability that a person is laid on a side after it.
        half: probability that only the upper or the lower body is cropped.
        cut: probability that the edge of the picture cuts the person, mostly from below.
        repeat: probability that the edges of the picture are repeated beyond it, instead of black.
    """

    scale: float = 0.15
    turn_deg: float = 18.0
    shift: float = 0.04
    edge: float = 0.04
    upright: float = 0.4
    lay: float = 0.12
    half: float = 0.25
    cut: float = 0.25
    repeat: float = 0.5


#: Crops closer to those in use, for the end of a training.
MILD_AUGMENTATION = Augmentation(scale=0.1, turn_deg=8.0, shift=0.03, edge=0.03, lay=0.08, half=0.1, cut=0.2)
#: Crops of people mostly cut by the edge of the picture, padded as in the pipeline.
CUT_AUGMENTATION = replace(MILD_AUGMENTATION, cut=0.75, repeat=0.0)


def people(samples: Sequence[Sample], least: int = 6, least_px: float = 48.0) -> list[Person]:
    """The people in pictures with at least this many labelled COCO keypoints and this longer side of the box."""
    found = []
    for sample in samples:
        for index, keypoints in enumerate(sample.keypoints):
            box = sample.boxes[index]
            if (keypoints[:17, 2] > 0).sum() >= least and (box[2:] - box[:2]).max() >= least_px:
                area = float(sample.areas[index])
                found.append(Person(sample, box, keypoints, area, _neighbours(sample, index)))
    return found


def _neighbours(sample: Sample, index: int) -> Floats:
    """Keypoints (NEIGHBOURS, 17, 3) of the people whose boxes overlap that of this person most."""
    low = np.maximum(sample.boxes[:, :2], sample.boxes[index, :2])
    high = np.minimum(sample.boxes[:, 2:], sample.boxes[index, 2:])
    shared = np.maximum(high - low, 0).prod(1)
    shared[index] = 0
    nearest = [i for i in np.argsort(-shared)[:NEIGHBOURS] if shared[i] > 0]
    others = np.zeros((NEIGHBOURS, 17, 3), np.float32)
    others[: len(nearest)] = sample.keypoints[nearest, :17]
    return others


def cut_by_the_picture(image: Picture, box: Floats, keypoints: Floats) -> Floats:
    """Keypoints with v = -1 for the unlabelled joints of legs where a box ends at the lower edge of its picture."""
    if box[3] < image.shape[0] * 0.985:
        return keypoints
    keypoints = keypoints.copy()
    legs = keypoints[_LEGS, :]
    legs[legs[:, 2] == 0, 2] = -1
    keypoints[_LEGS, :] = legs
    return keypoints


def upright(persons: Sequence[Person], most_deg: float = 30.0) -> list[Person]:
    """The people whose trunk leans less than this."""
    return [person for person in persons if abs(lean_deg(person.keypoints)) < most_deg]


def large(persons: Sequence[Person], least: int = 8, share: float = 0.25) -> list[Person]:
    """The people with at least this many labelled COCO keypoints and this share of their picture's height."""
    return [
        person
        for person in persons
        if (person.keypoints[:17, 2] > 0).sum() >= least
        and person.box[3] - person.box[1] >= share * person.sample.image().shape[0]
    ]


def lean_deg(keypoints: Floats) -> float:
    """Angle of the trunk from upright in the picture, positive clockwise.

    NaN where shoulders or hips are not labelled.
    """
    shoulders, hips = keypoints[_SHOULDERS, :], keypoints[_HIPS, :]
    if not ((shoulders[:, 2] > 0).any() and (hips[:, 2] > 0).any()):
        return math.nan
    up = shoulders[shoulders[:, 2] > 0, :2].mean(0) - hips[hips[:, 2] > 0, :2].mean(0)
    return math.degrees(math.atan2(up[0], -up[1]))


def rotation(angle_deg: float) -> Doubles:
    """(2, 2) rotation of image points, clockwise as seen (v points down)."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[c, -s], [s, c]])


def box_matrix(box: Doubles, size: tuple[int, int], mirrored: bool = False) -> Doubles:
    """(2, 3) matrix from image points to points of the crop (H, W) of a box, or of its mirror image."""
    height, width = size
    scale = PADDING * max((box[2] - box[0]) / width, (box[3] - box[1]) / height)
    middle = (box[:2] + box[2:]) / 2
    matrix = np.array([[1 / scale, 0, 0], [0, 1 / scale, 0]])
    matrix[:, 2] = np.array([width, height]) / 2 - middle / scale
    if mirrored:
        matrix[0] *= -1
        matrix[0, 2] += width - 1
    return matrix


def turned_box(box: Floats, keypoints: Floats, turn: Doubles) -> Doubles:
    """Box of a person in a rotated picture: around the rotated keypoints, as far from them as the box was."""
    known = keypoints[keypoints[:, 2] > 0, :2].astype(np.float64)
    low, high = known.min(0), known.max(0)
    # Margin around the points, rotated as an offset of the middle and half an extra size.
    offset = turn @ ((box[:2] + box[2:]) / 2 - (low + high) / 2)
    flesh = np.abs(turn) @ ((box[2:] - box[:2]) - (high - low)) / 2
    low, high = (known @ turn.T).min(0), (known @ turn.T).max(0)
    half = np.maximum((high - low) / 2 + flesh, 1.0)
    middle = (low + high) / 2 + offset
    return np.concatenate([middle - half, middle + half])


def crop_person(
    image: Picture,
    box: Floats,
    keypoints: Floats,
    size: tuple[int, int],
    augmentation: Augmentation | None = None,
    generator: np.random.Generator | None = None,
    others: Floats | None = None,
) -> Crop:
    """Crop a person from a picture.

    Args:
        image: (H, W, C) uint8; C is 3, or 4 with premultiplied alpha.
        box: (4,) ``xyxy`` pixels.
        keypoints: (17 or 19, 3): x, y and v.
        size: (h, w) of the crop.
        augmentation: how it may be changed; None crops the box as it is.
        generator: random generator; needed with an augmentation.
        others: (NEIGHBOURS, 17, 3) keypoints of other people in the picture; None if there are none.

    Returns:
        The crop, with the C channels of the image.

    Raises:
        TensorsimError: a person without labelled points, or an augmentation without a generator.
    """
    import cv2

    if not (keypoints[:, 2] > 0).any():
        raise TensorsimError("crop_person: got a person without labelled keypoints")
    mirrored, border = False, cv2.BORDER_CONSTANT
    turn: Doubles = np.eye(2)
    moved: npt.NDArray[np.floating] = np.zeros(2)
    frame = box.astype(np.float64)
    if augmentation is not None:
        if generator is None:
            raise TensorsimError("crop_person: got an augmentation without a generator, expected both")
        mirrored = bool(generator.random() < 0.5)
        if generator.random() < augmentation.repeat:
            border = cv2.BORDER_REPLICATE
        if generator.random() < augmentation.cut:
            image, box, rest = cut_picture(image, box, keypoints, generator)
            moved, keypoints = (rest - keypoints)[0, :2], rest
            frame = box.astype(np.float64)
        turn, frame = _vary(box, keypoints, augmentation, generator)
    matrix = box_matrix(frame, size, mirrored)
    matrix[:, :2] = matrix[:, :2] @ turn
    warped = cv2.warpAffine(image, matrix, (size[1], size[0]), flags=cv2.INTER_LINEAR, borderMode=border)

    body = keypoints[: len(COCO_KEYPOINTS)]
    if mirrored:
        body = body[list(MIRRORED)]
    points = body[:, :2] @ matrix[:, :2].T + matrix[:, 2]
    inside = ((points >= -0.5) & (points <= np.array([size[1], size[0]]) - 0.5)).all(1)
    known = inside & (body[:, 2] > 0)
    gone = ~known & (body[:, 2] != 0)
    rivals = np.full((NEIGHBOURS, len(COCO_KEYPOINTS), 2), _FAR, np.float32)
    if others is not None and len(others):
        if mirrored:
            others = others[:, list(MIRRORED)]
        places = (others[..., :2] + moved) @ matrix[:, :2].T + matrix[:, 2]
        rivals = np.where(others[..., 2:] > 0, places, _FAR).astype(np.float32)
    return Crop(warped.astype(np.uint8, copy=False), points.astype(np.float32), known, gone, rivals)


def cut_picture(
    image: Picture, box: Floats, keypoints: Floats, generator: np.random.Generator
) -> tuple[Picture, Floats, Floats]:
    """Picture, box and keypoints of a person as if the edge of the picture cut through the person.

    Half the time it is the lower edge, else one of the others, a quarter to three quarters into the box; labelled
    points beyond get v = -1. If fewer than four labelled points would remain, nothing is changed.
    """
    axis = int(generator.random() < 0.6)  # 0 cuts at a u, 1 at a v
    keep_low = bool(generator.random() < (0.5 if axis == 0 else 0.85))
    edge = int(box[axis] + generator.uniform(0.25, 0.75) * (box[2 + axis] - box[axis]))
    edge = min(max(edge, 1), image.shape[1 - axis] - 1)
    kept = (keypoints[:, axis] < edge) == keep_low
    if ((keypoints[:, 2] > 0) & kept).sum() < 4:
        return image, box, keypoints
    box, keypoints = box.copy(), keypoints.copy()
    keypoints[~kept & (keypoints[:, 2] > 0), 2] = -1
    if keep_low:
        part = slice(0, edge)
        box[2 + axis] = edge - 1
    else:  # the picture begins at the edge
        part = slice(edge, None)
        box[axis], box[2 + axis] = 0, box[2 + axis] - edge
        keypoints[:, axis] -= edge
    return (image[:, part] if axis == 0 else image[part]), box, keypoints


def _vary(
    box: Floats, keypoints: Floats, augmentation: Augmentation, generator: np.random.Generator
) -> tuple[Doubles, Doubles]:
    """A random rotation (2, 2) of the picture, and the box to crop from the rotated picture."""

    def bounded_normal(deviation: float) -> float:
        return deviation * float(np.clip(generator.standard_normal(), -2, 2))

    angle = bounded_normal(augmentation.turn_deg)
    lean = lean_deg(keypoints)
    if generator.random() < augmentation.upright and abs(lean) > 30:
        angle -= lean
    if generator.random() < augmentation.lay:
        angle += 90 * generator.choice([-1, 1])
    turn = rotation(angle)
    frame = turned_box(box, keypoints, turn)
    part = np.array(_UPPER if generator.random() < 0.6 else _LOWER)
    part = part[keypoints[part, 2] > 0]
    if generator.random() < augmentation.half and len(part) >= 4:
        some = keypoints[part, :2].astype(np.float64) @ turn.T
        margin = generator.uniform(0.05, 0.2) * (some.max(0) - some.min(0)).max() + 1
        frame = np.concatenate([some.min(0) - margin, some.max(0) + margin])
    size = (frame[2:] - frame[:2]).max()
    middle = (frame[:2] + frame[2:]) / 2 + size * np.array([bounded_normal(augmentation.shift) for _ in "uv"])
    half = (
        (frame[2:] - frame[:2]) / 2 * math.exp(float(np.clip(bounded_normal(augmentation.scale), -0.4, 0.4)))
    )
    edges = size * np.array([bounded_normal(augmentation.edge) for _ in "uvuv"])
    frame = np.concatenate([middle - half, middle + half]) + edges
    return turn, frame if (frame[2:] - frame[:2] >= 1).all() else frame - edges


class RenderedPeople:
    """Cut-out people in front of pictures of places.

    Args:
        cutouts: the people.
        places: pictures without people.
    """

    def __init__(self, cutouts: Cutouts, places: Sequence[Sample]) -> None:
        if not len(cutouts) or not len(places):
            raise TensorsimError(
                f"RenderedPeople: got {len(cutouts)} cut-outs and {len(places)} places, expected some of each"
            )
        self.cutouts, self.places = cutouts, places

    def __len__(self) -> int:
        return len(self.cutouts)

    def crop(
        self, index: int, size: tuple[int, int], augmentation: Augmentation, generator: np.random.Generator
    ) -> Crop:
        """A crop (3 channels) of the person ``index`` in front of a random place."""
        cutout = self.cutouts[index]
        height, width = cutout.rgba.shape[:2]
        box = np.array([0, 0, width - 1, height - 1], np.float32)
        rgba, keypoints = np.pad(cutout.rgba, ((2, 2), (2, 2), (0, 0))), cutout.keypoints.copy()
        keypoints[:, :2] += 2
        # With premultiplied alpha, colours can be interpolated.
        crop = crop_person(premultiplied(rgba), box + 2, keypoints, size, augmentation, generator)
        place = random_view(self.places[int(generator.integers(len(self.places)))].image(), size, generator)
        return crop._replace(image=over(place, crop.image))


def random_view(image: Picture, size: tuple[int, int], generator: np.random.Generator) -> Picture:
    """Part of a picture with the aspect ratio of (h, w), at a third to all of the largest size, possibly mirrored."""
    import cv2

    height, width = size
    scale = min(image.shape[0] / height, image.shape[1] / width) * generator.uniform(0.33, 1.0)
    h, w = max(int(scale * height), 1), max(int(scale * width), 1)
    top = int(generator.integers(image.shape[0] - h + 1))
    left = int(generator.integers(image.shape[1] - w + 1))
    part = image[top : top + h, left : left + w]
    part = part[:, ::-1] if generator.random() < 0.5 else part
    view: Any = cv2.resize(np.ascontiguousarray(part), (width, height), interpolation=cv2.INTER_LINEAR)
    return view.astype(np.uint8, copy=False)
