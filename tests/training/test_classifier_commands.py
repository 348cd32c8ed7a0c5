"""``tensorsim train classifier``: what it makes, in which order, and what it refuses before."""

from pathlib import Path
from typing import Any

import pytest
import torch

from tensorsim.commands.evaluate_classifier import EvaluateClassifier
from tensorsim.commands.train_classifier import TrainClassifier
from tensorsim.errors import TensorsimError
from tensorsim.evaluation.clips import ActivityClip
from tensorsim.evaluation.films import FPS, Filmed, filmed, true_keypoints
from tensorsim.training import maps
from tensorsim.training.film_errors import FilmErrors, watched_films

pytest.importorskip("tensorboard")


@pytest.fixture
def films(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of the truth loop with one film, in which everything was found where it is."""
    clip = ActivityClip("S8 Walking", "0", 7)
    seen = true_keypoints(clip)
    with monkeypatch.context() as patch:
        patch.setattr("tensorsim.evaluation.films.render_and_watch", lambda *_: Filmed(seen, seen))
        nothing = torch.nn.Identity()
        filmed(tmp_path / "films" / "S8_Walking" / "0-0123abcd.npz", clip, nothing, nothing)
    return tmp_path / "films"


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stores of short clips."""
    usual = maps.MapSettings.__init__

    def init(self: maps.MapSettings, **settings: Any) -> None:
        usual(self, **{"duration_s": 1.0} | settings)

    monkeypatch.setattr(maps.MapSettings, "__init__", init)


def command(tmp_path: Path, **options: Any) -> TrainClassifier:
    return TrainClassifier(
        **{
            "maps": tmp_path / "maps",
            "network": "spgnet",
            "scenes": ("through-wall",),
            "people": 5,
            "epochs": 1,
            "batch": 24,
            "workers": 0,
            "device": "cpu",
            "quiet": True,
            "out": tmp_path / "out",
        }
        | options
    )


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_trains_on_true_motion_and_on_motion_as_films_show_it(
    films: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command(tmp_path, films=films, film_maps=tmp_path / "film_maps", film_people=5).run()
    assert "accuracy through-wall films" in capsys.readouterr().out
    stores = {name: maps.MapStore(tmp_path / name) for name in ("maps", "film_maps")}
    assert {len(store.people["through-wall"]) for store in stores.values()} == {5}
    errors = FilmErrors(watched_films(films))
    assert stores["film_maps"].settings == maps.MapSettings.of_films(2, errors)
    assert stores["film_maps"].settings.motion_hz == FPS
    assert stores["maps"].settings.films == ""
    weights = tmp_path / "out" / "best.safetensors"
    EvaluateClassifier(weights, scenes=("through-wall",), films=films, quiet=True).run()
    assert "% of 1" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"films": Path("films")}, "got one of them, expected both or none"),
        ({"film_maps": Path("maps")}, "got one of them, expected both or none"),
        ({"size": 30}, "--size: got 30, expected a divisor of 224"),
        ({"snr": (50.0, 10.0)}, "--snr: got 50 10, expected the lower one first"),
        ({"masks": (0.0, 2.0)}, "--masks: got"),
        ({"scenes": ()}, "--scenes: got none"),
        ({"people": 0}, "--people: got 0, expected at least 5"),
        ({"film_people": 4}, "--film-people: got 4, expected at least 5"),
        ({"learning_rate": float("nan")}, "--learning-rate: got nan"),
    ],
)
def test_refuses_before_anything_is_made(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match=message):
        command(tmp_path, **options).run()
    assert not list(tmp_path.iterdir())


def test_refuses_a_batch_of_nothing_before_maps_are_made(tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match="batch: got 0, expected an integer of at least 1"):
        command(tmp_path, batch=0).run()
    assert not list(tmp_path.iterdir())
