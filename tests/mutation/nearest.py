"""Which tests are nearest to a file of the package."""

import ast
import functools
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: More files of tests than these find little that they do not.
MOST = 3


def nearest_tests(file: Path) -> list[Path]:
    """The test file of the same name, then those of its room that name most of what the file defines.

    Where few name any of it, those nearest to the modules that import it too. At last the test of all defaults.
    """
    return [*_nearest(file, frozenset()), ROOT / "tests" / "test_interface.py"]


def _nearest(file: Path, seen: frozenset[Path]) -> list[Path]:
    part = file.relative_to(ROOT / "tensorsim")
    own = ROOT / "tests" / part.with_name(f"test_{part.name}")
    words = re.compile("|".join(rf"\b{re.escape(name)}\b" for name in (module_name(file), *_public(file))))
    rooms = [ROOT / "tests" / part.parent, ROOT / "tests" / part.parts[0], ROOT / "tests"]
    found = [own] if own.is_file() else []
    for room in rooms:
        counts = {test: len(set(words.findall(_text(test)))) for test in sorted(room.rglob("test_*.py"))}
        found += [
            test for test in sorted(counts, key=lambda t: -counts[t]) if counts[test] and test not in found
        ]
        if len(found) >= MOST or (found and room is rooms[1]):
            break
    for user in _users(file):
        near = user.relative_to(ROOT / "tensorsim").parts[0] == part.parts[0]
        if user not in seen and (not found or (near and len(found) < MOST)):
            found += [test for test in _nearest(user, seen | {file}) if test not in found]
    return found[:MOST]


def module_name(file: Path) -> str:
    """The dotted name of a module of the package."""
    return ".".join(file.relative_to(ROOT).with_suffix("").parts)


def _public(file: Path) -> list[str]:
    """Classes, functions and constants of a module that others may name."""
    names = []
    for node in ast.parse(_text(file)).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names.append(node.name)
        elif isinstance(node, ast.Assign):
            names += [target.id for target in node.targets if isinstance(target, ast.Name)]
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names.append(node.target.id)
    return [name for name in names if not name.startswith("_") and len(name) > 3]


def _users(file: Path) -> list[Path]:
    """Modules of the package that import this one, those of its folder first."""
    line = re.compile(rf"^\s*from {re.escape(module_name(file))} import", re.MULTILINE)
    users = [user for user in sorted((ROOT / "tensorsim").rglob("*.py")) if line.search(_text(user))]
    return sorted(users, key=lambda user: user.parent != file.parent)


@functools.cache
def _text(file: Path) -> str:
    return file.read_text(encoding="utf-8")
