import pytest

from tensorsim.device import usable_device
from tensorsim.errors import TensorsimError


@pytest.mark.parametrize(
    "name", ["meta", "hpu", "privateuseone", "xla", "mps", "abacus", "cuda:99", "", "-1", "cpu:x"]
)
def test_devices_without_values_are_refused_in_one_line(name: str) -> None:
    with pytest.raises(TensorsimError, match=rf"^--device: '{name}' is not usable here: [^\n]+$"):
        usable_device(name)


def test_the_processor_is_usable() -> None:
    assert usable_device("cpu").type == "cpu"
    assert usable_device("auto").type in ("cpu", "cuda")
