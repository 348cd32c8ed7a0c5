"""``tensorsim evaluate classifier`` and ``evaluate denoiser`` on networks that have learned nothing."""

import csv
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from tensorsim.commands.evaluate_classifier import EvaluateClassifier
from tensorsim.commands.evaluate_denoiser import EvaluateDenoiser
from tensorsim.enhance.dncnn import DnCNN
from tensorsim.errors import TensorsimError
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.recognition.spgnet import SPGNet
from tensorsim.registry import locate
from tensorsim.training import classifier
from tensorsim.training.classifier import clips_of, logits_of
from tensorsim.training.denoiser_scores import COLUMNS
from tensorsim.training.film_maps import classify_poses, labelled_poses
from tensorsim.training.maps import MapSettings, MapStore
from tensorsim.weights import save_weights


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """A network that calls everything S9."""
    network = SPGNet(12)
    network.fc2.weight.data.zero_()
    network.fc1.weight.data.fill_(1.0)
    network.fc2.weight.data[8] = 1.0
    network.norm.bias.data.fill_(1.0)
    path = tmp_path / "w.safetensors"
    save_weights(network, path, {"network": "SPGNet", "size": "32"})
    return path


def test_classifier_on_maps(weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    maps = tmp_path / "maps"
    maps.mkdir()
    settings = MapSettings(seed=1)
    (maps / "settings.json").write_text(json.dumps(asdict(settings)))
    shape = (12, settings.size, settings.size)
    for person in range(2):
        signal = torch.randint(0, 255, shape, generator=torch.Generator().manual_seed(person))
        save_file(
            {
                "signal": signal.to(torch.uint8),
                "cross": torch.zeros(shape, dtype=torch.int8),
                "noise": torch.full(shape[1:], 255, dtype=torch.uint8),
                "gain_db": torch.zeros(12),
            },
            maps / f"through-wall-{person:05d}.safetensors",
        )
    EvaluateClassifier(
        weights, maps, ("through-wall",), people=2, snr=(50.0, 10.0), out=tmp_path / "out", quiet=True
    ).run()
    printed = capsys.readouterr().out.splitlines()
    assert printed[1].split() == ["through-wall", "8.3", "%", "8.3", "%", "24"]
    for ratio in (50, 10):
        with (tmp_path / "out" / f"confusion_through-wall_{ratio}dB.csv").open() as file:
            rows = list(csv.reader(file))
        assert rows[0][1:] == [f"S{k}" for k in range(1, 13)]
        assert all([int(n) for n in row[1:]] == [0] * 8 + [2] + [0] * 3 for row in rows[1:])
        assert (tmp_path / "out" / f"confusion_through-wall_{ratio}dB.png").stat().st_size > 1000


def small_store(folder: Path, size: int, people: int = 1) -> None:
    """Pictures in which everybody approaches: the upper half, of positive speeds, is bright."""
    folder.mkdir()
    (folder / "settings.json").write_text(json.dumps(asdict(MapSettings(seed=1, size=size))))
    signal = torch.zeros(12, size, size, dtype=torch.uint8)
    signal[:, size // 2 :] = 255
    for person in range(people):
        content = {
            "signal": signal,
            "cross": torch.zeros(12, size, size, dtype=torch.int8),
            "noise": torch.full((size, size), 255, dtype=torch.uint8),
            "gain_db": torch.zeros(12),
        }
        save_file(content, folder / f"through-wall-{person:05d}.safetensors")


def test_a_store_has_the_size_that_the_weights_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The shipped SPNet takes 64 pixels, of which 224 is no multiple."""
    from tensorsim.training import maps

    made: list[MapSettings] = []

    def build(folder: Path, people: int, scenes: object, settings: MapSettings, quiet: bool) -> None:
        made.append(settings)
        small_store(folder, settings.size)

    monkeypatch.setattr(maps, "build_maps", build)
    EvaluateClassifier(
        locate("spnet-activities"), tmp_path / "maps", ("through-wall",), people=1, snr=(50.0,), quiet=True
    ).run()
    assert [settings.size for settings in made] == [64]
    assert capsys.readouterr().out.splitlines()[1].endswith(" 12")


def test_both_ways_round_are_averaged_where_the_weights_state_it(tmp_path: Path) -> None:
    small_store(tmp_path / "maps", 32)
    store, seen = MapStore(tmp_path / "maps"), []

    class Upper(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.weight = torch.nn.Parameter(torch.ones(()))

        def forward(self, pictures: torch.Tensor) -> torch.Tensor:
            seen.append(pictures)
            return pictures[:, :, 16:].mean((1, 2, 3))[:, None] * self.weight

    clips = clips_of(store, ("through-wall",), 1, None)
    one = logits_of(Upper(), store, clips, (50.0, 50.0), 32)
    both = logits_of(Upper(), store, clips, (50.0, 50.0), 32, either_way=True)
    torch.testing.assert_close(seen[2], seen[0].flip(-2))
    other = seen[2][:, :, 16:].mean((1, 2, 3))[:, None]
    torch.testing.assert_close(both, 0.5 * (one + other))
    assert float((both - one).abs().max()) > 0.1


def test_what_the_weights_state_of_averaging_is_followed(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []

    def logits(net: object, store: object, clips: list[object], *_: object, either_way: bool) -> torch.Tensor:
        asked.append(either_way)
        return torch.zeros(len(clips), 12)

    monkeypatch.setattr(classifier, "logits_of", logits)
    small_store(tmp_path / "maps", 224)
    for stated in ("0", "1"):
        save_weights(SPGNet(12), weights, {"network": "SPGNet", "size": "32", "either_way": stated})
        EvaluateClassifier(
            weights, tmp_path / "maps", ("through-wall",), people=1, snr=(50.0,), quiet=True
        ).run()
    assert asked == [False, True]


def test_ratios_that_differ_by_less_than_a_decibel_have_files_of_their_own(
    weights: Path, tmp_path: Path
) -> None:
    small_store(tmp_path / "maps", 224)
    EvaluateClassifier(
        weights,
        tmp_path / "maps",
        ("through-wall",),
        people=1,
        snr=(10.2, 10.4),
        out=tmp_path / "out",
        quiet=True,
    ).run()
    assert sorted(path.name for path in (tmp_path / "out").glob("*.csv")) == [
        "confusion_through-wall_10.2dB.csv",
        "confusion_through-wall_10.4dB.csv",
    ]


@pytest.mark.parametrize(
    ("classes", "stated", "message"),
    [
        (12, {"inputs": "ridges"}, "inputs: got ridges, expected doppler"),
        (12, {"speed_m_s": "6.0"}, "speed_m_s: got 6.0, expected 3.8"),
        (12, {"range_db": "30.0"}, "range_db: got 30.0, expected 40.0"),
        (
            3,
            {"class_names": json.dumps(["a", "b", "c"])},
            r"class_names: got \('a', 'b', 'c'\), expected \('S1 Empty'",
        ),
        (3, {}, "got a network of 3 classes, expected 12"),
    ],
)
def test_networks_of_other_pictures_are_refused_before_maps_are_made(
    classes: int, stated: dict[str, str], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "w.safetensors"
    save_weights(SPGNet(classes), path, {"network": "SPGNet", "size": "32"} | stated)
    with pytest.raises(TensorsimError, match=message):
        EvaluateClassifier(path, tmp_path / "maps", people=1, quiet=True).run()
    assert not (tmp_path / "maps").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"people": -5}, "--people: got -5, expected an integer of at least 1"),
        ({"people": 4, "held_out": True}, "--people: got 4, expected an integer of at least 5"),
        ({"snr": ()}, "--snr: got no ratios"),
        ({"snr": (float("nan"),)}, "--snr: got nan"),
        ({"scenes": ()}, "--scenes: got 0"),
    ],
)
def test_bad_options_of_classifiers_are_refused_before_maps_are_made(
    weights: Path, options: dict[str, object], message: str, tmp_path: Path
) -> None:
    with pytest.raises(TensorsimError, match=message):
        EvaluateClassifier(weights, tmp_path / "maps", **options).run()  # type: ignore[arg-type]
    assert not (tmp_path / "maps").exists()


def write_pose(folder: Path, activity: int) -> None:
    motion = ActivityGenerator().generate(activity, duration_s=1.5, rate_hz=30.0)
    folder.mkdir(parents=True)
    np.savez(folder / "pose.npz", joints_m=motion.joints.numpy(), valid=motion.valid.numpy(), fps=30.0)


def test_classifier_on_films(weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    films = tmp_path / "films"
    write_pose(films / "S8 Walking", 7)
    write_pose(films / "more" / "S9-second", 8)
    poses = labelled_poses(films)
    assert sorted(pose.activity for pose in poses) == [7, 8]
    assert poses[0].joints.shape == (1, 45, 14, 3)
    assert classify_poses(weights, poses, "through-wall", 50.0, quiet=True) == [8, 8]
    EvaluateClassifier(weights, scenes=("through-wall",), poses=films, quiet=True).run()
    printed = capsys.readouterr().out.splitlines()
    assert "50.0 % of 2" in printed[0]
    assert printed[1:] == ["  1 S8 as S9"]


def test_refuses_films_without_a_class(weights: Path, tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match=r"got no pose\.npz"):
        labelled_poses(tmp_path)
    write_pose(tmp_path / "S13 Flying", 7)
    with pytest.raises(TensorsimError, match="does not begin with S1 to S12"):
        labelled_poses(tmp_path)
    with pytest.raises(TensorsimError, match="got nothing to classify"):
        EvaluateClassifier(weights).run()


def test_denoiser(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "own.safetensors"
    save_weights(DnCNN(depth=2, channels=4), path, {})
    EvaluateDenoiser(
        path, clips=1, scenes=("through-wall",), ksvd=False, out=tmp_path / "table.csv", quiet=True
    ).run()
    with (tmp_path / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["denoiser"] for row in rows} == {"none", str(path), "Perona-Malik"}
    assert {row["map"] for row in rows} == {"doppler_time", "range_time_mti"}
    assert len(rows) == 6
    assert all(row[COLUMNS[0]] for row in rows)
    assert len(capsys.readouterr().out.splitlines()) == 7


def test_denoisers_of_one_name_are_two_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [tmp_path / folder / "best.safetensors" for folder in "ab"]
    for path in paths:
        save_weights(DnCNN(depth=2, channels=4), path, {})
    EvaluateDenoiser(paths[0], (paths[1],), clips=1, scenes=("through-wall",), ksvd=False, quiet=True).run()
    printed = capsys.readouterr().out
    assert all(printed.count(str(path)) == 2 for path in paths)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clips": 0}, "--clips: got 0"),
        ({"snr": ()}, "--snr: got no ratios"),
        ({"snr": (10.0, float("nan"))}, "--snr: got nan, expected finite numbers of dB"),
        ({"scenes": ("free-space", "free-space")}, "--scenes: got 'free-space' twice"),
        ({"scenes": ()}, "--scenes: got 0"),
        ({"seed": -1}, "--seed: got -1"),
        ({"out": Path("nowhere/table.csv")}, "--out: got nowhere/table.csv"),
        ({"out": Path(".")}, "--out: got ., expected a file name in an existing folder"),
    ],
)
def test_bad_options_of_denoisers_are_refused_before_work_starts(
    options: dict[str, object], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(TensorsimError, match=message):
        EvaluateDenoiser(tmp_path / "none.safetensors", **options).run()  # type: ignore[arg-type]
