"""The notebooks run from top to bottom; each asserts in its last cell what it claims."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
#: These read recordings that are not part of the project.
NEED_DATA = {"measured_radar", "believe_it"}
#: Those who have no recordings see these as they ran.
SHIPPED_WITH_OUTPUTS = {"believe_it"}


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.filterwarnings("ignore")  # of the notebook client; the kernel is a process of its own
def test_notebook_runs(path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    if path.stem in NEED_DATA:
        monkeypatch.setenv("TENSORSIM_SHARED_DATA", str(request.getfixturevalue("shared_data")))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    notebook = nbformat.read(path, as_version=4)
    assert "assert" in notebook.cells[-1].source
    nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}
    ).execute()


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_stored_without_outputs(path: Path) -> None:
    nbformat = pytest.importorskip("nbformat")
    cells = nbformat.read(path, as_version=4).cells
    if path.stem in SHIPPED_WITH_OUTPUTS:
        assert path.stat().st_size < 1_000_000
        pictures = [o for cell in cells for o in cell.get("outputs", []) if "image/png" in o.get("data", {})]
        assert len(pictures) >= 3
        assert not any(o.output_type == "error" for cell in cells for o in cell.get("outputs", []))
        return
    for cell in cells:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None


@pytest.mark.parametrize("name", sorted(NEED_DATA))
def test_missing_recordings_are_said_plainly(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    nbformat = pytest.importorskip("nbformat")
    notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
    monkeypatch.setenv("TENSORSIM_SHARED_DATA", str(tmp_path / "nowhere"))
    first = next(cell.source for cell in notebook.cells if cell.cell_type == "code")
    with pytest.raises(FileNotFoundError, match="set TENSORSIM_SHARED_DATA"):
        exec(first, {})


def test_every_picture_of_the_physics_is_checked() -> None:
    nbformat = pytest.importorskip("nbformat")
    notebook = nbformat.read(ROOT / "notebooks" / "physics_you_can_check.ipynb", as_version=4)
    pictures = [cell.source for cell in notebook.cells if "plt.subplots(" in cell.source]
    assert len(pictures) >= 12
    assert all("\ncheck(" in source or "    check(" in source for source in pictures)
