"""Square pictures with people to train a detector on: real ones, mosaics of them, and pasted people.

Boxes are ``xyxy`` pixels with (0, 0) at the outer corner of the first pixel. Where a source does not label
everybody, only the surroundings of its boxes count as known: elsewhere there may be unlabelled people.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from tensorsim.training.canvas import Canvas, Mask, Picture, shrunk_picture
from tensorsim.training.colours import recoloured
from tensorsim.training.cutouts import Cutout
from tensorsim.training.detector_people import outline
from tensorsim.training.shards import Floats, Sample
from tensorsim.training.views import random_turn

#: Probability that a pasted person stands beside or in front of the one pasted before.
TOGETHER = 0.5
#: Probability that a piece of something else is pasted along with a person.
DISTRACTED = 0.5
#: Shares of the kinds of pictures.
SHARES = {"complete": 0.55, "films": 0.12, "partial": 0.13, "pasted": 0.08, "empty": 0.12}


class Labelled(NamedTuple):
    """A picture with boxes.

    Attributes:
        image: (s, s, 3) uint8 RGB.
        boxes: (n, 4) float32 ``xyxy`` pixels.
        known: (KNOWN_CELLS, KNOWN_CELLS) bool, where the absence of unlabelled people is known.
    """

    image: Picture
    boxes: Floats
    known: Mask


@dataclass(frozen=True, eq=False)
class Sources:
    """What pictures are made from.

    Attributes:
        complete: pictures with people, all labelled.
        empty: pictures without people.
        partial: lists of pictures in which only some people are labelled; all lists are equally likely.
        films: frames of films with people, all labelled; may be empty.
        cutouts: rendered people for pasting; may be empty.
        outlined: pictures whose first person is cut out and pasted in place of some rendered ones; may be empty.
        shares: relative frequencies of the kinds of a picture, or part of a mosaic; in pasted ones, cut-outs are put
            on pictures without people. Kinds without pictures are left out.
    """

    complete: Sequence[Sample]
    empty: Sequence[Sample]
    partial: Sequence[Sequence[Sample]]
    films: Sequence[Sample] = ()
    cutouts: Sequence[Cutout] = ()
    outlined: Sequence[Sample] = ()
    shares: Mapping[str, float] = field(default_factory=lambda: SHARES)

    def kinds(self) -> tuple[list[str], Floats]:
        """The kinds that have pictures, and their probabilities."""
        kinds = [
            kind for kind in self.shares if len(self.cutouts if kind == "pasted" else getattr(self, kind))
        ]
        shares = np.array([self.shares[kind] for kind in kinds], np.float64)
        return kinds, shares / shares.sum()


_outlined = functools.lru_cache(maxsize=4096)(outline)


class PictureMaker:
    """Makes labelled pictures, each from its own random numbers.

    Args:
        sources: what they are made from.
        size: side of the pictures in pixels.
        mosaic: probability that a picture is a mosaic of four.
        film: probability that any other picture is in landscape format with grey below it, as films reach the detector.
        turned: probability that a picture looks as if taken by a rotated camera (:func:`random_turn`).
    """

    def __init__(
        self, sources: Sources, size: int = 320, mosaic: float = 0.4, film: float = 0.3, turned: float = 0.4
    ) -> None:
        self.sources, self.size, self.mosaic, self.film, self.turned = sources, size, mosaic, film, turned
        self.kinds, self.shares = sources.kinds()

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
        return Labelled(recoloured(canvas.image, rng), canvas.final_boxes(), canvas.known)

    def _fill(self, canvas: Canvas, rect: tuple[int, int, int, int], rng: np.random.Generator) -> None:
        kind = str(rng.choice(self.kinds, p=self.shares))
        if kind == "pasted":
            self._place(canvas, self.sources.empty, rect, rng)
            beside = None
            for _ in range(rng.integers(1, 5)):
                placed = canvas.paste(self._person(rng), rect, rng, beside)
                beside = placed if rng.random() < TOGETHER else None
                if rng.random() < DISTRACTED:
                    canvas.distract(_one_of(self.sources.empty, rng), rect, rng)
        elif kind == "partial":
            samples = self.sources.partial[int(rng.integers(len(self.sources.partial)))]
            self._place(canvas, samples, rect, rng)
        else:
            self._place(canvas, getattr(self.sources, kind), rect, rng)

    def _place(
        self,
        canvas: Canvas,
        samples: Sequence[Sample],
        rect: tuple[int, int, int, int],
        rng: np.random.Generator,
    ) -> None:
        sample = _one_of(samples, rng)
        turn = None
        if rng.random() < self.turned:
            height, width = shrunk_picture(sample)[0].shape[:2]
            turn = random_turn((height, width), rng)
        canvas.place(sample, rect, rng, turn)

    def _person(self, rng: np.random.Generator) -> Picture:
        """A person cut out of a photograph, or rendered."""
        if len(self.sources.outlined) and rng.random() < 0.3:
            person = _outlined(_one_of(self.sources.outlined, rng))
            if person is not None:
                return person
        return _restyled(self.sources.cutouts[int(rng.integers(len(self.sources.cutouts)))].rgba, rng)


def _one_of(samples: Sequence[Sample], rng: np.random.Generator) -> Sample:
    return samples[int(rng.integers(len(samples)))]


def _restyled(rgba: Picture, rng: np.random.Generator) -> Picture:
    """A cut-out in other colours and light."""
    import cv2

    mix = np.eye(3) * rng.uniform(0.5, 1.2) + rng.uniform(-0.2, 0.25, (3, 3))
    colour = cv2.transform(rgba[..., :3], mix)
    # Coarse shading over the body, as from windows and trees.
    coarse = rng.uniform(0.6, 1.3, (4, 3)).astype(np.float32)
    shade = cv2.resize(coarse, (rgba.shape[1], rgba.shape[0]), interpolation=cv2.INTER_LINEAR)
    colour = np.clip(colour * shade[..., None], 0, 255).astype(np.uint8)
    return np.concatenate([colour, rgba[..., 3:]], axis=-1)
