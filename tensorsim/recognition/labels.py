"""The classes of a classifier."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError


@dataclass(frozen=True)
class LabelSet:
    """Names of classes in the order of a classifier's outputs; by default the 12 activities.

    Args:
        names: one per class.

    Raises:
        TensorsimError: no names, an empty one, or one that occurs twice.

    Example:
        >>> labels = LabelSet(("waving", "walking"))
        >>> len(labels), list(labels)
        (2, ['waving', 'walking'])
    """

    names: tuple[str, ...] = ACTIVITIES

    def __post_init__(self) -> None:
        names = self.names
        if isinstance(names, str) or not all(isinstance(name, str) and name for name in names):
            raise TensorsimError(f"class_names: got {names!r}, expected a name for each class")
        object.__setattr__(self, "names", tuple(names))
        if not names or len(set(names)) < len(self.names):
            raise TensorsimError(f"class_names: got {list(names)}, expected different names, at least one")

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def to_text(self) -> str:
        """The text that the header of a weight file stores."""
        return json.dumps(list(self.names))

    @classmethod
    def from_text(cls, text: str) -> "LabelSet":
        """The inverse of :meth:`to_text`.

        Raises:
            TensorsimError: any other text.
        """
        try:
            names: Iterable[str] = json.loads(text)
        except json.JSONDecodeError as error:
            raise TensorsimError(f"class_names: got {text!r}, expected a JSON list of names") from error
        return cls(tuple(names) if isinstance(names, list) else ())
