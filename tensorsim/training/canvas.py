"""A square canvas that pictures are put on, whole or as cut-outs, with boxes of the people in them.

Boxes are ``xyxy`` pixels with (0, 0) at the outer corner of the first pixel.
"""

import functools

import numpy as np
import numpy.typing as npt

from tensorsim.geometry.boxes import LETTERBOX_GREY
from tensorsim.training.colours import Picture, over, premultiplied
from tensorsim.training.shards import Floats, Sample
from tensorsim.training.views import Doubles, warp_boxes, warp_points

Mask = npt.NDArray[np.bool_]

#: Number of cells along each side of the mask of what is known.
KNOWN_CELLS = 40
#: Around a box, a margin of this share of its size is known to be free of other people.
SURROUNDINGS = 0.15
#: A person cut off by the edge of a picture or covered has no box if less than this share remains visible.
LEAST_VISIBLE = 0.25
#: How often a picture with people is scaled to about the size of its place, rather than by one of its people.
AS_IT_IS = 0.5


@functools.lru_cache(maxsize=256)
def shrunk_picture(sample: Sample, longest: int = 448) -> tuple[Picture, float]:
    """A picture, shrunk to at most ``longest`` pixels a side, and the factor; results are cached."""
    import cv2

    image = sample.image()
    factor = min(1.0, longest / max(image.shape[:2]))
    if factor < 1:
        image = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA).astype(np.uint8)
    return image, factor


class Canvas:
    """A square picture that others are put into, and what is known about it."""

    def __init__(self, size: int) -> None:
        self.image = np.full((size, size, 3), LETTERBOX_GREY, np.uint8)
        self.known = np.ones((KNOWN_CELLS, KNOWN_CELLS), bool)
        self.boxes: list[Floats] = []
        self.pasted: list[int] = []  # number of pixels of each cut-out before others covered it
        self.owner = np.zeros((size, size), np.uint8)  # 1 + index of the cut-out that each pixel shows
        self.cell = size / KNOWN_CELLS

    def place(
        self,
        sample: Sample,
        rect: tuple[int, int, int, int],
        rng: np.random.Generator,
        turn: Doubles | None = None,
    ) -> None:
        """Put a picture into a rectangle, at a random scale, place and side, with its boxes.

        Args:
            sample: the picture.
            rect: left, top, right and bottom of the rectangle.
            rng: random numbers.
            turn: homography (3, 3) of the picture as :func:`shrunk_picture` gives it; None leaves it as it is.
        """
        import cv2

        picture, factor = shrunk_picture(sample)
        left, top, right, bottom = rect
        room = np.array([right - left, bottom - top])
        size = np.array(picture.shape[1::-1], float)
        boxes, corner = sample.boxes * factor, np.zeros(2)
        if turn is not None:
            boxes = warp_boxes(boxes, sample.keypoints * [factor, factor, 1], turn)
            outline = warp_points(np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size, turn)
            corner, size = outline.min(0), np.ptp(outline, axis=0)
        scale, shift = _placement(size, boxes - np.tile(corner, 2), room, rng)
        shift = shift - corner * scale
        matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]], [0, 0, 1]])
        boxes = boxes * scale + np.tile(shift, 2)
        if rng.random() < 0.5:
            matrix = np.array([[-1, 0, room[0]], [0, 1, 0], [0, 0, 1]]) @ matrix
            boxes[:, [0, 2]] = room[0] - boxes[:, [2, 0]]
        if turn is not None:
            matrix = matrix @ turn
        # In OpenCV, pixel centres are at integers; in boxes, pixel corners are.
        centre = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
        matrix = np.linalg.inv(centre) @ matrix @ centre
        if scale <= 0.5:  # an odd width, because an even one would shift the picture
            picture = cv2.blur(picture, (2 * int(0.5 / scale) + 1,) * 2)  # type: ignore[assignment]
        self.image[top:bottom, left:right] = cv2.warpPerspective(
            picture, matrix, tuple(room.tolist()), flags=cv2.INTER_LINEAR, borderValue=(LETTERBOX_GREY,) * 3
        )
        boxes = boxes + np.array([left, top, left, top])
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
        """Put a cut-out into a rectangle, at a random scale and place, sometimes partly outside.

        Args:
            rgba: the cut-out (h, w, 4), straight alpha.
            rect: left, top, right and bottom of the rectangle.
            rng: random numbers.
            beside: left, top, width and height of a person whom it stands close to, at about the same size and height
                in the picture; None: anywhere.

        Returns:
            Left, top, width and height of the cut-out, including parts that are outside.
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
        rgba = cv2.resize(premultiplied(rgba), size, interpolation=how).astype(np.uint8)
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
        """Put a piece of a picture without people into a rectangle: not everything with an edge is a person.

        It may cover people who were pasted before.
        """
        import cv2

        picture, _ = shrunk_picture(sample)
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
        if rng.random() < 0.2:  # a single colour with some shading
            piece = (piece * 0.15 + rng.uniform(0, 215, 3)).astype(np.uint8)
        alpha = np.full(size[::-1], 255, np.uint8)
        shape = rng.random()
        if shape < 0.3:
            alpha[:] = 0
            middle, radii = (size[0] // 2, size[1] // 2), (size[0] // 2, size[1] // 2)
            cv2.ellipse(alpha, middle, radii, 0, 0, 360, (255,), -1)
        elif shape < 0.7:  # a blob
            coarse = rng.uniform(0, 1, (5, 4)).astype(np.float32)
            coarse[[0, -1]] *= 0.4
            coarse[:, [0, -1]] *= 0.4
            alpha = (cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC) > 0.35).astype(np.uint8) * 255
        rgba = premultiplied(np.dstack([piece, cv2.blur(alpha, (2, 2)).astype(np.uint8)]))
        corner = (
            left + int(rng.uniform(-0.1, 1) * (right - left)),
            top + int(rng.uniform(-0.1, 1) * (bottom - top)),
        )
        self._put(rgba, corner, rect, 0)

    def _put(
        self, rgba: Picture, corner: tuple[int, int], rect: tuple[int, int, int, int], owner: int
    ) -> None:
        """Put a cut-out (:func:`premultiplied`) with its corner there, clipped to the rectangle."""
        (x, y), (left, top, right, bottom) = corner, rect
        height, width = rgba.shape[:2]
        x0, y0, x1, y1 = max(x, left), max(y, top), min(x + width, right), min(y + height, bottom)
        if x1 - x0 < 4 or y1 - y0 < 4:
            return
        part = rgba[y0 - y : y1 - y, x0 - x : x1 - x]
        self.image[y0:y1, x0:x1] = over(self.image[y0:y1, x0:x1], part)
        self.owner[y0:y1, x0:x1][part[..., 3] > 127] = owner

    def final_boxes(self) -> Floats:
        """Boxes (n, 4) of all people, those of cut-outs around their visible parts."""
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


def _placement(
    size: Doubles, boxes: npt.NDArray[np.floating], room: npt.NDArray[np.integer], rng: np.random.Generator
) -> tuple[float, Doubles]:
    """Scale of a picture of that size (width, height) and place of its upper left corner in a rectangle.

    Half the time the picture is about as large as the rectangle; otherwise one of its people determines the scale
    and is in view.
    """
    fits = room / size
    fit = fits.min()
    if len(boxes) == 0:
        scale = fit * np.exp(rng.uniform(np.log(0.9), np.log(2.2)))
        if rng.random() < 0.7:  # without grey borders
            scale = max(scale, fits.max())
        focus = size * rng.uniform(0.3, 0.7, 2)
    else:
        box = boxes[rng.integers(len(boxes))]
        focus = (box[:2] + box[2:]) / 2
        if rng.random() < AS_IT_IS:
            scale = fit * np.exp(rng.uniform(np.log(0.8), np.log(1.5)))
        else:  # from far away to close up
            wanted = room[1] * np.exp(rng.uniform(np.log(0.15), np.log(1.1)))
            least = fit * (0.9 if rng.random() < 0.75 else 0.4)
            scale = float(np.clip(wanted / max((box[2:] - box[:2]).max(), 1), least, 3.5 * fit))
    shift = room * rng.uniform(0.25, 0.75, 2) - focus * scale
    # A picture larger than the rectangle covers it; a smaller one lies inside.
    slack = room - size * scale
    return float(scale), np.clip(shift, np.minimum(slack, 0), np.maximum(slack, 0))
