"""The classes of a classifier."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from torch import Tensor

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
        >>> labels.index("walking")
        1
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

    def index(self, name: str) -> int:
        """The output that stands for this class.

        Raises:
            TensorsimError: no such class.
        """
        if name not in self.names:
            raise TensorsimError(f"class name: got {name!r}, expected one of {', '.join(self.names)}")
        return self.names.index(name)

    def most_likely(self, logits: Tensor) -> list[str]:
        """Names of the largest of the logits (B, classes), one per row.

        Raises:
            TensorsimError: another number of classes.
        """
        if logits.dim() != 2 or logits.shape[1] != len(self):
            raise TensorsimError(f"logits: got shape {list(logits.shape)}, expected (B, {len(self)})")
        return [self.names[i] for i in logits.argmax(1).tolist()]

    def to_text(self) -> str:
        """As the header of a weight file stores it."""
        return json.dumps(list(self.names))

    @classmethod
    def from_text(cls, text: str) -> "LabelSet":
        """The inverse of :meth:`to_text`.

        Raises:
            TensorsimError: something else.
        """
        try:
            names: Iterable[str] = json.loads(text)
        except json.JSONDecodeError as error:
            raise TensorsimError(f"class_names: got {text!r}, expected a JSON list of names") from error
        return cls(tuple(names) if isinstance(names, list) else ())
