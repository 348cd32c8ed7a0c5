"""Slips of a text by hand, the tests that are nearest, and that what is explained exists."""

from tests.mutation.equivalent import explained
from tests.mutation.nearest import ROOT, nearest_tests
from tests.mutation.slips import slips

SOURCE = '''"""A module of 1 function."""

SIZE = 2.0

def f(x: Tensor, dim: int = -1, flip: bool = False) -> Tensor:
    """Takes 3 arguments."""
    check_rank(x, 3)
    if x.shape[0] < 4 and not flip:
        raise ValueError(f"got {x.shape[0] - 1}")
    net.eval()
    return torch.stack([x.sin(), -x], dim=dim) * SIZE  # type: ignore
'''


def test_slips_of_a_text() -> None:
    found = {(slip.line, slip.after) for slip in slips(SOURCE)}
    define = "def f(x: Tensor, dim: int = {}, flip: bool = {}) -> Tensor:"
    assert found == {
        (3, "SIZE = 2.501"),
        (5, define.format("1", "False")),
        (5, define.format("-2", "False")),
        (5, define.format("-1", "True")),
        (8, "if x.shape[0] < 4 or not flip:"),
        (8, "if x.shape[0] <= 4 and not flip:"),
        (8, "if x.shape[1] < 4 and not flip:"),
        (8, "if x.shape[0] < 5 and not flip:"),
        (8, "if x.shape[0] < 4 and flip:"),
        (10, "pass"),
        (11, "return torch.stack([x.sin(), -x], dim=dim) / SIZE  # type: ignore"),
        (11, "return torch.stack([-x, x.sin()], dim=dim) * SIZE  # type: ignore"),
        (11, "return torch.stack([x.cos(), -x], dim=dim) * SIZE  # type: ignore"),
        (11, "return torch.stack([x.sin(), x], dim=dim) * SIZE  # type: ignore"),
    }
    for slip in slips(SOURCE):
        changed = [a for a, b in zip(slip.source.splitlines(), SOURCE.splitlines(), strict=True) if a != b]
        assert [line.strip() for line in changed] == [slip.after]
        assert slip.by_import == (slip.line in (3, 5))


def test_what_is_explained_is_a_slip_of_the_package() -> None:
    for name in explained():
        file, _, after = name.partition(": ")
        assert after in {slip.after for slip in slips((ROOT / file).read_text(encoding="utf-8"))}, name


def test_the_file_of_the_same_name_is_nearest() -> None:
    tests = nearest_tests(ROOT / "tensorsim" / "vision" / "tracking" / "joining.py")
    assert tests[0] == ROOT / "tests" / "vision" / "tracking" / "test_joining.py"
    assert tests[-1] == ROOT / "tests" / "test_interface.py"
    inner = nearest_tests(ROOT / "tensorsim" / "vision" / "lifting" / "bone_descent.py")
    assert inner[0].name == "test_bone_fit.py", "of the module that imports it"
