"""Reports from known results: order, figures, statements."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError
from tensorsim.evaluation.clips import ActivityClip
from tensorsim.evaluation.labelled_films import LabelledFilm
from tensorsim.evaluation.measured.sets import SETS, MeasuredSet
from tensorsim.evaluation.scores import MAPS
from tensorsim.experiments import ablations, catalogue, networks, paper, real, real_films, video
from tensorsim.experiments.catalogue import EXPERIMENTS, Experiment
from tensorsim.experiments.stored import RESULTS, stored_names, stored_table
from tensorsim.experiments.trials import Trial
from tensorsim.experiments.work import Report, Table, Work
from tensorsim.recognition.networks import find_classifier
from tensorsim.registry import shipped
from tensorsim.training.everyday_maps import EverydaySettings
from tensorsim.training.loop import fit
from tensorsim.training.maps import to_bytes
from tensorsim.weights import load_state_dict, load_strict

SHARES = [f"{scene} {kind}" for scene in real_films.SCENES for kind in ("clips", "films")]
QUICK = replace(networks.quick_networks(), networks=("ccln", "diat-radharnet"), seeds=2, snr_db=(50.0, 10.0))


def known(trials: list[Trial], ratios: tuple[float, ...], work: Work) -> list[dict[str, Any]]:
    """CCLN is right in 6 and 8 of 12 clips at 50 dB, in half as many at 10 dB; the other one in 9 at all ratios."""
    results = []
    for trial in trials:
        counts = {}
        for ratio in ratios:
            right = (
                9 if trial.network == "diat-radharnet" else (6 + 2 * trial.seed) // (2 if ratio < 50 else 1)
            )
            matrix = torch.diag(torch.tensor([1] * right + [0] * (12 - right)))
            matrix[11, 0] += 12 - right
            counts[f"{ratio:g}"] = matrix.tolist()
        results.append({"validation": 0.5, "training_s": 2.0, "epoch": 1, "confusion": counts})
    return results


@pytest.fixture(autouse=True)
def trained(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(networks, "run_trials", known)


def test_networks_stand_in_order_of_accuracy_with_their_spread(tmp_path: Path) -> None:
    report = networks.networks_report(QUICK, Work(tmp_path))
    first, second = report.tables[0].rows
    assert first[:3] == ["DIAT-RadHARNet", pytest.approx(75.0), pytest.approx(0.0)]
    assert second[:3] == ["CCLN", pytest.approx(100 * 7 / 12), pytest.approx(100 / 12 * 2**0.5)]
    assert second[3] == pytest.approx(0.247, abs=0.002), "million parameters"
    assert second[4] > 0
    assert [second[6], second[7]] == ["5", "reconstruction"]
    assert len(report.tables[1].rows) == 4
    assert set(report.figures) == {"accuracy", "confusion-through-wall"}
    assert "5 clips per class in 32x32 pixels" in report.notes[0]


def test_accuracy_against_noise(tmp_path: Path) -> None:
    report = networks.snr_report(QUICK, Work(tmp_path))
    assert report.tables[0].columns == ["network", "50 dB", "50 dB, spread", "10 dB", "10 dB, spread"]
    ccln = report.tables[0].rows[1]
    assert (ccln[0], ccln[1], ccln[3]) == ("CCLN", pytest.approx(100 * 7 / 12), pytest.approx(100 * 3.5 / 12))


def test_accuracy_by_input(tmp_path: Path) -> None:
    config = replace(networks.quick_inputs(), inputs=("doppler", "merged"))
    report = networks.inputs_report(config, Work(tmp_path))
    assert [row[:3] for row in report.tables[0].rows] == [
        ["doppler", "through-wall", pytest.approx(50.0)],
        ["merged", "through-wall", pytest.approx(50.0)],
    ]


def test_echo_without_the_wall_is_stronger_and_else_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def one_second(activities: Any, count: int, seed: int) -> dict[str, list[ActivityClip]]:
        return {"S8 Walking": [ActivityClip("S8 Walking", str(k), 12 * k + 7, 1.0) for k in range(count)]}

    monkeypatch.setattr(ablations, "activity_clips", one_second)
    work = Work(tmp_path, quiet=True)
    report = ablations.echo_report(ablations.quick_echo(), work)
    rows = {row[0]: row for row in report.tables[0].rows}
    assert list(rows) == [
        "without wall attenuation",
        "without multipath",
        "without both",
        "empty map",
        "another clip",
    ]
    doppler = 5  # after two columns each of the two range-time maps
    assert rows["without wall attenuation"][doppler] > 100
    assert 30 < rows["without multipath"][doppler] < 80
    assert rows["empty map"][doppler] < 25
    assert rows["another clip"][doppler] < 30
    assert rows["without wall attenuation"][-1] > 3, "dB"
    monkeypatch.setattr(ablations, "compare", None)  # what is kept is not computed again
    again = ablations.echo_report(ablations.quick_echo(), work)
    assert [table.csv() for table in again.tables] == [table.csv() for table in report.tables]


def test_denoisers_stand_beside_an_empty_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[torch.Tensor] = []

    def zeros(maps: torch.Tensor) -> torch.Tensor:
        seen.append(maps)
        return torch.zeros_like(maps)

    monkeypatch.setattr(ablations, "map_denoiser", lambda name: None if name == "none" else zeros)
    config = ablations.DenoiserConfig(("none", "zeros"), ("through-wall",), 1, (10.0,), columns=32)
    report = ablations.denoiser_report(config, Work(tmp_path, quiet=True))
    rows = {(row[1], row[3]): row[4:] for row in report.tables[0].rows}
    for view in ("processed RTM", "DTM"):
        assert rows[view, "zeros"][:2] == rows[view, "empty map"][:2]
        assert rows[view, "none"][0] != rows[view, "another clip"][0]
    assert rows["DTM", "none"][0] > rows["DTM", "empty map"][0]
    assert [map_.shape[-1] for map_ in seen] == [32, 32]


def test_a_file_of_a_denoiser_is_told_by_its_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []

    def denoised(*_: Any, **__: Any) -> dict[str, Any]:
        made.append(1)
        return {"doppler_time": {str(path): [1.0] * len(ablations.COLUMNS)}}

    monkeypatch.setattr(ablations, "map_denoiser", lambda name: None)
    monkeypatch.setattr(ablations, "scores_of_clip", denoised)
    path = tmp_path / "own.safetensors"
    config = ablations.DenoiserConfig((str(path),), ("through-wall",), 1, (10.0,))
    for content in (b"a", b"a", b"b"):
        path.write_bytes(content)
        ablations.denoiser_report(config, Work(tmp_path, quiet=True))
    assert len(made) == 2


def test_pictures_become_square_with_the_same_mean() -> None:
    x = torch.rand(2, 1, 40, 80, generator=torch.Generator().manual_seed(0))
    found = real.square(x, 32)
    assert found.shape == (2, 1, 32, 32)
    assert float(found.mean()) == pytest.approx(float(x.mean()), abs=0.01)
    line = torch.zeros(1, 1, 16, 60)
    line[..., 30:] = 1
    assert bool((real.square(line, 32)[..., 20:] > 0.9).all())


def test_real_says_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match="--data, --films: got nothing, expected a folder"):
        real.quick_real().sets()
    with pytest.raises(
        TensorsimError, match="has none of the measured sets, expected some of glasgow_cfar_masks"
    ):
        replace(real.quick_real(), data=str(tmp_path)).sets()


def test_folders_are_looked_at_before_anything_is_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Valid measured sets do not hide missing films or maps."""
    monkeypatch.setattr(MeasuredSet, "load", lambda *_: (torch.zeros(1), torch.zeros(1)))
    monkeypatch.setattr(real, "_on_measured", None)
    others = {name: replace(entry, run=None) for name, entry in EXPERIMENTS.items() if name != "real"}
    monkeypatch.setattr(catalogue, "EXPERIMENTS", others | {"real": EXPERIMENTS["real"]})
    data, films, maps = (tmp_path / name for name in ("data", "films", "maps"))
    (data / SETS[0].name).mkdir(parents=True)
    films.mkdir()
    asked = {"data": str(data), "films": str(films)}
    for change, message in (
        ({"films": "nowhere"}, "nowhere: got no labels.json"),
        ({}, "films: got no labels.json"),
        (
            {"maps": str(maps)},
            r"maps: got the settings \{'frames': 3\}, expected those of a store of everyday",
        ),
    ):
        if "maps" in change:
            monkeypatch.setattr(real, "read_labels", lambda _: [])
            maps.mkdir()
            (maps / "settings.json").write_text('{"frames": 3}')
        with pytest.raises(TensorsimError, match=message):
            real.real_report(replace(real.quick_real(), **(asked | change)), Work(tmp_path / "work"))
        config = paper.PaperConfig(quick=True, **(asked | change))
        with pytest.raises(TensorsimError, match=message):
            catalogue._paper(config, Work(tmp_path / "work"))
    (maps / "settings.json").write_text(json.dumps(asdict(EverydaySettings(size=48))))
    with pytest.raises(TensorsimError, match="size: got 32, expected a divisor of the 48 of the maps in"):
        real.real_report(
            replace(real.quick_real(), **asked, maps=str(maps)),
            Work(tmp_path / "work"),  # type: ignore[arg-type]
        )


@pytest.mark.slow
def test_real_runs_and_goes_on(tmp_path: Path, shared_data: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    (data / "radhar_points").symlink_to((shared_data / "measured" / "radhar_points").resolve())
    config = replace(real.quick_real(), data=str(data))
    work = Work(tmp_path / "work", quiet=True)
    report = real.real_report(config, work)
    assert sorted(row[0] for row in report.tables[0].rows) == ["CCLN", "DIAT-RadHARNet"]
    assert all(0 <= row[1] <= 100 for row in report.tables[0].rows)
    assert real.real_report(config, work).tables[0].csv() == report.tables[0].csv()


def test_another_version_simulates_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Clips as of a measured set and maps of everyday motion lie in the cache by version and settings."""
    made: list[str] = []

    def simulate(self: MeasuredSet, clips: int, seed: int, quiet: bool) -> tuple[torch.Tensor, torch.Tensor]:
        made.append(f"{clips} {seed}")
        return torch.zeros(clips, 1, 8, 8), torch.zeros(clips, dtype=torch.int64)

    def films(training: real_films.EverydayTraining) -> str:
        made.append(str(training.maps))
        return "digest"

    monkeypatch.setattr(MeasuredSet, "simulate", simulate)
    monkeypatch.setattr(real_films.EverydayTraining, "digest", property(films))
    monkeypatch.setattr(real, "film_pictures", lambda *_: [real_films.FilmPictures(("S8 Walking",), {})])
    monkeypatch.setattr(real, "read_labels", lambda _: [])
    monkeypatch.setattr(real, "film_accuracy", lambda *_: dict.fromkeys(SHARES, 0.5))
    config, work = replace(real.quick_real(), films="films", networks=("ccln",)), Work(tmp_path, quiet=True)
    for version in ("1", "1", "2"):
        monkeypatch.setattr("tensorsim.config.documents.version", lambda _, version=version: version)
        real._simulated(config, SETS[0], work)
        real.real_report(config, work)
    clips, maps = [x for x in made if x == "4 0"], [x for x in made if x != "4 0"]
    assert (len(clips), len(maps), len(set(maps))) == (2, 3, 2)


def test_reports_say_what_the_best_constant_answer_would_get(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kicks, falls, both = ("S3 Kicking",), ("S12 Walking to Falling",), ("S3 Kicking", "S8 Walking")
    assert real.best_constant([kicks, falls, kicks, both]) == ("S3 Kicking", 0.75)
    labels = torch.tensor([0] + [2] * 3)
    monkeypatch.setattr(MeasuredSet, "load", lambda *_: (torch.zeros(4, 1, 8, 8), labels))
    monkeypatch.setattr(real, "_trained_and_tested", lambda *_: {"accuracy": 0.5})
    monkeypatch.setattr(real, "film_pictures", lambda *_: [real_films.FilmPictures(both, {})] * 4)
    monkeypatch.setattr(real, "read_labels", lambda _: [])
    monkeypatch.setattr(real_films.EverydayTraining, "digest", "digest")
    monkeypatch.setattr(real, "film_accuracy", lambda *_: dict.fromkeys(SHARES, 0.5))
    (tmp_path / SETS[2].name).mkdir()
    config = replace(real.quick_real(), data=str(tmp_path), films="films", networks=("ccln",))
    measured, filmed = real.real_report(config, Work(tmp_path / "work", quiet=True)).notes
    assert f"radhar_points 20 % and 75 % ({SETS[2].classes[2]})" in measured
    assert "development figures" in measured
    assert "at random is right in 17 %, and always S3 Kicking, the best constant answer, in 100.0 %" in filmed


def everyday_store(folder: Path, groups: int) -> None:
    """Pictures of two activities that differ in the place of one bright band."""
    folder.mkdir(parents=True)
    settings = EverydaySettings(filmed=4, true=0)
    (folder / "settings.json").write_text(json.dumps(asdict(settings)))
    for group in range(groups):
        activity = torch.tensor([0, 7] * 4)
        power = torch.full((8, 2, 64, 64), 1e-3)
        power[activity == 0, :, 30:34] = 1.0
        power[activity == 7, :, :, 30:34] = 1.0
        pictures = torch.stack([to_bytes(picture) for picture in power])
        save_file(
            {"pictures": pictures, "activity": activity, "filmed": torch.ones(8, dtype=torch.bool)},
            folder / f"everyday-{group:05d}.safetensors",
        )


def test_groups_of_maps_are_as_small_as_asked_for(tmp_path: Path) -> None:
    training = real_films.EverydayTraining(tmp_path, 1, 32, 1, EverydaySettings(filmed=0, true=1), quiet=True)
    activity = training.store.activity
    assert torch.bincount(activity)[1:].tolist() == [1] * (len(ACTIVITIES) - 1)
    # What the folder states about itself counts.
    other = real_films.EverydayTraining(tmp_path, 1, 32, 1, EverydaySettings(filmed=5), quiet=True)
    assert bool((other.store.activity == activity).all())


def test_the_first_films_of_a_folder_are_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    films = [LabelledFilm(tmp_path, f"{k}.mp4", 0.0, 4.0, ("S8 Walking",)) for k in range(3)]
    for film in films:
        film.path.write_bytes(b"film")
    monkeypatch.setattr(real_films, "read_labels", lambda folder: films)

    def made(taken: list[LabelledFilm], size: int, work: Work) -> dict[str, torch.Tensor]:
        return {
            f"{scene}/{k}": torch.zeros(1, 1, size, size)
            for scene in real_films.SCENES
            for k in range(len(taken))
        }

    monkeypatch.setattr(real_films, "_made", made)
    work = Work(tmp_path / "work", quiet=True)
    assert len(real_films.film_pictures(tmp_path, 32, work, 2)) == 2
    assert len(real_films.film_pictures(tmp_path, 32, work)) == 3

    # With other weights of the shipped networks, the films are processed again.
    before = set((tmp_path / "work" / "results").iterdir())
    entries = [replace(entry, sha256="0" * 64) for entry in shipped()]
    monkeypatch.setattr("tensorsim.registry.shipped", lambda: tuple(entries))
    assert len(real_films.film_pictures(tmp_path, 32, work)) == 3
    assert len(set((tmp_path / "work" / "results").iterdir()) - before) == 1


def test_networks_learn_everyday_maps_and_label_films(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A film whose window shows the band of walking is a walk; one without a map is wrong."""
    fitted: list[Any] = []

    def fit_and_keep(recipe: Any, loop: Any) -> dict[str, float]:
        fitted.append(recipe)
        return fit(recipe, loop)

    monkeypatch.setattr(real_films, "fit", fit_and_keep)
    everyday_store(tmp_path / "maps", 5)
    band = torch.zeros(2, 1, 32, 32)
    band[..., 15:17] = 1.0
    windows = {"free-space": band, "through-wall": torch.zeros(0, 1, 32, 32)}
    films = [real_films.FilmPictures(("S8 Walking",), windows)]
    training = real_films.EverydayTraining(tmp_path / "maps", 5, 32, 60)
    work = Work(tmp_path / "work", quiet=True)
    found = real_films.film_accuracy("ccln", 0, training, films, work)
    assert found["free-space clips"] == found["through-wall clips"] == 1.0
    assert found["free-space films"] == 1.0
    assert found["through-wall films"] == 0.0
    # The network that was tested is the one that is kept.
    (kept,) = (tmp_path / "work" / "trials").rglob("best.safetensors")
    net = find_classifier("ccln").build(12, 1, 32)
    load_strict(net, load_state_dict(kept), kept)
    for name, weights in fitted[0].net.state_dict().items():
        torch.testing.assert_close(net.state_dict()[name], weights, rtol=2e-3, atol=2e-3)
    assert real_films.titled({"ccln": [found, found]}) == [["CCLN", 100.0, 100.0, 100.0, 0.0]]


def test_trainings_on_other_maps_in_the_same_folder_are_not_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    films = [real_films.FilmPictures(("S8 Walking",), {})]
    trained: list[str] = []

    def accuracy(name: str, *_: Any) -> dict[str, float]:
        trained.append(name)
        return dict.fromkeys(SHARES, 0.5)

    monkeypatch.setattr(real, "film_pictures", lambda *_: films)
    monkeypatch.setattr(real, "read_labels", lambda _: [])
    monkeypatch.setattr(real, "film_accuracy", accuracy)
    everyday_store(tmp_path / "maps", 5)
    config = replace(real.quick_real(), films="films", maps=str(tmp_path / "maps"), networks=("ccln",))
    for _ in range(2):
        real.real_report(config, Work(tmp_path / "work", quiet=True))
    assert len(trained) == 1
    changed = tmp_path / "maps" / "everyday-00003.safetensors"
    parts = load_file(changed)
    save_file(parts | {"pictures": 255 - parts["pictures"]}, changed)
    real.real_report(config, Work(tmp_path / "work", quiet=True))
    assert len(trained) == 2
    report = real.real_report(replace(config, seeds=5, film_seeds=2), Work(tmp_path / "work", quiet=True))
    assert len(trained) == 3, "one more"
    assert "2 trainings each" in report.notes[0]


@pytest.mark.slow
def test_real_labels_films(tmp_path: Path, shared_data: Path) -> None:
    folder = tmp_path / "films"
    folder.mkdir()
    labels = json.loads((shared_data / "films_labelled" / "labels.json").read_text())
    row = next(row for row in labels if row["file"] == "kick_ball.mp4")
    (folder / row["file"]).symlink_to((shared_data / "films_labelled" / row["file"]).resolve())
    (folder / "labels.json").write_text(json.dumps([row]))
    everyday_store(tmp_path / "maps", 5)
    config = replace(
        real.quick_real(), films=str(folder), maps=str(tmp_path / "maps"), film_steps=2, networks=("ccln",)
    )
    work = Work(tmp_path / "work", quiet=True)
    report = real.real_report(config, work)
    assert [table.file for table in report.tables] == ["films"]
    assert report.tables[0].rows[0][0] == "CCLN"
    assert all(share in (0.0, 100.0) for share in report.tables[0].rows[0][3:])
    assert real.real_report(config, work).tables[0].csv() == report.tables[0].csv()


@pytest.mark.slow
def test_films_are_compared_chain_by_chain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A chain that knows the truth has the best scores; one that finds nobody has those of an empty map."""

    class Watcher:
        missing: dict[str, str] = {"TCN": "no weights"}  # noqa: RUF012

        def __init__(self) -> None:
            clip = ActivityClip("S8 Walking", "0", 7, 1.0)
            truth = clip.joints(30.0).float()[None]
            there = torch.ones(1, truth.shape[1], dtype=torch.bool)
            nobody = (torch.zeros(0, truth.shape[1], 14, 3), there[:0])
            running = truth + 0.4 * torch.arange(truth.shape[1])[:, None, None]  # at 12 m/s
            self.chains = {
                "truth": lambda f, h: (truth, there),
                "nobody": lambda f, h: nobody,
                "too fast": lambda f, h: (running, there),
            }

    monkeypatch.setattr(video, "Watcher", Watcher)
    monkeypatch.setattr(video, "HEIGHT", 36)
    monkeypatch.setattr(video, "WIDTH", 64)
    config = replace(video.quick_video(), scenes=("through-wall",))
    report = video.video_report(config, Work(tmp_path, quiet=True))
    rows = {row[0]: row for row in report.tables[0].rows}
    assert rows["truth"][3] > 40
    assert rows["nobody"][3] == pytest.approx(rows["empty map"][3])
    assert rows["too fast"][3] == pytest.approx(rows["empty map"][3])
    assert "**TCN** (no weights)" in report.notes[2]
    errors = {row[0]: row for row in report.tables[-1].rows}
    assert errors["truth"][1] == pytest.approx(0.0, abs=1e-6)
    assert errors["truth"][4:6] == [1.0, 1.0], "followed, people"
    assert errors["nobody"][4:6] == [0.0, 0.0]


def test_an_empty_scene_is_in_the_mean_of_no_chain(tmp_path: Path) -> None:
    """A person found in it would raise the mean of a chain above that of a correct one."""

    class Watcher:
        missing: dict[str, str] = {}  # noqa: RUF012
        chains = dict.fromkeys(("right", "ghost"))

    def cell(psnr: float, people: float) -> dict[str, Any]:
        scores = {"through-wall": {name: {"psnr": psnr} for name in MAPS}}
        return {"scores": scores, "pose": {"people": people}}

    walking, empty, inf = "S8 Walking", "S1 Empty", float("inf")
    cells = {(row, guess): [cell(20.0, 0.0)] for row in (walking, empty) for guess in ablations.GUESSES}
    cells |= {(walking, "right"): [cell(20.0, 1.0)], (empty, "right"): [cell(inf, 0.0)]}
    cells |= {(walking, "ghost"): [cell(20.0, 1.0)], (empty, "ghost"): [cell(60.0, 2.0)]}
    config = replace(video.quick_video(), scenes=("through-wall",))
    report = video._report(config, {empty: [], walking: []}, Watcher(), cells)  # type: ignore[arg-type]
    means = {row[0]: row[1:] for row in report.tables[0].rows}
    assert means["right"] == means["ghost"] == [20.0] * 3
    assert {row[0]: row[-1] for row in report.tables[-1].rows} == {"right": 0.0, "ghost": 2.0}


def test_the_paper_joins_all_reports(tmp_path: Path) -> None:
    def run(config: Any, work: Work) -> Report:
        return Report(["Note.", "More."], [Table("T", ["a"], [[str(config)]])])

    entries = {name: Experiment(name, paper.PaperConfig, run, lambda: "quick") for name in ("one", "real")}
    report = paper.paper_report({"one": "quick"}, Work(tmp_path), entries)
    assert [table.title for table in report.tables] == ["one: T"]
    assert [table.file for table in report.tables] == ["one"]
    assert report.tables[0].rows == [["quick"]]
    assert any("**real** is left out" in note for note in report.notes)


def test_the_paper_takes_the_settings_of_earlier_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, Any] = {}

    def recorded(name: str) -> Experiment:
        def run(config: Any, work: Work) -> Report:
            asked[name] = config
            return Report(["Note."], [])

        return replace(EXPERIMENTS[name], run=run)

    entries = {name: recorded(name) if name != "paper" else EXPERIMENTS[name] for name in EXPERIMENTS}
    monkeypatch.setattr(catalogue, "EXPERIMENTS", entries)
    monkeypatch.setattr(real.RealConfig, "check", lambda *_: None)
    (tmp_path / "echo-ablation.yaml").write_text("experiment: echo-ablation\nclips: 3\nseed: 0\n")
    (tmp_path / "real.yaml").write_text("experiment: real\ndata: elsewhere\nmaps: elsewhere\nclips: 7\n")
    config = paper.PaperConfig(settings=str(tmp_path), data="measured")
    EXPERIMENTS["paper"].run(config, Work(tmp_path, quiet=True))
    assert set(asked) == set(EXPERIMENTS) - {"paper"}
    assert asked["echo-ablation"] == ablations.EchoConfig(clips=3)
    assert asked["denoiser-ablation"] == ablations.DenoiserConfig()
    assert asked["real"] == real.RealConfig(data="measured", clips=7)
    with pytest.raises(
        TensorsimError, match=r"--settings: got .*, expected a folder with NAME.yaml of experiments"
    ):
        paper.PaperConfig(settings=str(tmp_path / "none"))


def test_stored_results_are_of_known_experiments() -> None:
    assert set(stored_names()) <= set(EXPERIMENTS)
    for name in stored_names():
        assert (RESULTS / f"{name}.md").is_file()
        assert (
            stored_table(name) if (RESULTS / f"{name}.csv").is_file() else list(RESULTS.glob(f"{name}-*.csv"))
        )
    with pytest.raises(TensorsimError, match="got 'nothing', expected one of"):
        stored_table("nothing")
    assert sum(path.stat().st_size for path in RESULTS.iterdir()) < 200_000
