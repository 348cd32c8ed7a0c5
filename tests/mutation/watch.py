"""What each test runs and how long it takes, and a choice among tests by that: plugins of pytest.

Tests that compare a stage with its scripted or exported form are left out: a slip changes both alike, and they take
the most time.
"""

import json
import re
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

_COMPILED = re.compile("script|export")


class Watch:
    """Writes the seconds of each test, and the lines of the package that it runs, to a file of JSON."""

    def __init__(self, root: Path, result: Path) -> None:
        self.package, self.start, self.result = str(root / "tensorsim"), len(str(root)) + 1, result
        self.found: dict[str, dict[str, Any]] = {}
        self.lines: dict[str, set[int]] = defaultdict(set)

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Drop what is left out."""
        items[:] = [item for item in items if not _COMPILED.search(item.name)]

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Watch one test with its fixtures."""
        self.lines, begin = defaultdict(set), time.monotonic()
        sys.settrace(self._call)
        yield
        sys.settrace(None)
        lines = {name[self.start :]: sorted(lines) for name, lines in self.lines.items()}
        self.found[item.nodeid] = {"seconds": round(time.monotonic() - begin, 3), "lines": lines}

    def pytest_sessionfinish(self) -> None:
        """All tests have run."""
        self.result.write_text(json.dumps(self.found))

    def _call(self, frame: FrameType, event: str, argument: Any) -> Any:
        if not frame.f_code.co_filename.startswith(self.package):
            return None
        lines = self.lines[frame.f_code.co_filename]

        def local(frame: FrameType, event: str, argument: Any) -> Any:
            lines.add(frame.f_lineno)
            return local

        return local(frame, event, argument)


class Choose:
    """Runs these tests only, in this order."""

    def __init__(self, names: list[str]) -> None:
        self.place = {name: i for i, name in enumerate(names)}

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Drop the others."""
        chosen = [item for item in items if item.nodeid in self.place]
        items[:] = sorted(chosen, key=lambda item: self.place[item.nodeid])
