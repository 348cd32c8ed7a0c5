"""Square pictures with people in them to train a detector on: real ones, mosaics of them, and people pasted.

Boxes are ``xyxy`` pixels with (0, 0) at the outer corner of the first pixel. Where a source does not label
everybody, only the surroundings of its boxes count as known: beyond, nobody can say that there is no one.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tensorsim.training.cutouts import Cutout
from tensorsim.training.detector_people import outline
from tensorsim.training.shards import Floats, Sample

Picture = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

#: Cells of the mask of what is known, along each side.
KNOWN_CELLS = 40
#: Around a box this share of its size is known to be free of other people.
SURROUNDINGS = 0.15
#: What is cut off by the edge of a picture is nobody's box if less than this is left.
LEAST_VISIBLE = 0.25
GREY = 114
#: Of people who are pasted one after the other, this share stands beside or in front of the one before.
TOGETHER = 0.5
#: With every person who is pasted, a piece of something else is, with this probability.
DISTRACTED = 0.5


class Labelled(NamedTuple):
    """A picture with boxes.

    Attributes:
        image: (s, s, 3) uint8 RGB.
        boxes: (n, 4) float32 ``xyxy`` pixels.
        known: (KNOWN_CELLS, KNOWN_CELLS) bool, where the absence of people is known.
    """

    image: Picture
    boxes: Floats
    known: Mask


@dataclass(frozen=True, eq=False)
class Sources:
    """What pictures are made of.

    Attributes:
        complete: pictures with people, all labelled.
        empty: pictures without people.
        partial: lists of pictures where only some people are labelled, each list as likely as the next.
        cutouts: rendered people, who are pasted.
        outlined: pictures whose first person is cut out of them, as often as a rendered one is taken; none is fine.
        shares: how often a picture, or a part of a mosaic, is of which kind; in pasted ones, cut-outs are put on
            pictures without people.
    """

    complete: Sequence[Sample]
    empty: Sequence[Sample]
    partial: Sequence[Sequence[Sample]]
    cutouts: Sequence[Cutout] = ()
    outlined: Sequence[Sample] = ()
    shares: dict[str, float] = field(
        default_factory=lambda: {"complete": 0.25, "partial": 0.35, "pasted": 0.3, "empty": 0.1}
    )


@functools.lru_cache(maxsize=2048)
def _picture(sample: Sample, longest: int = 448) -> tuple[Picture, float]:
    """A picture, shrunk to at most ``longest`` pixels a side, and by what factor. Few are larger: they are kept."""
    import cv2

    image = sample.image()
    factor = min(1.0, longest / max(image.shape[:2]))
    if factor < 1:
        image = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA).astype(np.uint8)
    return image, factor


_outlined = functools.lru_cache(maxsize=4096)(outline)


class PictureMaker:
    """Makes labelled pictures, each from random numbers of its own.

    Args:
        sources: what they are made of.
        size: side of the pictures in pixels.
        mosaic: probability that a picture is made of four.
        film: probability that one that is not is wider than high, with grey below it, as films come to the detector.
    """

    def __init__(self, sources: Sources, size: int = 320, mosaic: float = 0.5, film: float = 0.5) -> None:
        self.sources, self.size, self.mosaic, self.film = sources, size, mosaic, film

    def __call__(self, rng: np.random.Generator) -> Labelled:
        """One picture."""
        canvas = Canvas(self.size)
        size = self.size
        if rng.random() < self.mosaic:
            x, y = (int(v) for v in rng.uniform(0.3, 0.7, 2) * size)
            for rect in ((0, 0, x, y), (x, 0, size, y), (0, y, x, size), (x, y, size, size)):
                self._fill(canvas, rect, rng)
        else:
            height = rng.choice([9 / 16, 3 / 4]) * size if rng.random() < self.film else size
            self._fill(canvas, (0, 0, size, round(height)), rng)
        return Labelled(_coloured(canvas.image, rng), canvas.final_boxes(), canvas.known)

    def _fill(self, canvas: "Canvas", rect: tuple[int, int, int, int], rng: np.random.Generator) -> None:
        kind = rng.choice(list(self.sources.shares), p=list(self.sources.shares.values()))
        if kind == "pasted":
            canvas.place(_one_of(self.sources.empty, rng), rect, rng)
            beside = None
            for _ in range(rng.integers(1, 5)):
                placed = canvas.paste(self._person(rng), rect, rng, beside)
                beside = placed if rng.random() < TOGETHER else None
                if rng.random() < DISTRACTED:
                    canvas.distract(_one_of(self.sources.empty, rng), rect, rng)
        elif kind == "partial":
            samples = self.sources.partial[int(rng.integers(len(self.sources.partial)))]
            canvas.place(_one_of(samples, rng), rect, rng)
        else:
            canvas.place(_one_of(getattr(self.sources, kind), rng), rect, rng)

    def _person(self, rng: np.random.Generator) -> Picture:
        """Somebody cut out of a photograph, or rendered."""
        if len(self.sources.outlined) and rng.random() < 0.5:
            person = _outlined(_one_of(self.sources.outlined, rng))
            if person is not None:
                return person
        return _restyled(self.sources.cutouts[int(rng.integers(len(self.sources.cutouts)))].rgba, rng)


def _one_of(samples: Sequence[Sample], rng: np.random.Generator) -> Sample:
    return samples[int(rng.integers(len(samples)))]


class Canvas:
    """A square picture that others are put into, and what is known of it."""

    def __init__(self, size: int) -> None:
        self.image = np.full((size, size, 3), GREY, np.uint8)
        self.known = np.ones((KNOWN_CELLS, KNOWN_CELLS), bool)
        self.boxes: list[Floats] = []
        self.pasted: list[int] = []  # pixels of each cut-out before others covered it
        self.owner = np.zeros((size, size), np.uint8)  # 1 + index of the cut-out that each pixel shows
        self.cell = size / KNOWN_CELLS

    def place(self, sample: Sample, rect: tuple[int, int, int, int], rng: np.random.Generator) -> None:
        """Put a picture into a rectangle, at a random scale, place and side, with its boxes."""
        import cv2

        picture, factor = _picture(sample)
        left, top, right, bottom = rect
        width, height = right - left, bottom - top
        fit = min(width / picture.shape[1], height / picture.shape[0])
        scale = fit * np.exp(rng.uniform(np.log(0.9), np.log(2.2)))
        if rng.random() < 0.7:  # no grey around it
            scale = max(scale, width / picture.shape[1], height / picture.shape[0])
        boxes = sample.boxes * factor
        focus = np.array([picture.shape[1], picture.shape[0]]) * rng.uniform(0.3, 0.7, 2)
        if len(boxes):
            # Somebody is in the picture, from far to close.
            box = boxes[rng.integers(len(boxes))]
            wanted = height * np.exp(rng.uniform(np.log(0.2), np.log(1.1)))
            least = fit * (0.9 if rng.random() < 0.75 else 0.4)
            scale = float(np.clip(wanted / max(box[3] - box[1], 1), least, 3.5 * fit))
            focus = (box[:2] + box[2:]) / 2
        size = np.array([picture.shape[1], picture.shape[0]]) * scale
        room = np.array([width, height])
        shift = room * rng.uniform(0.25, 0.75, 2) - focus * scale
        # A picture larger than the rectangle covers it; a smaller one lies inside.
        slack = room - size
        shift = np.clip(shift, np.minimum(slack, 0), np.maximum(slack, 0))
        flip = rng.random() < 0.5
        matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
        if flip:
            matrix[0] = [-scale, 0, width - shift[0]]
            boxes = np.stack(
                [picture.shape[1] - boxes[:, 2], boxes[:, 1], picture.shape[1] - boxes[:, 0], boxes[:, 3]], 1
            )
            shift = np.array([width - shift[0] - size[0], shift[1]])
        # OpenCV has pixel centres at integers, boxes have corners there.
        matrix[:, 2] += matrix[:, :2] @ [0.5, 0.5] - 0.5
        if scale < 0.6:
            picture = cv2.blur(picture, (round(1 / scale),) * 2)  # type: ignore[assignment]
        self.image[top:bottom, left:right] = cv2.warpAffine(
            picture, matrix, (width, height), flags=cv2.INTER_LINEAR, borderValue=(GREY,) * 3
        )
        boxes = boxes * scale + np.tile(shift, 2) + np.array([left, top, left, top])
        if not sample.all_labelled:
            self._know(np.array(rect, np.float32), False)
            margin = (boxes[:, 2:] - boxes[:, :2]) * SURROUNDINGS
            for grown in np.concatenate([boxes[:, :2] - margin, boxes[:, 2:] + margin], 1):
                self._know(_clipped(grown, rect), True)
        for box in boxes:
            clipped = _clipped(box, rect)
            share = _area(clipped) / max(_area(box), 1e-6)
            if share >= LEAST_VISIBLE and min(clipped[2:] - clipped[:2]) >= 4:
                self.boxes.append(clipped.astype(np.float32))
            elif share > 0:
                self._know(clipped, False)

    def paste(
        self,
        rgba: Picture,
        rect: tuple[int, int, int, int],
        rng: np.random.Generator,
        beside: tuple[int, int, int, int] | None = None,
    ) -> tuple[int, int, int, int]:
        """Put a cut-out into a rectangle, at a random scale and place, partly outside at times.

        Args:
            rgba: the cut-out.
            rect: left, top, right and bottom of the rectangle.
            rng: random numbers.
            beside: left, top, width and height of somebody whom it stands close to, as large and as low as that
                one; None: anywhere.

        Returns:
            Left, top, width and height of the cut-out, also where it is outside.
        """
        import cv2

        left, top, right, bottom = rect
        tall = (bottom - top) * np.exp(rng.uniform(np.log(0.2), np.log(1.3)))
        scale = tall / max(rgba.shape[:2])
        if beside is not None:
            scale = max(beside[2:]) * rng.uniform(0.85, 1.15) / max(rgba.shape[:2])
        size = (max(round(rgba.shape[1] * scale), 3), max(round(rgba.shape[0] * scale), 3))
        if rng.random() < 0.5:
            rgba = np.ascontiguousarray(rgba[:, ::-1])
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        rgba = cv2.resize(rgba, size, interpolation=how).astype(np.uint8)
        x = left + round(rng.uniform(-0.3, 1.0) * (right - left) - 0.35 * size[0] * rng.random())
        y = top + round(rng.uniform(-0.1, 1.0) * max(bottom - top - 0.7 * size[1], 1))
        if beside is not None:
            away = rng.uniform(0.25, 1.0) * (beside[2] + size[0]) / 2 * rng.choice([-1, 1])
            x = round(beside[0] + beside[2] / 2 + away - size[0] / 2)
            y = round(beside[1] + beside[3] - size[1] + rng.normal(0, 0.04) * size[1])
        self.pasted.append(int((rgba[..., 3] > 127).sum()))
        self._put(rgba, (x, y), rect, len(self.pasted))
        return x, y, *size

    def distract(self, sample: Sample, rect: tuple[int, int, int, int], rng: np.random.Generator) -> None:
        """Put a piece of a picture without people into a rectangle: what has an edge of its own is not a person.

        It may stand in front of people who were pasted before.
        """
        import cv2

        picture, _ = _picture(sample)
        left, top, right, bottom = rect
        tall = (bottom - top) * np.exp(rng.uniform(np.log(0.06), np.log(0.6)))
        size = (max(round(tall * np.exp(rng.uniform(np.log(0.3), np.log(2.0)))), 4), max(round(tall), 4))
        part = (np.array(picture.shape[:2]) * np.exp(rng.uniform(np.log(0.05), np.log(0.6), 2))).astype(
            int
        ) + 2
        y, x = (int(rng.integers(room + 1)) for room in np.array(picture.shape[:2]) - part)
        piece = cv2.resize(
            picture[y : y + part[0], x : x + part[1]], size, interpolation=cv2.INTER_AREA
        ).astype(np.uint8)
        if rng.random() < 0.2:  # of one colour and some shade
            piece = (piece * 0.15 + rng.uniform(0, 215, 3)).astype(np.uint8)
        alpha = np.full(size[::-1], 255, np.uint8)
        shape = rng.random()
        if shape < 0.3:
            alpha[:] = 0
            middle, radii = (size[0] // 2, size[1] // 2), (size[0] // 2, size[1] // 2)
            cv2.ellipse(alpha, middle, radii, 0, 0, 360, (255,), -1)
        elif shape < 0.7:  # a blot
            coarse = rng.uniform(0, 1, (5, 4)).astype(np.float32)
            coarse[[0, -1]] *= 0.4
            coarse[:, [0, -1]] *= 0.4
            alpha = (cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC) > 0.35).astype(np.uint8) * 255
        rgba = np.dstack([piece, cv2.blur(alpha, (2, 2)).astype(np.uint8)])
        corner = (
            left + int(rng.uniform(-0.1, 1) * (right - left)),
            top + int(rng.uniform(-0.1, 1) * (bottom - top)),
        )
        self._put(rgba, corner, rect, 0)

    def _put(
        self, rgba: Picture, corner: tuple[int, int], rect: tuple[int, int, int, int], owner: int
    ) -> None:
        """Blend a cut-out in with its corner there, as far as it is within the rectangle."""
        (x, y), (left, top, right, bottom) = corner, rect
        height, width = rgba.shape[:2]
        x0, y0, x1, y1 = max(x, left), max(y, top), min(x + width, right), min(y + height, bottom)
        if x1 - x0 < 4 or y1 - y0 < 4:
            return
        part = rgba[y0 - y : y1 - y, x0 - x : x1 - x]
        alpha = part[..., 3:].astype(np.float32) / 255
        ground = self.image[y0:y1, x0:x1]
        self.image[y0:y1, x0:x1] = (part[..., :3] * alpha + ground * (1 - alpha) + 0.5).astype(np.uint8)
        self.owner[y0:y1, x0:x1][part[..., 3] > 127] = owner

    def final_boxes(self) -> Floats:
        """Boxes (n, 4) of everybody, those of cut-outs around what is left to see of them."""
        boxes = list(self.boxes)
        for index, pixels in enumerate(self.pasted, start=1):
            seen = self.owner == index
            rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
            if len(rows) == 0:
                continue
            box = np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float32)
            if seen.sum() >= LEAST_VISIBLE * pixels and min(box[2:] - box[:2]) >= 4:
                boxes.append(box)
            else:
                self._know(box, False)
        return np.stack(boxes) if boxes else np.zeros((0, 4), np.float32)

    def _know(self, box: npt.NDArray[np.floating], known: bool) -> None:
        left, top = np.floor(np.maximum(box[:2], 0) / self.cell).astype(int)
        right, bottom = np.ceil(np.maximum(box[2:], 0) / self.cell).astype(int)
        self.known[top:bottom, left:right] = known


def _clipped(box: npt.NDArray[np.floating], rect: tuple[int, int, int, int]) -> npt.NDArray[np.floating]:
    return np.clip(box, np.tile(rect[:2], 2), np.tile(rect[2:], 2))


def _area(box: npt.NDArray[np.floating]) -> float:
    return float(np.prod(np.maximum(box[2:] - box[:2], 0)))


def _restyled(rgba: Picture, rng: np.random.Generator) -> Picture:
    """A cut-out in other colours and light."""
    import cv2

    mix = np.eye(3) * rng.uniform(0.5, 1.2) + rng.uniform(-0.2, 0.25, (3, 3))
    colour = cv2.transform(rgba[..., :3], mix)
    # Coarse shade over the body, as from windows and trees.
    coarse = rng.uniform(0.6, 1.3, (4, 3)).astype(np.float32)
    shade = cv2.resize(coarse, (rgba.shape[1], rgba.shape[0]), interpolation=cv2.INTER_LINEAR)
    colour = np.clip(colour * shade[..., None], 0, 255).astype(np.uint8)
    return np.concatenate([colour, rgba[..., 3:]], axis=-1)


def _coloured(image: Picture, rng: np.random.Generator) -> Picture:
    """Other exposure, contrast, tint and saturation; now and then blur, noise, or no colour at all."""
    import cv2

    ramp = np.linspace(0, 1, 256)
    gain = np.exp(rng.normal(0, 0.15)) * np.exp(rng.normal(0, 0.05, 3))
    table = ramp[:, None] ** np.exp(rng.normal(0, 0.2)) * gain + rng.normal(0, 0.04)
    image = cv2.LUT(image, np.clip(table * 255, 0, 255).astype(np.uint8)[None]).astype(np.uint8)
    saturation = 0.0 if rng.random() < 0.05 else rng.uniform(0.4, 1.5)
    mix = saturation * np.eye(3) + (1 - saturation) * np.array([[0.299, 0.587, 0.114]] * 3)
    image = cv2.transform(image, mix).astype(np.uint8)
    if rng.random() < 0.25:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.5)).astype(np.uint8)
    if rng.random() < 0.25:
        noise = rng.integers(-128, 128, (*image.shape[:2], 1)) * rng.uniform(0.02, 0.12)
        image = np.clip(image + noise, 0, 255).astype(np.uint8)
    return image
