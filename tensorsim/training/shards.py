"""Labelled pictures of people: tar shards of jpg and json, and COCO annotation files, with random access.

A shard holds ``KEY.jpg`` and ``KEY.json`` with ``{"all_persons_labelled": bool, "persons": [{"bbox": [x, y, w,
h], "keypoints": [[x, y, v] * 19] or null}]}``; a picture without a json shows no people. The 19 points are
COCO-17, then neck and the top of the head; v is 0 where not labelled, 1 hidden, 2 visible. Pixel centres are at
integers.
"""

import hashlib
import json
import os
import tarfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tensorsim.config import COCO_KEYPOINTS
from tensorsim.errors import TensorsimError

Floats = npt.NDArray[np.float32]

#: The points of a labelled person.
POINTS = (*COCO_KEYPOINTS, "neck", "head_top")
#: Shards of COCO pictures with people.
COCO_SHARDS = ("coco_small", "coco_more", "coco_extra")
#: Pictures in these with a hash below this are never used in training. coco_more and coco_extra have none below 15.
COCO_HELD_OUT_PERCENT = 25
#: Typical share of a box that its person covers.
AREA_OF_BOX = 0.53


@dataclass(frozen=True, eq=False)
class Sample:
    """A picture and the people labelled in it.

    Attributes:
        key: its name within its source.
        boxes: (n, 4) float32 ``xyxy`` pixels.
        keypoints: (n, 19, 3) float32: x, y and v of :data:`POINTS`; all zero for a person without points.
        areas: (n,) float32, pixels covered by each person, as annotated or else :data:`AREA_OF_BOX` of the box.
        all_labelled: whether there are no other people in the picture.
        path: the file with the picture: a jpg, or a tar.
        offset: position of the picture in the file, in bytes.
        size: length in bytes; None is up to the end of the file.
        crowds: (m, 4) float32 ``xyxy`` pixels, regions in which people are not labelled one by one.
    """

    key: str
    boxes: Floats
    keypoints: Floats
    areas: Floats
    all_labelled: bool
    path: Path
    offset: int = 0
    size: int | None = None
    crowds: Floats = field(default_factory=lambda: np.zeros((0, 4), np.float32))

    def image(self) -> npt.NDArray[np.uint8]:
        """Decode the picture: (H, W, 3) uint8 RGB.

        Raises:
            TensorsimError: it cannot be decoded.
        """
        import cv2

        with self.path.open("rb") as file:
            file.seek(self.offset)
            data = file.read() if self.size is None else file.read(self.size)
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB) if data else None
        if picture is None:
            raise TensorsimError(f"{self.path}: {self.key} is not a picture that can be read")
        return picture.astype(np.uint8, copy=False)


class Shards(Sequence[Sample]):
    """The samples of tar shards, in the order of the files and of the names inside them.

    Each tar is scanned once for its labels; pictures are read on access, so shards may be larger than memory, and
    copies in other processes open the files themselves.

    Args:
        paths: tar files.

    Raises:
        TensorsimError: a file that is not a tar of such samples.
    """

    def __init__(self, paths: Iterable[str | os.PathLike[str]]) -> None:
        self.samples: list[Sample] = [sample for path in paths for sample in _read_tar(Path(path))]

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: Any) -> Any:
        return self.samples[index]


def find_shards(folder: str | os.PathLike[str], name: str) -> list[Path]:
    """The shards ``NAME-NN.tar`` of a folder, in order.

    Raises:
        TensorsimError: there is none.
    """
    paths = sorted(Path(folder).glob(f"{name}-*.tar"))
    if not paths:
        raise TensorsimError(f"{folder}: got no {name}-*.tar, expected shards of labelled pictures")
    return paths


def split(samples: Sequence[Sample], percent: int) -> tuple[list[Sample], list[Sample]]:
    """Training samples, and the given percentage of held-out samples, chosen by a hash of their keys."""
    parts: tuple[list[Sample], list[Sample]] = ([], [])
    for sample in samples:
        parts[int(hashlib.sha256(sample.key.encode()).hexdigest(), 16) % 100 < percent].append(sample)
    return parts


def read_coco_shards(folder: str | os.PathLike[str]) -> tuple[list[Sample], list[Sample]]:
    """Training and held-out COCO pictures from a folder of shards.

    Raises:
        TensorsimError: shards are missing.
    """
    paths = [path for name in COCO_SHARDS for path in find_shards(folder, name)]
    return split(Shards(paths), COCO_HELD_OUT_PERCENT)


def read_coco(annotations: str | os.PathLike[str], images: str | os.PathLike[str]) -> list[Sample]:
    """The pictures of a COCO annotation file with their people, in the order of the file.

    Args:
        annotations: ``person_keypoints_*.json`` or ``instances_*.json``.
        images: folder of the pictures.

    Returns:
        Samples; ``all_labelled`` is False where a crowd is marked.

    Raises:
        TensorsimError: no such file, or not a COCO annotation file.
    """
    path, folder = Path(annotations), Path(images)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        people = {c["id"] for c in content["categories"] if c["name"] == "person"}
        persons: dict[int, list[dict[str, Any]]] = {image["id"]: [] for image in content["images"]}
        crowds: dict[int, list[dict[str, Any]]] = {key: [] for key in persons}
        for annotation in content["annotations"]:
            if annotation["category_id"] not in people:
                continue
            points = annotation.get("keypoints")
            rows = None if points is None else np.reshape(points, (len(COCO_KEYPOINTS), 3)).tolist()
            kind = crowds if annotation.get("iscrowd", 0) else persons
            kind[annotation["image_id"]].append(annotation | {"keypoints": rows})
        return [
            Sample(
                Path(image["file_name"]).stem,
                *_labels(image["file_name"], persons[image["id"]]),
                not crowds[image["id"]],
                folder / image["file_name"],
                crowds=_labels(image["file_name"], crowds[image["id"]])[0],
            )
            for image in content["images"]
        ]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise TensorsimError(f"{path}: not a COCO annotation file ({error})") from error


def read_coco_folder(folder: Path) -> list[Sample]:
    """:func:`read_coco` for the only annotation file (``.json``) in a folder, with its pictures in ``images/``.

    Raises:
        TensorsimError: no such file, several, or not a COCO annotation file.
    """
    files = sorted(folder.glob("*.json"))
    if len(files) != 1:
        raise TensorsimError(f"{folder}: got {len(files)} json files, expected one")
    return read_coco(files[0], folder / "images")


def _read_tar(path: Path) -> list[Sample]:
    pictures: dict[str, tarfile.TarInfo] = {}
    labels: dict[str, Any] = {}
    try:
        with tarfile.open(path) as tar:
            for member in tar:
                name = Path(member.name)
                if name.suffix == ".jpg":
                    pictures[name.stem] = member
                elif name.suffix == ".json":
                    content = tar.extractfile(member)
                    labels[name.stem] = json.load(content) if content is not None else None
        samples = []
        for key, member in sorted(pictures.items()):
            label = labels.get(key, {"persons": [], "all_persons_labelled": True})
            everyone = label["all_persons_labelled"]
            if not isinstance(everyone, bool):
                raise ValueError(f"{key}: got all_persons_labelled {everyone!r}, expected true or false")
            labelled = _labels(key, label["persons"])
            samples.append(Sample(key, *labelled, everyone, path, member.offset_data, member.size))
    except (OSError, tarfile.TarError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise TensorsimError(f"{path}: not a shard of jpg and json ({error})") from error
    if not samples:
        raise TensorsimError(f"{path}: got no pictures, expected a shard of KEY.jpg and KEY.json")
    return samples


def _labels(key: str, persons: list[dict[str, Any]]) -> tuple[Floats, Floats, Floats]:
    """Boxes (n, 4) ``xyxy``, points (n, 19, 3) and areas (n,) of the annotated people of the picture ``key``."""
    boxes = np.zeros((len(persons), 4), np.float32)
    keypoints = np.zeros((len(persons), len(POINTS), 3), np.float32)
    areas = np.zeros(len(persons), np.float32)
    for i, person in enumerate(persons):
        box = np.array(person["bbox"], np.float32)
        if box.shape != (4,) or not np.isfinite(box).all() or (box[2:] < 0).any():
            raise ValueError(f"{key}: got bbox {person['bbox']}, expected x, y, width, height")
        boxes[i] = [*box[:2], *box[:2] + box[2:]]
        areas[i] = person.get("area", AREA_OF_BOX * box[2:].prod())
        if not 0 <= areas[i] < np.inf:
            raise ValueError(f"{key}: got area {person['area']}, expected pixels")
        if person["keypoints"] is not None:
            points = np.array(person["keypoints"], np.float32)
            if points.shape not in ((17, 3), (19, 3)) or not np.isfinite(points).all():
                raise ValueError(
                    f"{key}: got keypoints {points.shape}, expected 17 or 19 rows of finite x, y, v"
                )
            keypoints[i, : len(points)] = points
    return boxes, keypoints, areas
