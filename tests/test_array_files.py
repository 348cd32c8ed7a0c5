"""Arrays in .npz, .mat and HDF5, read back by NumPy, SciPy and h5py."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from tensorsim.array_files import array_formats, save_arrays
from tensorsim.commands.clip_options import ClipOptions
from tensorsim.commands.options import FIELDS
from tensorsim.commands.panel import PANEL, PanelOptions
from tensorsim.commands.simulate import Simulate
from tensorsim.config import SimulationConfig
from tensorsim.errors import TensorsimError

ARRAYS: dict[str, np.ndarray | float] = {
    "map": np.arange(12, dtype=np.float32).reshape(3, 4),
    "axis": np.arange(4.0),
    "valid": np.array([[True, False]]),
    "fps": 29.97,
}
PAGE = Path(__file__).resolve().parents[1] / "notebooks" / "matlab.md"


def test_every_format_holds_the_same(tmp_path: Path) -> None:
    save_arrays(tmp_path / "maps", ARRAYS, array_formats("mat,h5"))
    assert {path.name for path in tmp_path.iterdir()} == {"maps.npz", "maps.mat", "maps.h5"}
    h5py = pytest.importorskip("h5py")
    mat = loadmat(tmp_path / "maps.mat", squeeze_me=True)
    with np.load(tmp_path / "maps.npz") as npz, h5py.File(tmp_path / "maps.h5") as h5:
        for name, x in ARRAYS.items():
            for file in (npz, h5):
                assert np.array_equal(file[name][()], x)
                assert np.asarray(file[name]).dtype == np.asarray(x).dtype
            assert np.array_equal(mat[name], np.squeeze(x))
    assert loadmat(tmp_path / "maps.mat")["axis"].shape == (4, 1), "a column in MATLAB"


def test_refuses_unknown_formats_and_a_missing_library(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(TensorsimError, match="--save: got 'csv', expected formats of npz, mat, h5"):
        array_formats("mat,csv")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(TensorsimError, match="pip install h5py"):
        array_formats("h5")
    assert array_formats("mat") == ("npz", "mat")


def test_the_table_of_the_panel_is_that_of_the_program() -> None:
    rows = [
        f"| {group} | {name} | `--{option.replace('_', '-')}` | `{field.replace('__', '.')}` | {unit or '-'} |"
        for group, name, option, field, unit in PANEL
    ]
    table = PAGE.read_text(encoding="utf-8").split("|---|---|---|---|---|\n")[1]
    assert table.splitlines() == rows


def test_every_parameter_of_the_panel_is_an_option_and_a_field() -> None:
    config = SimulationConfig.through_wall()
    for parameter in PANEL:
        assert parameter.option in Simulate.__dataclass_fields__
        value = config
        for name in parameter.field.split("__"):
            value = getattr(value, name)
        if parameter.option in ClipOptions.__dataclass_fields__:
            assert FIELDS[parameter.option] == parameter.field
    assert {p.option for p in PANEL} >= set(PanelOptions.__dataclass_fields__)
