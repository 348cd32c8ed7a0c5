"""What a source of a data set offers: labelled clips of people."""

from dataclasses import dataclass
from typing import Protocol

from tensorsim.data.sets.scene import Scene
from tensorsim.data.sets.variations import Variation


@dataclass(frozen=True)
class Clip:
    """One labelled clip.

    Attributes:
        name: unique within its source; it does not depend on where the files are.
        label: name of its class.
        person: who is in it; if unknown, the file, so that each file counts as a different person.
        origin: the video or file, or the generator.
        part: part of the data set, if the source fixes it; else "".
        path: path of its file, if it has one.
        key: key of the motion within the file.
        start_s, end_s: the section of the file; a file named like the clip holds only this section.
    """

    name: str
    label: str
    person: str
    origin: str
    part: str = ""
    path: str = ""
    key: str = ""
    start_s: float | None = None
    end_s: float | None = None


class ClipSource(Protocol):
    """Labelled clips, and the people in them."""

    #: Names of the classes in their order.
    labels: tuple[str, ...]
    #: Whether the source states who is in each clip; otherwise each file counts as a different person.
    names_people: bool
    #: Whether networks have to find people in videos, which :meth:`prepare` does.
    finds_people: bool

    def __len__(self) -> int:
        """Number of clips."""

    def clip(self, index: int) -> Clip:
        """One of the clips."""

    def person(self, index: int) -> str:
        """Who is in a clip; the same as ``clip(index).person``, without the rest."""

    def adapted(self, clip: Clip, variation: Variation) -> Variation:
        """The variation, with values that the clip itself determines."""

    def scene(self, clip: Clip, variation: Variation) -> Scene:
        """The people of a varied clip on the floor.

        Raises:
            TensorsimError: a file that cannot be read, or nobody in it.
        """

    def prepare(self, clip: Clip, again: bool = False) -> None:
        """Do the work that all variations of a clip share, such as finding people in a video, and keep the result.

        Args:
            clip: one of the clips.
            again: retry if it failed before; failures are kept as well.
        """
