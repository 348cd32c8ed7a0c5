"""Rendered people: films of the generator, read back by the networks, with their errors and the same every time."""

from pathlib import Path
from typing import Any

import pytest

from tensorsim.body.skeleton import mid_hips
from tensorsim.data.sets.again import sample_again
from tensorsim.data.sets.build import build_dataset
from tensorsim.data.sets.engines import Processes
from tensorsim.data.sets.manifest import rows_of
from tensorsim.data.sets.people import PeopleFinder
from tensorsim.data.sets.plan import Plan
from tensorsim.data.sets.reading import SimulatedMaps
from tensorsim.data.sets.recipe import DatasetRecipe, SourceConfig, SplitConfig
from tensorsim.data.sets.rendered import RenderedPeople
from tensorsim.data.sets.scene import Scene
from tensorsim.data.skeletons import Motion
from tests.data.sets.recipes import small_recipe


def rendered_recipe(**changes: Any) -> DatasetRecipe:
    fields: dict[str, Any] = {"fps": 10.0, "image_size": (180, 320)}
    source = SourceConfig("rendered", classes=("sitting down",), people=2, **fields | changes)
    return small_recipe(sources=(source,), split=SplitConfig(shares=(1.0, 0.0, 0.0)))


def test_films_are_named_and_sized_by_the_recipe() -> None:
    plan = Plan(rendered_recipe(fps=None, image_size=None))
    source: Any = plan.sources[0]
    assert (source.fps, source.size, source.finds_people, len(plan)) == (30.0, (360, 640), True, 2)
    film = source._filmed(source.clip(1))
    assert film.joints.shape == (1, 30, 14, 3)
    assert 1.5 <= float(mid_hips(film.joints)[..., 1].min()) <= 7.0
    assert source.clip(1).name == "rendered0-000001/S5 Sitting Down"


def test_simulated_maps_find_people_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rendering and networks are the slow part."""
    watched = []

    def seen(self: RenderedPeople, film: Scene, seed: int) -> Motion:
        watched.append(seed)
        return Motion(film.joints, film.valid, film.fps)

    monkeypatch.setattr(RenderedPeople, "_watched", seen)
    samples = list(SimulatedMaps(rendered_recipe(), rounds=2, cache=tmp_path / "people"))
    assert len(samples) == 4
    assert len(watched) == len(set(watched)) == 2
    assert len(list((tmp_path / "people").glob("*.npz"))) == 2


@pytest.mark.slow
def test_networks_find_the_people_once_and_the_bytes_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = rendered_recipe()
    assert build_dataset(recipe, tmp_path / "set", quiet=True) == (2, 0, 2)
    source: Any = Plan(recipe, str(tmp_path / "set" / ".people")).sources[0]
    with monkeypatch.context() as patch:
        patch.setattr(PeopleFinder, "networks", None)  # any further request for them fails
        found, film = source._motion(source.clip(0)), source._filmed(source.clip(0))
    assert found.valid.all()
    errors = (found.joints - mid_hips(found.joints)[..., None, :]) - (
        film.joints - mid_hips(film.joints)[..., None, :]
    )
    assert 0.01 < float(errors.norm(dim=-1).mean()) < 0.15

    build_dataset(recipe, tmp_path / "two", Processes(2), quiet=True)
    rows, again = list(rows_of(tmp_path / "set")), list(rows_of(tmp_path / "two"))
    assert rows == again
    made = sample_again(tmp_path / "set", rows[0]["id"], cache=tmp_path / "empty")
    assert made.row["sha256"] == rows[0]["sha256"]
